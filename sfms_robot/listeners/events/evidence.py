"""What decisions are made from: for how long things have been so, from who speaks, who looks, and what was done.

A row of evidence is what is known once a frame is over; whatever comes after it changes nothing. Times are seconds,
`math.inf` for what has never been. NaN: it does not apply, or nobody knows, which speaks neither for nor against
anything. There are two ways to the same numbers: of whole recordings (`heard_in`, `done_in`) and frame by frame
(`hear`, `done`).

Of the others' voices together (`signals.phase`): how long the phrase lasts so far, their silence, the last phrase. The
floor is held by whoever, oneself among them, is in a phrase of a second or more; of several the latest to begin, and
the last one while nobody is. Whose look counts: of those who speak now, else of the holder of the floor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import FRAME_S, Doubles, ListenerEvent
from sfms_robot.signals import phase
from sfms_robot.signals.phase import SpeechPhase

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

# Of the others: seconds, but for flags (0 or 1).
HEARD: Final = (
    "phrase_s", "silence_s", "last_phrase_s",  # of all others together; the phrase only while it lasts
    "one_speaks", "several_speak",
    "floor_mine", "floor_s", "holder_silence_s",  # since the floor changed hands, if it is another's
    "own_voice_s",  # since the newest own voice
    "gaze_known", "looked_at", "looked_at_s", "looked_at_silence_s",  # the last two while looked at
    "laugh_s", "others_nod_s", "others_smile_s",  # since the newest; of a nod since it began
)  # fmt: skip
# Of oneself: seconds since the newest one began or ended, but for the last three.
DONE: Final = (
    "nod_s", "nod_end_s", "mm_hm_s", "laugh_end_s", "smile_end_s", "shake_end_s", "tilt_end_s", "brow_raise_end_s",
    "blink_s", "shift_s", "at_person_s",  # since eyes moved; at_person_s while they are at the person
    "root_nods_30s",  # root of how many began in the last 30 s
    "log_rate",  # natural logarithm of nods a minute: a person's so far, a head's as it is set
)  # fmt: skip
EVIDENCE: Final = HEARD + DONE
NUMBERS: Final = frozenset(
    ("one_speaks", "several_speak", "floor_mine", "gaze_known", "looked_at", "root_nods_30s", "log_rate")
)
AT: Final[Mapping[str, int]] = {name: index for index, name in enumerate(EVIDENCE)}
FLOOR_FRAMES: Final = 25  # a phrase this long takes the floor
COUNTED_S: Final = 30.0
REMEMBERED_S: Final = 64.0  # after it what was done is long ago
_EPS_S: Final = 1e-6
_MINE: Final = 0
_NOBODY: Final = -1


@dataclass(frozen=True)
class Scene:
    """N frames of a conversation of P people, oneself the first.

    Attributes:
        speaks: (N, P).
        looks: (N, P) he looks at me (1) or not (0); NaN: nobody knows. The first column means nothing.
        laughs, smiles: (N,) one of the others does.
        nods: (N,) one of the others begins to.
    """

    speaks: Bools
    looks: Doubles
    laughs: Bools
    nods: Bools
    smiles: Bools


def heard_in(scene: Scene) -> Doubles:
    """(N, len(HEARD))."""
    index = np.arange(len(scene.speaks))
    others = scene.speaks[:, 1:]
    phrase, silence, last = phase.times(np.asarray(others.any(axis=1))).T
    holder, held = _floor_in(scene.speaks)
    spoke = np.maximum.accumulate(np.where(scene.speaks, index[:, None], -np.inf), axis=0)  # (N, P)
    another = holder > _MINE
    relevant = counts_in(scene)[:, 1:]
    looks = scene.looks[:, 1:]
    known = (relevant & ~np.isnan(looks)).any(axis=1)
    looked = (relevant & (looks == 1)).any(axis=1)
    began = np.maximum.accumulate(np.where(looked & ~np.r_[False, looked[:-1]], index, 0))
    speaking = others.sum(axis=1)
    columns = {
        "phrase_s": np.where(phrase > 0, phrase, np.nan),
        "silence_s": silence,
        "last_phrase_s": np.where(last > 0, last, np.nan),
        "one_speaks": speaking == 1,
        "several_speak": speaking > 1,
        "floor_mine": holder == _MINE,
        "floor_s": np.where(another, (index - held) * FRAME_S, np.nan),
        "holder_silence_s": np.where(another, (index - spoke[index, np.maximum(holder, 0)]) * FRAME_S, np.nan),
        "own_voice_s": (index - spoke[:, _MINE]) * FRAME_S,
        "gaze_known": known,
        "looked_at": looked,
        "looked_at_s": np.where(looked, (index - began) * FRAME_S, np.nan),
        "looked_at_silence_s": np.where(looked, silence, np.nan),
        "laugh_s": _since(scene.laughs),
        "others_nod_s": _since(scene.nods),
        "others_smile_s": _since(scene.smiles),
    }
    return np.stack([np.asarray(columns[name], np.float64) for name in HEARD], axis=1)


def counts_in(scene: Scene) -> Bools:
    """(N, P) whose look counts: he speaks, or nobody does and he holds the floor. Never one's own."""
    others = scene.speaks.copy()
    others[:, _MINE] = False
    holder, _ = _floor_in(scene.speaks)
    waiting = ~others.any(axis=1, keepdims=True) & (holder[:, None] == np.arange(others.shape[1]))
    waiting[:, _MINE] = False
    counts: Bools = others | waiting
    return counts


def _since(happens: Bools) -> Doubles:
    """(N,) seconds since the newest True."""
    index = np.arange(len(happens))
    newest = np.maximum.accumulate(np.where(happens, index, -np.inf))
    return np.asarray((index - newest) * FRAME_S, np.float64)


def _floor_in(speaks: Bools) -> tuple[Ints, Ints]:
    """Who holds the floor (N,), -1 nobody yet, and since which frame."""
    frames, people = speaks.shape
    index = np.arange(frames)
    lengths = np.stack([phase.times(speaks[:, who])[:, 0] for who in range(people)], axis=1)
    lengths[lengths < (FLOOR_FRAMES - 0.5) * FRAME_S] = np.inf
    newest = np.maximum.accumulate(np.where(np.isfinite(lengths).any(axis=1), index, -1))
    holder = np.where(newest >= 0, np.argmin(lengths, axis=1)[newest], _NOBODY)
    changed = holder != np.r_[_NOBODY, holder][:-1]
    return holder, np.maximum.accumulate(np.where(changed, index, 0))


@dataclass(frozen=True)
class Instant:
    """One frame of a `Scene`: speaks (P,), looks (P,), and the rest."""

    speaks: tuple[bool, ...]
    looks: tuple[float, ...]
    laughs: bool = False
    nods: bool = False
    smiles: bool = False


@dataclass(frozen=True)
class Hearing:
    """What a stream remembers of the others.

    Attributes:
        frame: how many frames have been heard.
        voices: of all others together; `each` of everybody, oneself the first.
        spoke: the newest frame of each one's voice.
        holder, held: of the floor, and since when.
        looked: since which frame one is looked at, None while not.
        laughed, nodded, smiled: newest frames.
    """

    frame: int
    voices: SpeechPhase
    each: tuple[SpeechPhase, ...]
    spoke: tuple[float, ...]
    holder: int = _NOBODY
    held: int = 0
    looked: int | None = None
    laughed: float = -math.inf
    nodded: float = -math.inf
    smiled: float = -math.inf

    @property
    def own_voice_s(self) -> float:
        """Since the newest own voice; `inf`: there has been none."""
        return (self.frame - 1 - self.spoke[_MINE]) * FRAME_S


def hearing(people: int = 2) -> Hearing:
    """Nothing heard yet of a conversation of so many, oneself among them."""
    return Hearing(0, SpeechPhase(), (SpeechPhase(),) * people, (-math.inf,) * people)


def hear(instant: Instant, before: Hearing) -> tuple[Doubles, Hearing]:
    """One frame -> its row (len(HEARD),) and what is remembered."""
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
    after = Hearing(
        now + 1, voices, each, spoke, holder, held, looked,
        now if instant.laughs else before.laughed,
        now if instant.nods else before.nodded,
        now if instant.smiles else before.smiled,
    )  # fmt: skip
    phrase_s, silence_s, last_s = voices.times_s
    another = holder > _MINE
    row = (
        phrase_s or math.nan, silence_s, last_s or math.nan,
        float(speaking == 1), float(speaking > 1),
        float(holder == _MINE),
        (now - held) * FRAME_S if another else math.nan,
        (now - spoke[holder]) * FRAME_S if another else math.nan,
        after.own_voice_s,
        float(any(look == look for look in counts)),
        float(looked is not None),
        math.nan if looked is None else (now - looked) * FRAME_S,
        math.nan if looked is None else silence_s,
        (now - after.laughed) * FRAME_S, (now - after.nodded) * FRAME_S, (now - after.smiled) * FRAME_S,
    )  # fmt: skip
    return np.array(row), after


# --- what was done ----------------------------------------------------------------------------------------------

_SINCE_END: Final = ("nod", "laugh", "smile", "shake", "tilt", "brow_raise")
_SINCE_BEGIN: Final = {"nod_s": "nod", "mm_hm_s": "mm_hm", "blink_s": "blink"}


def done_in(
    spans_s: Mapping[str, Doubles], frames: int, log_rate: Doubles | float, aside: Bools | None = None
) -> Doubles:
    """(frames, len(DONE)) from spans (K, 2) by kind of `EVENT_KINDS`; kinds that are not there have never been.

    `aside` (K,): which of the gaze shifts go away from the person.
    """
    return done_at(spans_s, np.asarray((np.arange(frames) + 1) * FRAME_S, np.float64), log_rate, aside)


def done_at(
    spans_s: Mapping[str, Doubles], now_s: Doubles, log_rate: Doubles | float, aside: Bools | None = None
) -> Doubles:
    """`done_in` at instants (M,): (M, len(DONE))."""
    columns: dict[str, Doubles | float] = {name: np.full(len(now_s), np.inf) for name in DONE}
    for kind in _SINCE_END:
        columns[f"{kind}_end_s"] = _since_newest(spans_s.get(kind), now_s, ends=True)
    for name, kind in _SINCE_BEGIN.items():
        columns[name] = _since_newest(spans_s.get(kind), now_s)
    nods = np.sort(spans_s.get("nod", np.zeros((0, 2)))[:, 0])
    begun, earlier = (np.searchsorted(nods, now_s - ago_s - _EPS_S) for ago_s in (0.0, COUNTED_S))
    columns["root_nods_30s"] = np.sqrt(begun - earlier)
    columns["log_rate"] = log_rate
    shifts = spans_s.get("gaze_shift", np.zeros((0, 2)))
    columns["shift_s"] = _since_newest(shifts, now_s)
    newest = np.searchsorted(shifts[:, 0], now_s - _EPS_S) - 1
    away = np.zeros(len(shifts), bool) if aside is None else aside
    at_person = (newest < 0) | ~np.r_[away, False][newest]
    columns["at_person_s"] = np.where(at_person, columns["shift_s"], np.nan)
    return np.stack([np.broadcast_to(np.asarray(columns[name], np.float64), now_s.shape) for name in DONE], axis=1)


def _since_newest(spans: Doubles | None, now_s: Doubles, ends: bool = False) -> Doubles:
    """(N,) seconds since the newest span that had begun, began or ended; inf before the first, 0 inside."""
    if spans is None or not len(spans):
        return np.full(len(now_s), np.inf)
    newest = np.searchsorted(spans[:, 0], now_s - _EPS_S) - 1
    at = np.maximum.accumulate(spans[:, 1]) if ends else spans[:, 0]
    return np.where(newest < 0, np.inf, np.maximum(0.0, now_s - at[np.maximum(newest, 0)]))


def done(events: Iterable[ListenerEvent], now_s: float, log_rate: float) -> Doubles:
    """(len(DONE),) at an instant, from events in the order of their beginnings.

    An event that has yet to begin has begun for this purpose if it is among them.
    """
    since = dict.fromkeys(DONE, math.inf)
    nods, aside = 0, False
    for event in events:
        begun_s = max(0.0, now_s - event.start_s)
        kind = event.kind
        if kind == "nod":
            since["nod_s"] = begun_s
            nods += begun_s <= COUNTED_S + _EPS_S
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


def begun_before(events: Sequence[ListenerEvent], now_s: float) -> list[ListenerEvent]:
    """Those that had begun before an instant, and may still matter."""
    return [
        event
        for event in events
        if event.start_s < now_s - _EPS_S and (event.end_s > now_s - REMEMBERED_S or event.kind == "gaze_shift")
    ]


def remembered(events: Sequence[ListenerEvent], now_s: float) -> tuple[ListenerEvent, ...]:
    """What has to be kept of events in order: nods of the last minute, of every other kind the newest."""
    newest = {event.kind: event for event in events}
    return tuple(
        event
        for event in events
        if newest[event.kind] is event or (event.kind == "nod" and event.end_s > now_s - REMEMBERED_S)
    )
