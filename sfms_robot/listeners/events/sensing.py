"""A person's frame as evidence: the ear hears who speaks, the face says who looks, nods, smiles and laughs. A head that
talks moves all the time, by more than many a nod: nods are those of somebody silent.

Each input may be missing. No microphone: a mouth that moves is a voice. No face: nobody nods or laughs. Nobody who
tells whether the head is looked at: it is, for one person talks to one head; an attention of NaN says that nobody
knows, and so does a face that has told it before and is lost. Attention flickers; looked-at changes only when a quarter
second of it, smoothed, has clearly crossed the middle, and one that never does leaves it as it would be untold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sfms_robot.frames import (
    CHANNEL_INDEX,
    FRAME_S,
    MOTION_DIM,
    SMILE_CORNERS,
    Doubles,
    FaceFrame,
    Floats,
    SpeakerFrame,
    changed,
)
from sfms_robot.listeners.events.evidence import Bools, Hearing, Instant, Scene, hear, hearing
from sfms_robot.signals import phase, voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.voice_activity import Ear

Addressed = Literal["sense", "assume", "never"]
OWN_VOICE_DB: Final = -50.0  # of full scale; what a program says is silent otherwise
LOOK_S: Final = 0.25
LOOKED, NOT_LOOKED = 0.6, 0.4
LOST_FRAMES: Final = 25  # without a face nobody knows where its owner looks
_KEPT: Final = math.exp(-FRAME_S / LOOK_S)


# --- Signs of a face --------------------------------------------------------------------------------------------------
#
# Trackers make errors: a face may be upside down, stuck, saturated or all noise. So each sign is judged against the
# last second of the same face or a running neutral, which a constant becomes; angles are taken modulo a whole turn;
# and a nod is a swing larger than how the head swings anyway, by talking or by noise. A laugh is a broad smile over a
# mouth that opens and closes: a person who talks and beams at once counts as laughing.

NOD_RAD: Final = math.radians(2.0)  # a swing there, within a second, and most of it back
BACK: Final = 0.6
WINDOW: Final = 25  # frames
NODS_APART: Final = 30  # frames; more than a window, so that no swing counts twice
STANDS_OUT: Final = 4.0  # times as far as the head swung over the last seconds, on average
SMILE: Final = 0.25  # over the neutral
BEAM: Final = 0.35
HELD_FRAMES: Final = 6
OPENING: Final = 0.02  # mean change of jawOpen per frame of a mouth that moves
_SMOOTH: Final = 0.5  # share of a new value
_NEUTRAL_RISE: Final = 0.02 * FRAME_S  # of the smile's neutral: somebody who always beams is neutral within a minute
_NEUTRAL_FALL: Final = 0.1
_MOTION: Final = 0.12
_SWAY: Final = FRAME_S / 8.0  # of the mean swing: some eight seconds
_CORNERS: Final = [CHANNEL_INDEX[name] for name in SMILE_CORNERS]
_JAW: Final = CHANNEL_INDEX["jawOpen"]
_PITCH: Final = CHANNEL_INDEX["pitch"]


@dataclass(frozen=True)
class Signs:
    """Of one frame: a nod has just been seen; the person smiles, laughs; the mouth moves as in speech."""

    nods: bool = False
    smiles: bool = False
    laughs: bool = False
    mouth_moves: bool = False


@dataclass(frozen=True)
class FaceState:
    """What is remembered of a face.

    Attributes:
        frame: how many have been asked for.
        pitch_rad: smoothed, unwrapped, of the last second.
        nodded: frame of the newest nod; sway_rad: mean swing of the last seconds.
        neutral, held: of the smile: its neutral, and for how many frames it has been up.
        jaw, opening: jawOpen, and how much it changes per frame.
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
    """One frame of 40 ms. Without a face, or with one that holds what is not finite, nothing is seen."""
    motion = None if face is None else face.motion
    if motion is None or not np.isfinite(motion).all():
        return Signs(), changed(state, frame=state.frame + 1, pitch_rad=(), held=0, opening=0.0)
    pitch, left, right, jaw = (motion.item(channel) for channel in (_PITCH, *_CORNERS, _JAW))
    nods, state = _nod(pitch, state)
    over, neutral, held = _smile((left + right) / 2, state.neutral, state.held)
    jaw, opening = _opening(jaw, state.jaw, state.opening)
    smiles, moves = held >= HELD_FRAMES, opening > OPENING
    after = changed(state, frame=state.frame + 1, neutral=neutral, held=held, jaw=jaw, opening=opening)
    return Signs(nods, smiles, smiles and over > BEAM and moves, moves), after


def _within(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _nod(pitch_rad: float, state: FaceState) -> tuple[bool, FaceState]:
    before = state.pitch_rad
    pitch = (*before, _smoothed(pitch_rad, before[-1] if before else None))[-WINDOW:]
    swing = max(_swing(pitch), _swing([-p for p in pitch]))
    stands_out = swing >= max(NOD_RAD, STANDS_OUT * state.sway_rad)
    new = stands_out and state.frame - state.nodded >= NODS_APART
    sway = state.sway_rad + _SWAY * (swing - state.sway_rad)
    return new, changed(state, pitch_rad=pitch, nodded=state.frame if new else state.nodded, sway_rad=sway)


def _swing(values: tuple[float, ...] | list[float]) -> float:
    """How far up it went, if by now it is most of the way back; else 0."""
    top = max(values)
    risen = top - min(values[: values.index(top) + 1])
    return risen if top - values[-1] >= BACK * risen else 0.0


def _smoothed(pitch_rad: float, before_rad: float | None) -> float:
    if before_rad is None:
        return pitch_rad
    return before_rad + _SMOOTH * math.remainder(pitch_rad - before_rad, 2 * math.pi)


def _smile(level: float, neutral: float | None, held: int) -> tuple[float, float, int]:
    """Return how far the smile is over its neutral, the neutral, and for how many frames it has been up."""
    level = _within(level)
    neutral = level if neutral is None else neutral
    neutral += _NEUTRAL_FALL * (level - neutral) if level < neutral else min(_NEUTRAL_RISE, level - neutral)
    over = level - neutral
    return over, neutral, held + 1 if over > SMILE * (0.6 if held >= HELD_FRAMES else 1.0) else 0


def _opening(jaw: float, before: float, opening: float) -> tuple[float, float]:
    """Return jawOpen within 0..1, and its smoothed change per frame."""
    jaw = _within(jaw)
    return jaw, opening + _MOTION * (abs(jaw - before) - opening)


def signs_in(faces: Sequence[FaceFrame | None]) -> Bools:
    """Return nods, smiles, laughs and moving mouth (N, 4) of a recording: `read_signs` of all frames at once."""
    channels = np.full((len(faces), 4), np.nan)
    known = [index for index, face in enumerate(faces) if face is not None]
    motion = np.array([face.motion for face in faces if face is not None], np.float64).reshape(-1, MOTION_DIM)
    finite = np.isfinite(motion).all(axis=1)
    if len(known):
        channels[np.array(known)[finite]] = motion[finite][:, [_PITCH, *_CORNERS, _JAW]]
    pitch_rad, found = np.full(len(faces), np.nan), np.zeros((len(faces), 4), bool)
    smoothed, neutral, held, jaw, opening = None, None, 0, 0.0, 0.0
    for index, (pitch, left, right, open_) in enumerate(channels.tolist()):
        if pitch != pitch:  # NaN: no face
            smoothed, held, opening = None, 0, 0.0
            continue
        pitch_rad[index] = smoothed = _smoothed(pitch, smoothed)
        over, neutral, held = _smile((left + right) / 2, neutral, held)
        jaw, opening = _opening(open_, jaw, opening)
        smiles, moves = held >= HELD_FRAMES, opening > OPENING
        found[index, 1:] = smiles, smiles and over > BEAM and moves, moves
    nodded, sway = -NODS_APART, 0.0
    swings = np.maximum(_swings_in(pitch_rad), _swings_in(-pitch_rad)).tolist()
    for index in np.flatnonzero(~np.isnan(pitch_rad)).tolist():
        stands_out = swings[index] >= max(NOD_RAD, STANDS_OUT * sway)
        if stands_out and index - nodded >= NODS_APART:
            found[index, 0], nodded = True, index
        sway += _SWAY * (swings[index] - sway)
    return found


def _swings_in(values: Doubles) -> Doubles:
    """Return `_swing` of the second before each frame (N,), as far as it has no NaN."""
    windows = sliding_window_view(np.r_[np.full(WINDOW - 1, np.nan), values], WINDOW)
    whole = np.logical_and.accumulate(~np.isnan(windows[:, ::-1]), axis=1)[:, ::-1]  # since the last NaN
    high = np.where(whole, windows, -np.inf)
    lowest = np.minimum.accumulate(np.where(whole, windows, np.inf), axis=1)
    top, rows = high.argmax(axis=1), np.arange(len(values))
    risen = high[rows, top] - lowest[rows, top]
    return np.where(high[rows, top] - values >= BACK * risen, risen, 0.0)


@dataclass(frozen=True)
class SenseMemory:
    """What is remembered of the person.

    Attributes:
        addressed: as asked for.
        ear: of their voice; deaf: there has been no sound to hear at all.
        attention: smoothed; None before any. looked: 1, 0, or NaN for nobody knows.
        unseen: frames since their face; None before the first.
        tells: somebody has told their attention.
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
    """Evidence (len(HEARD),) after the frame of that index in loop time."""

    frame: int
    heard: Doubles


def sense(speaker: SpeakerFrame, memory: SenseMemory) -> tuple[Sensed, SenseMemory]:
    """Pure. Several streams of one speaker may share it if their `addressed` is the same."""
    deaf = memory.deaf and not len(speaker.audio)
    ear = memory.ear if deaf else voice_activity.step(energy_db(speaker.audio), memory.ear)
    signs, face = read_signs(speaker.face, memory.face)
    looked, watching = _looked(speaker, memory)
    talks = signs.mouth_moves if deaf else ear.active
    nods = signs.nods and not talks and not memory.hearing.voices.speech
    instant = Instant((_sounds(speaker.agent_audio), talks), (math.nan, looked), signs.laughs, nods, signs.smiles)
    heard, remembered = hear(instant, memory.hearing)
    frame = round(speaker.time_s / FRAME_S) - 1
    return Sensed(frame, heard), changed(watching, ear=ear, deaf=deaf, face=face, hearing=remembered)


def scene_in(speaker: Sequence[SpeakerFrame], addressed: Addressed = "sense") -> Scene:
    """What `sense` takes from each frame of a recording; `evidence.heard_in` makes its rows of that."""
    memory = SenseMemory(addressed)
    speaks, looks = np.zeros((len(speaker), 2), bool), np.full((len(speaker), 2), np.nan)
    nods, smiles, laughs, speaks[:, 1] = signs_in([frame.face for frame in speaker]).T
    first = next((index for index, frame in enumerate(speaker) if len(frame.audio)), len(speaker))  # deaf until then
    speaks[first:, 1] = phase.hear(np.array([energy_db(frame.audio) for frame in speaker[first:]]))
    for index, frame in enumerate(speaker):
        speaks[index, 0] = _sounds(frame.agent_audio)
        looks[index, 1], memory = _looked(frame, memory)
    silent = phase.times(speaks[:, 1])[:, 0] == 0
    return Scene(speaks, looks, laughs, nods & silent & np.r_[True, silent][:-1], smiles)


def _sounds(own_voice: Floats | None) -> bool:
    return own_voice is not None and energy_db(own_voice) > OWN_VOICE_DB


def _looked(speaker: SpeakerFrame, memory: SenseMemory) -> tuple[float, SenseMemory]:
    """1, 0 or NaN, and what is remembered of it."""
    if memory.addressed != "sense":
        return float(memory.addressed == "assume"), memory
    if speaker.face is None and speaker.attention is None:
        unseen = None if memory.unseen is None else memory.unseen + 1
        if unseen is None:
            return 1.0, memory
        lost = unseen > LOST_FRAMES
        gone = changed(memory, unseen=unseen, attention=None if lost else memory.attention,
                       looked=math.nan if lost else memory.looked)  # fmt: skip
        return gone.looked, gone
    given = speaker.attention
    if given is None or not math.isfinite(given):
        if given is None and not memory.tells:
            return 1.0, changed(memory, unseen=0)
        return math.nan, changed(memory, unseen=0, attention=None, looked=math.nan)
    before = 1.0 if memory.attention is None else memory.attention
    given = min(max(given, 0.0), 1.0)
    level = given + (before - given) * _KEPT
    looked = 1.0 if math.isnan(memory.looked) else memory.looked
    if level > LOOKED:
        looked = 1.0
    elif level < NOT_LOOKED:
        looked = 0.0
    return looked, changed(memory, unseen=0, attention=level, looked=looked, tells=True)
