"""When a listener nods, smiles, laughs, says "mm-hm", raises its brows, blinks, looks away: learned from people.

    person's frame -> evidence (sensing) -> log-odds of each kind (hazards) -> a number drawn falls below: event

A hazard is asked every 80 ms. What is decided begins `LEAD_FRAMES` later, so that a plan made every fourth frame still
shows its onset, and is never taken back. Nothing of the head happens inside a nod, a
shake or a tilt; nobody nods, laughs or says "mm-hm" who is speaking or has not been spoken to for two seconds.

Laws: the same evidence and seed give the same events; a later frame changes nothing before; memory is never changed in
place; hazards are finite whatever comes in; more of a `Calmness` rate is never less of its hazard.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.frames import EVENT_KINDS, FRAME_S, Doubles, ListenerEvent, SpeakerFrame, changed
from sfms_robot.listeners.events.evidence import AT, begun_before, done, remembered
from sfms_robot.listeners.events.hazards import STEP_FRAMES, STEP_S, EventTables, HazardBank, load_tables
from sfms_robot.listeners.events.sensing import Sensed, SenseMemory, sense
from sfms_robot.listeners.stream_rng import Use, uniforms
from sfms_robot.signals.event_sizes import SHAKE, SWINGS_HZ, aside, swing_reach_rad, swings

LEAD_FRAMES: Final = 3  # an event decided with frame n begins behind frame n + LEAD_FRAMES
LISTENING_S: Final = 2.0  # somebody else spoke this recently
_LISTENING: Final = ("silence_s", "own_voice_s", "phrase_s", "last_phrase_s")  # what tells it
AT_PERSON: Final = (0.0, 0.0)
# What one thing at a time does: while one of a group is under way none of it begins.
GROUPS: Final = (
    frozenset(("nod", "shake", "tilt")),
    frozenset(("smile", "laugh")),
    frozenset(("mm_hm", "laugh")),
    frozenset(("brow_raise",)),
    frozenset(("blink",)),
    frozenset(("gaze_shift",)),
)
ALWAYS: Final = frozenset(("blink", "gaze_shift"))  # the others only while listening
SWINGING: Final = frozenset(("nod", "shake"))
ANGLES: Final = frozenset(("nod", "shake", "tilt", "gaze_shift"))  # sizes are degrees
EXCLUDES: Final[Mapping[str, frozenset[str]]] = {
    kind: frozenset().union(*(group for group in GROUPS if kind in group)) for kind in EVENT_KINDS
}


@dataclass(frozen=True)
class Decision:
    """What a frame has decided.

    Attributes:
        events: new ones; most frames have none.
        hazards_hz: by kind, events a second if things stayed as they are; 0 while it cannot happen.
    """

    events: tuple[ListenerEvent, ...]
    hazards_hz: Mapping[str, float]


@dataclass(frozen=True)
class DecideMemory:
    """What one stream remembers of its own doing.

    Attributes:
        seed, calmness: of the stream.
        done: events decided, in order, as far as they still matter.
        hazards_hz: the last ones asked for.
    """

    seed: int
    calmness: Calmness
    done: tuple[ListenerEvent, ...] = ()
    hazards_hz: Mapping[str, float] | None = None


@dataclass(frozen=True)
class EventMemory:
    """What one stream remembers: of the person, and of itself."""

    sensed: SenseMemory
    decided: DecideMemory


class EventModel:
    """Holds what was learned; streams are values."""

    def __init__(self, tables: EventTables) -> None:
        self.tables = tables
        self.bank = HazardBank(tables.hazards)
        self.draws = [EVENT_KINDS.index(kind) for kind in self.bank.kinds]
        self._never: Mapping[str, float] = dict.fromkeys(EVENT_KINDS, 0.0)
        self.asked_odds = lru_cache(maxsize=64)(self._asked_odds)  # asked for with every frame, by all streams

    @classmethod
    def load(cls, file: Path | None = None) -> EventModel:
        """From a file as `train events` writes it, or the bundled one. Raises ConfigError."""
        return cls(load_tables(file))

    def start(self, seed: int, calmness: Calmness | None = None) -> EventMemory:
        """Nothing heard, nothing done."""
        asked = calmness or Calmness()
        return EventMemory(SenseMemory(asked.addressed), DecideMemory(seed, asked))

    def calmed(self, memory: EventMemory, calmness: Calmness) -> EventMemory:
        """The same stream, from now on at other rates."""
        return EventMemory(
            changed(memory.sensed, addressed=calmness.addressed), changed(memory.decided, calmness=calmness)
        )

    def step(
        self, speaker: SpeakerFrame, memory: EventMemory, own: Sequence[ListenerEvent] | None = None
    ) -> tuple[Decision, EventMemory]:
        """One frame of 40 ms -> what it decides. Pure; takes some 0.1 ms.

        `own` replaces the history of what was decided by somebody's real one; what has not begun by now is not looked
        at.
        """
        sensed, heard = sense(speaker, memory.sensed)
        decision, decided = self.decide(sensed, memory.decided, own)
        return decision, EventMemory(heard, decided)

    def decide(
        self, sensed: Sensed, memory: DecideMemory, own: Sequence[ListenerEvent] | None = None
    ) -> tuple[Decision, DecideMemory]:
        """The second half of `step`. A gaze shift away is followed by one back when its time is over."""
        if not _asks(sensed):
            return Decision((), memory.hazards_hz or self._never), memory
        now_s = (sensed.frame + 1) * FRAME_S
        history = memory.done if own is None else begun_before(own, now_s)
        told = self.bank.contributions(self._evidence(sensed, history, memory.calmness))
        return self._drawn(sensed, memory, history, self.bank.log_odds(told), told)

    def step_each(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[EventMemory]
    ) -> list[tuple[Decision, EventMemory]]:
        """`step` of several streams: their hazards are asked together."""
        sensed = [sense(speaker, memory.sensed) for speaker, memory in zip(speakers, memories, strict=True)]
        found = [(Decision((), memory.decided.hazards_hz or self._never), memory.decided) for memory in memories]
        asking = [row for row, (one, _) in enumerate(sensed) if _asks(one)]
        if asking:
            own = [memories[row].decided for row in asking]
            evidence = [
                self._evidence(sensed[row][0], one.done, one.calmness) for row, one in zip(asking, own, strict=True)
            ]
            told = self.bank.contributions(np.array(evidence))
            for row, one, odds, terms in zip(asking, own, self.bank.log_odds(told), told, strict=True):
                found[row] = self._drawn(sensed[row][0], one, one.done, odds, terms)
        return [
            (decision, EventMemory(heard, decided))
            for (decision, decided), (_, heard) in zip(found, sensed, strict=True)
        ]

    def _drawn(
        self, sensed: Sensed, memory: DecideMemory, history: Sequence[ListenerEvent], log_odds: Doubles, told: Doubles
    ) -> tuple[Decision, DecideMemory]:
        """What happens, by lot, of log-odds (H,) as they are learned, and the terms (T,) that they are of."""
        now_s = (sensed.frame + 1) * FRAME_S
        odds = [own + more for own, more in zip(log_odds.tolist(), self.asked_odds(memory.calmness), strict=True)]
        may = _may_happen(sensed, history, now_s)
        draws = uniforms(memory.seed, sensed.frame, Use.EVENT, len(EVENT_KINDS))[self.draws]
        hazards, events = dict(self._never), list(self._look_back(sensed.frame, history, now_s))
        for at, kind in enumerate(self.bank.kinds):
            if kind not in may or memory.calmness.per_minute(kind) == 0:
                continue
            probability = 1.0 / (1.0 + math.exp(-odds[at]))
            hazards[kind] = probability / STEP_S
            if draws[at] < probability and not any(event.kind in EXCLUDES[kind] for event in events):
                event = self.shaped(kind, sensed.frame, memory.seed)
                events.append(
                    changed(event, probability=probability, draw=float(draws[at]), evidence=self.bank.told(told, kind))
                )
        kept = remembered((*memory.done, *events), now_s) if events else memory.done
        return Decision(tuple(events), hazards), changed(memory, done=kept, hazards_hz=hazards)

    def _evidence(self, sensed: Sensed, history: Sequence[ListenerEvent], calmness: Calmness) -> Doubles:
        """(len(EVIDENCE),) of a frame and of what was done before it."""
        nods = calmness.nod or self.tables.hazards["nod"].per_minute
        return np.concatenate([sensed.heard, done(history, (sensed.frame + 1) * FRAME_S, math.log(nods))])

    def _asked_odds(self, calmness: Calmness) -> list[float]:
        """What the rates asked for add to the log-odds of each kind that does not have them among its evidence."""
        learned = self.tables.hazards
        return [
            math.log(asked / learned[kind].per_minute)
            if (asked := calmness.per_minute(kind)) and "log_rate" not in learned[kind].weights
            else 0.0
            for kind in self.bank.kinds
        ]

    def _look_back(self, frame: int, history: Sequence[ListenerEvent], now_s: float) -> tuple[ListenerEvent, ...]:
        """The look back at the person, once looking away is over."""
        shift = next((event for event in reversed(history) if event.kind == "gaze_shift"), None)
        if shift is None or shift.target_rad in (None, AT_PERSON) or shift.end_s > _begin_s(frame) + 1e-9:
            return ()
        until_s = 60.0 / self.tables.hazards["gaze_shift"].per_minute
        return (ListenerEvent("gaze_shift", _begin_s(frame), until_s, shift.size, target_rad=AT_PERSON),)

    def shaped(self, kind: str, frame: int, seed: int) -> ListenerEvent:
        """Draw the duration, size and direction of an event; no larger than a head can get within a swing."""
        shape = self.tables.shapes[kind]
        part = EVENT_KINDS.index(kind)
        long, large, side, up = uniforms(seed, frame, Use.COURSE, 4, part).tolist()
        habit, pace = uniforms(seed, 0, Use.HABIT, 2, part).tolist()
        duration_s = quantile(shape.duration_s, long)
        size = quantile(shape.size, large) * quantile(shape.habit, habit)
        size = min(max(size, shape.size[0]), shape.size[-1])
        size = math.radians(size) if kind in ANGLES else size
        times = 1
        if kind in SWINGING:
            times, duration_s = swings(duration_s, quantile(shape.swings_hz or SWINGS_HZ, pace))
            size = min(size, swing_reach_rad(duration_s / times) * (SHAKE if kind == "shake" else 1.0))
        target = aside(size, side, up) if kind == "gaze_shift" else None
        return ListenerEvent(kind, _begin_s(frame), duration_s, size, times, target)


def _asks(sensed: Sensed) -> bool:
    """Whether hazards are asked at the end of this frame."""
    return sensed.frame % STEP_FRAMES == STEP_FRAMES - 1


def quantile(values: Sequence[float], share: float) -> float:
    """Evenly spaced quantiles as a distribution: its value at 0..1."""
    return float(np.interp(share * (len(values) - 1), np.arange(len(values)), values))


def _begin_s(frame: int) -> float:
    return (frame + 1 + LEAD_FRAMES) * FRAME_S


def _may_happen(sensed: Sensed, history: Sequence[ListenerEvent], now_s: float) -> frozenset[str]:
    """Kinds that the moment allows."""
    silence_s, own_s, phrase_s, last_s = (sensed.heard.item(AT[name]) for name in _LISTENING)
    listening = silence_s <= LISTENING_S and own_s > 0 and not (math.isnan(phrase_s) and math.isnan(last_s))
    under_way = {event.kind for event in history if event.end_s > now_s and event.kind != "gaze_shift"}
    shift = next((event for event in reversed(history) if event.kind == "gaze_shift"), None)
    if shift is not None and (shift.target_rad != AT_PERSON or shift.start_s > now_s):
        under_way.add("gaze_shift")
    return frozenset(kind for kind in EVENT_KINDS if (listening or kind in ALWAYS) and not EXCLUDES[kind] & under_way)
