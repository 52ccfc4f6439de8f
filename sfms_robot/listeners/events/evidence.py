"""Evidence for decisions, frame by frame: voices, looks, signs of faces, and earlier events.

    SpeakerFrame -> signs of the face, voice, look (`Instant`) -> a row of evidence (`hear`); own events -> `done`

A row of evidence is known at the end of a frame; later frames do not change it. Times are seconds, `math.inf` for
something that has never happened. NaN: a value does not apply or is unknown, which is evidence neither for nor against.

The voices of all others together (`signals.phase`) have the duration of the phrase so far, of their silence and of the
last phrase. The floor is held by a person, oneself included, in a phrase of a second or more. Of several such people
the latest to begin holds it; while there is none, the last holder keeps it. The looks that count are those of the
people who speak now, else those of the holder of the floor.

Sound shows whether the person speaks, the face whether they look, nod, smile and laugh. A talking head moves all the
time, by more than many nods do: only a silent person nods. Each input may be missing. Without a microphone, a mouth
that moves is a voice. Without a face there is no nod and no laugh. Without attention the head is looked at, because one
person talks to one head. An attention of NaN is unknown; so is one that is missing after there has been one, and that
of a lost face. Attention flickers: looked-at changes only when attention, smoothed over a quarter second, has clearly
crossed the middle.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from sfms_robot.frames import (
    CHANNEL_INDEX,
    FRAME_S,
    Doubles,
    Events,
    FaceFrame,
    Floats,
    ListenerEvent,
    SpeakerFrame,
    changed,
)
from sfms_robot.signals import voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.events import CORNERS
from sfms_robot.signals.phase import SpeechPhase
from sfms_robot.signals.voice_activity import Ear

# Evidence of the others: seconds, except for flags (0 or 1) and the size of a smile.
HEARD: Final = (
    "phrase_s", "silence_s", "last_phrase_s",  # of all others together; phrase_s only while the phrase lasts
    "one_speaks", "several_speak",
    "floor_mine", "floor_s", "holder_silence_s",  # floor_s: since the holder changed; both only if it is another
    "own_voice_s", "own_voice_known",  # since the newest own voice; whether there has been any
    "gaze_known", "looked_at", "looked_at_s", "looked_at_silence_s",  # the last two only while looked at
    "laugh_s", "others_nod_s", "others_smile_s",  # since the newest one; a nod and a smile since it began
    "others_smile",  # size of that smile
)  # fmt: skip
# Evidence of own events: seconds since the newest one began or ended, except for the last three.
DONE: Final = (
    "nod_s", "nod_end_s", "mm_hm_s", "laugh_end_s", "smile_end_s", "shake_end_s", "tilt_end_s", "brow_raise_end_s",
    "blink_s", "shift_s", "at_person_s",  # shift_s: since a gaze shift; at_person_s: the same, while at the person
    "root_nods_30s",  # square root of the number of nods that began in the last 30 s
    "log_rate",  # natural logarithm of nods per minute: measured so far for a person, as set for a head
)  # fmt: skip
EVIDENCE: Final = HEARD + DONE
NUMBERS: Final = frozenset(name for name in EVIDENCE if not name.endswith("_s"))  # the others are seconds
AT: Final[Mapping[str, int]] = {name: index for index, name in enumerate(EVIDENCE)}
FLOOR_FRAMES: Final = 25  # a phrase this long takes the floor
SMILES_APART: Final = 25  # frames; a smile that is back sooner is the same smile
COUNTED_S: Final = 30.0
REMEMBERED_S: Final = 64.0  # older own events count as long ago
EPS_S: Final = 1e-6
MINE: Final = 0
NOBODY: Final = -1


@dataclass(frozen=True, kw_only=True)
class Instant:
    """One frame of a conversation of P people, oneself the first.

    Attributes:
        speaks, looks: (P,) whether each speaks; whether each looks at oneself, NaN: unknown.
        laughs, nods: whether one of the others laughs; whether one begins to nod.
        smiles: size of the smile of one of the others (0..1); 0 if none of them smiles.
    """

    speaks: tuple[bool, ...]
    looks: tuple[float, ...]
    laughs: bool = False
    nods: bool = False
    smiles: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Hearing:
    """The memory of a stream about the others.

    Attributes:
        frame: number of frames so far.
        voices, each: phrases of all others together, and of each person, oneself the first.
        spoke: newest frame of each person's voice.
        holder, held: holder of the floor, and the frame since which they hold it.
        looked: frame since which one is looked at, None while not.
        laughed, nodded, smiled: newest frames of a laugh, a nod and a smile.
        smile, began: size and first frame of the newest smile.
    """

    frame: int
    voices: SpeechPhase
    each: tuple[SpeechPhase, ...]
    spoke: tuple[float, ...]
    holder: int = NOBODY
    held: int = 0
    looked: int | None = None
    laughed: float = -math.inf
    nodded: float = -math.inf
    smiled: float = -math.inf
    smile: float = 0.0
    began: float = -math.inf

    @property
    def own_voice_s(self) -> float:
        """Return the time since the newest own voice [s]; `inf`: there has been none."""
        return (self.frame - 1 - self.spoke[MINE]) * FRAME_S


def hearing(people: int = 2) -> Hearing:
    """Return the memory at the beginning of a conversation of `people` people, oneself among them."""
    return Hearing(frame=0, voices=SpeechPhase(), each=(SpeechPhase(),) * people, spoke=(-math.inf,) * people)


def hear(instant: Instant, before: Hearing) -> tuple[Doubles, Hearing]:
    """Process one frame; return its row of evidence (len(HEARD),) and the memory after it."""
    now = before.frame
    others = instant.speaks[1:]
    speaking = sum(others)
    voices = before.voices.after(speaking > 0)
    each = tuple(one.after(speaks) for one, speaks in zip(before.each, instant.speaks, strict=True))
    spoke = tuple(now if speaks else at for speaks, at in zip(instant.speaks, before.spoke, strict=True))
    holder, held = before.holder, before.held
    long = [(one.speech, who) for who, one in enumerate(each) if one.speech >= FLOOR_FRAMES]
    if long:
        holder = min(long)[1]
    if holder != before.holder:
        held = now
    counts = [
        look for who, look in enumerate(instant.looks) if who and (who == holder if not speaking else others[who - 1])
    ]
    looked: int | None = None
    if any(look == 1 for look in counts):
        looked = now if before.looked is None else before.looked
    smile, began = before.smile, before.began
    if instant.smiles > 0:
        new = now - before.smiled > SMILES_APART
        smile, began = (instant.smiles, now) if new else (max(smile, instant.smiles), began)
    after = Hearing(
        frame=now + 1, voices=voices, each=each, spoke=spoke, holder=holder, held=held, looked=looked,
        laughed=now if instant.laughs else before.laughed,
        nodded=now if instant.nods else before.nodded,
        smiled=now if instant.smiles > 0 else before.smiled,
        smile=smile, began=began,
    )  # fmt: skip
    phrase_s, silence_s, last_s = voices.times_s
    another = holder > MINE
    row = (
        phrase_s or math.nan, silence_s, last_s or math.nan,
        float(speaking == 1), float(speaking > 1),
        float(holder == MINE),
        (now - held) * FRAME_S if another else math.nan,
        (now - spoke[holder]) * FRAME_S if another else math.nan,
        after.own_voice_s, float(after.own_voice_s < math.inf),
        float(any(look == look for look in counts)),
        float(looked is not None),
        math.nan if looked is None else (now - looked) * FRAME_S,
        math.nan if looked is None else silence_s,
        (now - after.laughed) * FRAME_S, (now - after.nodded) * FRAME_S, (now - began) * FRAME_S,
        smile,
    )  # fmt: skip
    return np.array(row), after


# --- Own events -------------------------------------------------------------------------------------------------------


def done(events: Iterable[ListenerEvent], now_s: float, log_rate: float) -> Doubles:
    """Return the row of evidence (len(DONE),) at an instant, from events in the order of their beginnings.

    Events that have yet to begin count as begun.
    """
    since = dict.fromkeys(DONE, math.inf)
    nods, aside = 0, False
    for event in events:
        begun_s = max(0.0, now_s - event.start_s)
        kind = event.kind
        if kind == "nod":
            since["nod_s"] = begun_s
            nods += begun_s <= COUNTED_S + EPS_S
        elif kind == "gaze_shift":
            since["shift_s"] = begun_s
            aside = event.target_rad is not None and event.target_rad != (0.0, 0.0)
        elif kind in ("mm_hm", "blink"):
            since[f"{kind}_s"] = begun_s
            continue
        if kind != "gaze_shift":
            key = f"{kind}_end_s"
            since[key] = min(since[key], max(0.0, now_s - event.end_s))
    since["at_person_s"] = math.nan if aside else since["shift_s"]
    since["root_nods_30s"] = math.sqrt(nods)
    since["log_rate"] = log_rate
    return np.array([since[name] for name in DONE])


def remembered(events: Sequence[ListenerEvent], now_s: float) -> Events:
    """Return the events, in order, that may still matter: those of the last minute and the newest of every kind."""
    newest = {event.kind: event for event in events}
    return tuple(event for event in events if newest[event.kind] is event or event.end_s > now_s - REMEMBERED_S)


# --- Signs of a face --------------------------------------------------------------------------------------------------
#
# Trackers make errors: a face may be upside down, stuck, saturated or all noise. So each sign is compared with the
# last second of the same face or with a running neutral, which approaches a constant value; angles are taken modulo a
# whole turn; and a nod is a swing larger than the swings that talking or noise cause anyway. A laugh is a broad smile
# and a mouth that opens and closes: a person who talks and beams at once counts as laughing.

NOD_RAD: Final = math.radians(2.0)  # least swing of a nod, within a second, most of which is followed by the way back
BACK: Final = 0.6
WINDOW: Final = 25  # frames
NODS_APART: Final = 30  # frames; more than a window, so that no swing counts twice
STANDS_OUT: Final = 4.0  # least swing of a nod relative to the mean swing of the last seconds
SMILE: Final = 0.25  # above the neutral
BEAM: Final = 0.35
HELD_FRAMES: Final = 6
OPENING: Final = 0.02  # least mean change of jawOpen per frame of a mouth that moves
_SMOOTH: Final = 0.5  # weight of a new value
_NEUTRAL_RISE: Final = 0.02 * FRAME_S  # per frame: a person who always beams is neutral within a minute
_NEUTRAL_FALL: Final = 0.1
_MOTION: Final = 0.12
SWAY: Final = FRAME_S / 8.0  # weight of a new swing in the mean swing, which spans some eight seconds
JAW: Final = CHANNEL_INDEX["jawOpen"]
PITCH: Final = CHANNEL_INDEX["pitch"]


@dataclass(frozen=True)
class Signs:
    """The signs of one frame.

    `nods`: a nod has just been seen; `smiles`: size of the person's smile (0: none); `laughs`: they laugh;
    `mouth_moves`: the mouth moves as in speech.
    """

    nods: bool = False
    smiles: float = 0.0
    laughs: bool = False
    mouth_moves: bool = False


@dataclass(frozen=True, kw_only=True)
class FaceState:
    """The memory of a face.

    Attributes:
        frame: number of frames so far.
        pitch_rad: smoothed, unwrapped pitch of the last second.
        nodded: frame of the newest nod; sway_rad: mean swing of the last seconds.
        neutral, held: neutral of the smile, and number of frames for which the smile has been up.
        jaw, opening: jawOpen, and its change per frame.
    """

    frame: int = 0
    pitch_rad: tuple[float, ...] = ()
    nodded: int = -NODS_APART
    sway_rad: float = 0.0
    neutral: float | None = None
    held: int = 0
    jaw: float = 0.0
    opening: float = 0.0


def read_signs(face: FaceFrame | None, state: FaceState) -> tuple[Signs, FaceState]:
    """Return the signs of one frame of 40 ms: none without a face, or with a face that is not finite."""
    motion = None if face is None else face.motion
    if motion is None or not np.isfinite(motion).all():
        return Signs(), changed(state, frame=state.frame + 1, pitch_rad=(), held=0, opening=0.0)
    pitch, left, right, jaw = (motion.item(channel) for channel in (PITCH, *CORNERS, JAW))
    nods, state = _nod(pitch, state)
    over, neutral, held = smile_over((left + right) / 2, state.neutral, state.held)
    jaw, opening = jaw_opening(jaw, state.jaw, state.opening)
    smiles, moves = held >= HELD_FRAMES, opening > OPENING
    after = changed(state, frame=state.frame + 1, neutral=neutral, held=held, jaw=jaw, opening=opening)
    return Signs(nods, over if smiles else 0.0, smiles and over > BEAM and moves, moves), after


def _within(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _nod(pitch_rad: float, state: FaceState) -> tuple[bool, FaceState]:
    before = state.pitch_rad
    pitch = (*before, smoothed_pitch(pitch_rad, before[-1] if before else None))[-WINDOW:]
    swing = max(_swing(pitch), _swing([-p for p in pitch]))
    stands_out = swing >= max(NOD_RAD, STANDS_OUT * state.sway_rad)
    new = stands_out and state.frame - state.nodded >= NODS_APART
    sway = state.sway_rad + SWAY * (swing - state.sway_rad)
    return new, changed(state, pitch_rad=pitch, nodded=state.frame if new else state.nodded, sway_rad=sway)


def _swing(values: tuple[float, ...] | list[float]) -> float:
    """Return the height of the rise to the top, if most of the way back is done by now; else 0."""
    top = max(values)
    risen = top - min(values[: values.index(top) + 1])
    return risen if top - values[-1] >= BACK * risen else 0.0


def smoothed_pitch(pitch_rad: float, before_rad: float | None) -> float:
    """Return the smoothed, unwrapped pitch; `before_rad`: that of the frame before, None without one."""
    if before_rad is None:
        return pitch_rad
    return before_rad + _SMOOTH * math.remainder(pitch_rad - before_rad, 2 * math.pi)


def smile_over(level: float, neutral: float | None, held: int) -> tuple[float, float, int]:
    """Return the level of the smile above its neutral, the neutral, and the number of frames for which it is up."""
    level = _within(level)
    neutral = level if neutral is None else neutral
    neutral += _NEUTRAL_FALL * (level - neutral) if level < neutral else min(_NEUTRAL_RISE, level - neutral)
    over = level - neutral
    return over, neutral, held + 1 if over > SMILE * (0.6 if held >= HELD_FRAMES else 1.0) else 0


def jaw_opening(jaw: float, before: float, opening: float) -> tuple[float, float]:
    """Return jawOpen within 0..1, and its smoothed change per frame."""
    jaw = _within(jaw)
    return jaw, opening + _MOTION * (abs(jaw - before) - opening)


# --- The person -------------------------------------------------------------------------------------------------------

Addressed = Literal["sense", "assume", "never"]
OWN_VOICE_DB: Final = -50.0  # relative to full scale; a program's voice is silent between words
LOOK_S: Final = 0.25
LOOKED, NOT_LOOKED = 0.6, 0.4
LOST_FRAMES: Final = 25  # after this many frames without a face the look is unknown
_KEPT: Final = math.exp(-FRAME_S / LOOK_S)


@dataclass(frozen=True, kw_only=True)
class SenseMemory:
    """The memory of the person.

    Attributes:
        addressed: `Calmness.addressed`.
        ear: voice activity of their sound.
        deaf: there has been no sound at all.
        attention: smoothed attention; None before any.
        looked: whether they look: 1, 0, or NaN for unknown.
        unseen: frames since their newest face; None before the first.
        tells: there has been an attention.
    """

    addressed: Addressed = "sense"
    ear: Ear = field(default_factory=voice_activity.start)
    deaf: bool = True
    attention: float | None = None
    looked: float = math.nan
    unseen: int | None = None
    tells: bool = False
    face: FaceState = FaceState()
    hearing: Hearing = field(default_factory=hearing)


@dataclass(frozen=True)
class Sensed:
    """Evidence `heard` (len(HEARD),) after the frame of index `frame` in loop time."""

    frame: int
    heard: Doubles


def sense(speaker: SpeakerFrame, memory: SenseMemory) -> tuple[Sensed, SenseMemory]:
    """Process a frame; return its evidence and the memory after it.

    A pure function. Several streams of one speaker may share the result if their `addressed` is the same.
    """
    deaf = memory.deaf and not len(speaker.audio)
    ear = memory.ear if deaf else voice_activity.step(energy_db(speaker.audio), memory.ear)
    signs, face = read_signs(speaker.face, memory.face)
    looked, watching = looks_at_head(speaker, memory)
    talks = signs.mouth_moves if deaf else ear.active
    nods = signs.nods and not talks and not memory.hearing.voices.speech
    instant = Instant(
        speaks=(sounds(speaker.agent_audio), talks),
        looks=(math.nan, looked),
        laughs=signs.laughs,
        nods=nods,
        smiles=signs.smiles,
    )
    heard, remembered = hear(instant, memory.hearing)
    return Sensed(speaker.number, heard), changed(watching, ear=ear, deaf=deaf, face=face, hearing=remembered)


def sounds(own_voice: Floats | None) -> bool:
    """Return whether the robot's own voice sounds."""
    return own_voice is not None and energy_db(own_voice) > OWN_VOICE_DB


def looks_at_head(speaker: SpeakerFrame, memory: SenseMemory) -> tuple[float, SenseMemory]:
    """Return 1 if the person looks at the head, else 0, or NaN (unknown); and the memory after the frame."""
    if memory.addressed != "sense":
        return float(memory.addressed == "assume"), memory
    given = speaker.attention
    if speaker.face is None and given is None:
        if memory.unseen is None:
            return 1.0, memory
        unseen = memory.unseen + 1
        lost = {"attention": None, "looked": math.nan} if unseen > LOST_FRAMES else {}
        gone = changed(memory, unseen=unseen, **lost)
        return gone.looked, gone
    if given is None and not memory.tells:
        return 1.0, changed(memory, unseen=0)
    if given is None or not math.isfinite(given):
        return math.nan, changed(memory, unseen=0, attention=None, looked=math.nan)
    before = 1.0 if memory.attention is None else memory.attention
    given = _within(given)
    level = given + (before - given) * _KEPT
    looked = 1.0 if math.isnan(memory.looked) else memory.looked
    if level > LOOKED:
        looked = 1.0
    elif level < NOT_LOOKED:
        looked = 0.0
    return looked, changed(memory, unseen=0, attention=level, looked=looked, tells=True)
