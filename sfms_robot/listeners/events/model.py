"""Decisions of a listener to nod, smile, laugh, say "mm-hm", raise its brows, blink or look away: learned from people.

    person's frame -> evidence -> log-odds of each kind (hazards) -> a drawn number is below the probability: event

A hazard is the probability of an event in the next 80 ms. Its log-odds are a sum of curves learned from people, one per
named evidence. `sim/listeners/events.yaml` holds for every kind an intercept and, per evidence (`events.evidence`),
either a factor of the evidence or the values of a curve at its knots; between knots it is straight over
log(1 + seconds / 0.2). A curve whose last value is 0 has no effect after a long time. `gaze_shift` is the hazard of
looking away from the person.

Hazards are drawn every 80 ms. An event begins `LEAD_FRAMES` after it is decided, so that a plan made every fourth frame
still shows its onset, and is never revoked. No other event of the head begins during a nod, a shake or a tilt; a head
does not nod, laugh or say "mm-hm" while it speaks, or if no other person has spoken for two seconds. The size of a
returned smile depends on that of the person.

Laws: the same evidence and seed lead to the same events; a later frame changes nothing before; memory is never changed
in place; hazards are finite for any input; a higher rate in `Calmness` never lowers its hazard.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import Field

from sfms_robot.config import Calmness, Model, load
from sfms_robot.config.base import Finite, NonNegative, Positive
from sfms_robot.data import data_dir
from sfms_robot.frames import EVENT_KINDS, FRAME_S, Doubles, Events, ListenerEvent, SpeakerFrame, changed
from sfms_robot.listeners.events.evidence import AT, EVIDENCE, NUMBERS, Sensed, SenseMemory, done, remembered, sense
from sfms_robot.listeners.stream_rng import Use, uniforms
from sfms_robot.signals.event_sizes import RETURN_SIZE, SHAKE, SWINGS_HZ, aside, swing_reach_rad, swings
from sfms_robot.signals.phase import log_time

STEP_FRAMES: Final = 2
STEP_S: Final = 0.08
FILE: Final = "events.yaml"  # in sim/listeners
_BOUND: Final = 30.0  # largest absolute log-odds
_IS_NUMBER: Final = np.array([name in NUMBERS for name in EVIDENCE])

Curve = Annotated[dict[NonNegative, Finite], Field(min_length=2)]
Quantiles = Annotated[tuple[NonNegative, ...], Field(min_length=2)]


class Hazard(Model):
    """The hazard of one kind of event.

    Attributes:
        learned_from: people whose events these are.
        per_minute: their rate, in the time in which the event may happen.
        intercept: log-odds of 80 ms without evidence.
        weights: factor or curve of each evidence, by name.
    """

    learned_from: str
    per_minute: Positive
    intercept: Finite
    weights: Annotated[dict[str, Finite | Curve], Field(min_length=1)]

    def contradictions(self) -> Iterator[str]:
        for name, weight in self.weights.items():
            if name not in EVIDENCE:
                yield f"weights.{name} is not known evidence ({', '.join(EVIDENCE)})"
            if isinstance(weight, dict) == (name in NUMBERS):
                wanted = "one number" if name in NUMBERS else "values by knot [s]"
                yield f"weights.{name} needs {wanted}"
            if isinstance(weight, dict) and list(weight) != sorted(weight):
                yield f"weights.{name}: knots have to rise"


class Shape(Model):
    """The distribution of durations and sizes, as evenly spaced quantiles from the least to the greatest.

    Attributes:
        duration_s: duration of the whole event; for looking away, until the look back.
        size: see `frames.ListenerEvent`; nods, shakes, tilts and gaze shifts in degrees.
        habit: quantiles of the factor of a stream's sizes; drawn once per stream.
        swings_hz: quantiles of the pace of nods and shakes; drawn once per stream.
    """

    duration_s: Quantiles
    size: Quantiles
    habit: Quantiles = (1.0, 1.0)
    swings_hz: Quantiles | None = None

    def contradictions(self) -> Iterator[str]:
        for name, values in self:
            if values is not None and list(values) != sorted(values):
                yield f"{name}: quantiles have to rise"


class EventTables(Model):
    """The content of the file: hazards and shapes, by kind; every kind has both."""

    hazards: dict[str, Hazard]
    shapes: dict[str, Shape]

    def contradictions(self) -> Iterator[str]:
        for section, given in self:
            for kind in [*given, *EVENT_KINDS]:
                if kind not in EVENT_KINDS or kind not in given:
                    problem = "is missing" if kind in EVENT_KINDS else "is not a kind of event"
                    yield f"{section}: {kind} {problem} ({', '.join(EVENT_KINDS)})"


def load_tables(file: Path | None = None) -> EventTables:
    """Load a file as `train events` writes it, or the bundled one. Raises ConfigError, in one line."""
    return load(EventTables, data_dir("sim") / "listeners" / FILE if file is None else file)


class HazardBank:
    """All hazards, computed at once for one row of evidence or for many.

    A curve is its first value plus slopes times the part of each interval between two knots that has passed; a factor
    is one interval without ends.
    """

    def __init__(self, hazards: Mapping[str, Hazard]) -> None:
        self.kinds = tuple(hazards)
        self.terms = tuple(tuple(hazard.weights) for hazard in hazards.values())
        self._intercepts = np.array([hazard.intercept for hazard in hazards.values()])
        self._first_term = np.cumsum([0, *map(len, self.terms)])  # index of the first term of each kind
        base: list[float] = []  # first value of each term
        first: list[int] = []  # index of the first interval of each term
        intervals: list[tuple[float, ...]] = []  # column of the evidence, first knot, least and most passed, slope
        for hazard in hazards.values():
            for name, weight in hazard.weights.items():
                first.append(len(intervals))
                if isinstance(weight, Mapping):
                    at, values = log_time(list(weight)), np.array([*weight.values()])
                    base.append(values[0])
                    columns = np.full(len(at) - 1, AT[name]), at[:-1], np.zeros(len(at) - 1)
                    intervals += zip(*columns, np.diff(at), np.diff(values) / np.diff(at), strict=True)
                else:
                    base.append(0.0)
                    intervals.append((AT[name], 0.0, -np.inf, np.inf, weight))
        self._base, self._first = np.array(base), np.array(first)
        column, self._knot, self._least, self._most, self._slope = np.array(intervals, np.float64).T
        self._column = column.astype(np.int64)

    def contributions(self, evidence: Doubles) -> Doubles:
        """Return the terms (..., T) of each kind's log-odds, from evidence (..., len(EVIDENCE)); NaN adds 0."""
        axis = np.where(_IS_NUMBER, evidence, log_time(np.maximum(evidence, 0.0)))
        passed = np.minimum(np.maximum(axis[..., self._column] - self._knot, self._least), self._most)
        terms = self._base + np.add.reduceat(self._slope * passed, self._first, axis=-1)
        return np.where(np.isnan(terms), 0.0, terms)

    def log_odds(self, contributions: Doubles) -> Doubles:
        """Return the log-odds (..., H) of terms (..., T); always finite."""
        total = self._intercepts + np.add.reduceat(contributions, self._first_term[:-1], axis=-1)
        return np.asarray(np.minimum(np.maximum(np.where(np.isnan(total), 0.0, total), -_BOUND), _BOUND), np.float64)

    def largest(self, contributions: Doubles, kind: str) -> dict[str, float]:
        """Return the four largest terms of one kind, by evidence, of terms (T,)."""
        at = self.kinds.index(kind)
        own = zip(self.terms[at], contributions[self._first_term[at] :].tolist(), strict=False)
        largest = sorted(own, key=lambda term: -abs(term[1]))[:4]
        return {name: round(value, 3) for name, value in largest if value}


# --- Decisions --------------------------------------------------------------------------------------------------------

LEAD_FRAMES: Final = 3  # an event decided with frame n begins after frame n + LEAD_FRAMES
LISTENING_S: Final = 2.0  # longest time since another person spoke
_LISTENING: Final = ("silence_s", "own_voice_s", "phrase_s", "last_phrase_s", "others_smile_s")
AT_PERSON: Final = (0.0, 0.0)
# While one event of a group is in progress, no other event of that group begins.
GROUPS: Final = (
    frozenset(("nod", "shake", "tilt")),
    frozenset(("smile", "laugh")),
    frozenset(("mm_hm", "laugh")),
    frozenset(("brow_raise",)),
    frozenset(("blink",)),
    frozenset(("gaze_shift",)),
)
ALWAYS: Final = frozenset(("blink", "gaze_shift"))  # the others begin only while listening
SWINGING: Final = frozenset(("nod", "shake"))
ANGLES: Final = frozenset(("nod", "shake", "tilt", "gaze_shift"))  # their sizes in the tables are in degrees
EXCLUDES: Final[Mapping[str, frozenset[str]]] = {
    kind: frozenset().union(*(group for group in GROUPS if kind in group)) for kind in EVENT_KINDS
}


_NEVER: Final[Mapping[str, float]] = dict.fromkeys(EVENT_KINDS, 0.0)


@dataclass(frozen=True, kw_only=True)
class EventMemory:
    """The memory of one stream.

    Attributes:
        sensed: memory of the person.
        seed, calmness: seed and rates of the stream.
        done: decided own events that still matter, in order.
        hazards_hz: the last hazards that were drawn, by kind: events a second if all evidence stayed the same; 0 while
            the event cannot happen.
    """

    sensed: SenseMemory
    seed: int
    calmness: Calmness
    done: Events = ()
    hazards_hz: Mapping[str, float] = field(default_factory=lambda: _NEVER)


class EventModel:
    """The learned hazards and shapes; streams are values (`EventMemory`)."""

    def __init__(self, tables: EventTables) -> None:
        self.tables = tables
        self.bank = HazardBank(tables.hazards)
        self.draws = [EVENT_KINDS.index(kind) for kind in self.bank.kinds]
        self.asked_odds = lru_cache(maxsize=64)(self._asked_odds)  # needed for every drawn frame of all streams

    @classmethod
    def load(cls, file: Path | None = None) -> EventModel:
        """Load a file as `train events` writes it, or the bundled one. Raises ConfigError."""
        return cls(load_tables(file))

    def start(self, seed: int, calmness: Calmness | None = None) -> EventMemory:
        """Return the memory of a new stream."""
        asked = calmness or Calmness()
        return EventMemory(sensed=SenseMemory(addressed=asked.addressed), seed=seed, calmness=asked)

    def calmed(self, memory: EventMemory, calmness: Calmness) -> EventMemory:
        """Return the memory with other rates from now on."""
        return changed(memory, sensed=changed(memory.sensed, addressed=calmness.addressed), calmness=calmness)

    def step_each(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[EventMemory]
    ) -> list[tuple[Events, EventMemory]]:
        """Process a frame of 40 ms of each stream; return the decided events and the memory after it. Pure."""
        sensed = [sense(speaker, memory.sensed) for speaker, memory in zip(speakers, memories, strict=True)]
        decided = self.decide_each([one for one, _ in sensed], memories)
        return [(events, changed(own, sensed=heard)) for (events, own), (_, heard) in zip(decided, sensed, strict=True)]

    def decide_each(
        self, sensed: Sequence[Sensed], memories: Sequence[EventMemory]
    ) -> list[tuple[Events, EventMemory]]:
        """Draw the hazards of several streams, all of them together: the second half of `step_each`.

        A gaze shift away is followed by a shift back when its duration is over.
        """
        found: list[tuple[Events, EventMemory]] = [((), memory) for memory in memories]
        rows = [row for row, one in enumerate(sensed) if one.frame % STEP_FRAMES == STEP_FRAMES - 1]
        if rows:
            learned = self.tables.hazards["nod"].per_minute
            rates = [math.log(memory.calmness.nod or learned) for memory in memories]
            did = [done(memories[row].done, (sensed[row].frame + 1) * FRAME_S, rates[row]) for row in rows]
            evidence = np.concatenate([[sensed[row].heard for row in rows], did], axis=1)
            terms = self.bank.contributions(evidence)
            for row, odds, own in zip(rows, self.bank.log_odds(terms), terms, strict=True):
                found[row] = self._drawn(sensed[row], memories[row], odds, own)
        return found

    def _drawn(
        self, sensed: Sensed, memory: EventMemory, log_odds: Doubles, terms: Doubles
    ) -> tuple[Events, EventMemory]:
        """Return the events drawn from learned log-odds (H,) and their terms (T,), and the memory after them."""
        now_s = (sensed.frame + 1) * FRAME_S
        odds = [own + more for own, more in zip(log_odds.tolist(), self.asked_odds(memory.calmness), strict=True)]
        may = _may_happen(sensed, memory.done, now_s)
        draws = uniforms(memory.seed, sensed.frame, Use.EVENT, len(EVENT_KINDS))[self.draws]
        hazards, events = dict(_NEVER), list(self._look_back(sensed.frame, memory.done))
        for at, kind in enumerate(self.bank.kinds):
            if kind not in may or memory.calmness.per_minute(kind) == 0:
                continue
            probability = 1.0 / (1.0 + math.exp(-odds[at]))
            hazards[kind] = probability / STEP_S
            if draws[at] < probability and not any(event.kind in EXCLUDES[kind] for event in events):
                event = self.shaped(kind, sensed.frame, memory.seed)
                if kind == "smile" and sensed.heard.item(AT["others_smile_s"]) <= LISTENING_S:
                    theirs = RETURN_SIZE * sensed.heard.item(AT["others_smile"])
                    event = changed(event, size=max(theirs, self.tables.shapes[kind].size[0]))
                events.append(
                    changed(
                        event, probability=probability, draw=float(draws[at]), evidence=self.bank.largest(terms, kind)
                    )
                )
        kept = remembered((*memory.done, *events), now_s) if events else memory.done
        return tuple(events), changed(memory, done=kept, hazards_hz=hazards)

    def _asked_odds(self, calmness: Calmness) -> list[float]:
        """Return the log-odds that requested rates add to each kind; 0 for kinds with `log_rate` in their evidence."""
        learned = self.tables.hazards
        return [
            math.log(asked / learned[kind].per_minute)
            if (asked := calmness.per_minute(kind)) and "log_rate" not in learned[kind].weights
            else 0.0
            for kind in self.bank.kinds
        ]

    def _look_back(self, frame: int, history: Events) -> Events:
        """Return the look back at the person, once looking away is over."""
        shift = last_shift(history)
        if shift is None or shift.target_rad in (None, AT_PERSON) or shift.end_s > _begin_s(frame) + 1e-9:
            return ()
        until_s = 60.0 / self.tables.hazards["gaze_shift"].per_minute
        return (ListenerEvent("gaze_shift", _begin_s(frame), until_s, shift.size, target_rad=AT_PERSON),)

    def shaped(self, kind: str, frame: int, seed: int) -> ListenerEvent:
        """Draw the duration, size and direction of an event, at most as large as a head can reach within a swing."""
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


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value at `share` (0..1) of a distribution given by evenly spaced quantiles."""
    return float(np.interp(share * (len(values) - 1), np.arange(len(values)), values))


def last_shift(events: Sequence[ListenerEvent]) -> ListenerEvent | None:
    """Return the newest gaze shift, if there is any."""
    return next((event for event in reversed(events) if event.kind == "gaze_shift"), None)


def _begin_s(frame: int) -> float:
    return (frame + 1 + LEAD_FRAMES) * FRAME_S


def _may_happen(sensed: Sensed, history: Events, now_s: float) -> frozenset[str]:
    """Return the kinds that may begin at this moment."""
    silence_s, own_s, phrase_s, last_s, smile_s = (sensed.heard.item(AT[name]) for name in _LISTENING)
    listening = silence_s <= LISTENING_S and own_s > 0 and not (math.isnan(phrase_s) and math.isnan(last_s))
    possible = ALWAYS if not listening else frozenset(EVENT_KINDS)
    if smile_s <= LISTENING_S and own_s > 0:  # a smile is returned to a silent person too
        possible |= {"smile"}
    under_way = {event.kind for event in history if event.end_s > now_s and event.kind != "gaze_shift"}
    shift = last_shift(history)
    if shift is not None and (shift.target_rad != AT_PERSON or shift.start_s > now_s):
        under_way.add("gaze_shift")
    return frozenset(kind for kind in possible if not EXCLUDES[kind] & under_way)
