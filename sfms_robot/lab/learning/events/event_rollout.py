"""Nods drawn from a hazard in a person's place: the person's meeting, with the drawn nods fed back.

Between two nods all inputs are known in advance, so a stretch is evaluated as a whole: the first step whose random
number falls below its probability is the next nod.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, Doubles, ListenerEvent
from sfms_robot.lab.evaluation.phrase_timing import phrase_end_counts, phrase_ends, ratio_of
from sfms_robot.lab.evaluation.whole_recordings import Bools, Ints
from sfms_robot.lab.learning.events.event_trainer import EventStudent
from sfms_robot.lab.learning.events.labels import minutes, steps_of
from sfms_robot.listeners.events.evidence import AT, COUNTED_S, DONE, HEARD
from sfms_robot.listeners.events.model import STEP_S, EventModel, HazardBank

STRETCH: Final = 400  # steps looked at together


@dataclass(frozen=True, kw_only=True)
class Nodding:
    """Counts over the listening time of several people; pairs are (nods, minutes).

    Attributes:
        listening, addressed, bystander: in all, and while the speaker looks at the listener or does not.
        phrase_end: see `signals.events.phrase_end_counts`.
        intervals_s: from onset to onset, in listening time.
    """

    listening: tuple[float, float]
    addressed: tuple[float, float]
    bystander: tuple[float, float]
    phrase_end: tuple[float, float, float, float]
    intervals_s: Doubles

    @property
    def ratio(self) -> float:
        return ratio_of(self.phrase_end)


def roll_out(model: EventModel, one: EventStudent, per_minute: float, seed: int) -> list[ListenerEvent]:
    """The nods (nothing else is decided) of one person's place at a knob."""
    evidence = one.evidence.copy()
    own = len(HEARD)
    listening = steps_of(one.listening)[: len(evidence)]
    lots = np.random.default_rng(seed).random(len(evidence))
    at, nods = 1, list[ListenerEvent]()
    bank = HazardBank({"nod": model.tables.hazards["nod"]})
    while at < len(evidence):
        steps = np.arange(at, min(at + STRETCH, len(evidence)))
        rows = evidence[steps]
        rows[:, own:] = _done(nods, np.asarray(steps * STEP_S), float(np.log(per_minute)))
        odds = bank.log_odds(bank.contributions(rows))[:, 0]
        happens = listening[steps] & (lots[steps] < 1 / (1 + np.exp(-odds)))
        if not happens.any():
            at = int(steps[-1]) + 1
            continue
        found = int(steps[np.argmax(happens)])
        nod = model.shaped("nod", found, seed)
        start_s = found * STEP_S
        nods.append(ListenerEvent("nod", start_s, nod.duration_s, nod.size, nod.swings))
        at = int(np.ceil(nods[-1].end_s / STEP_S - 1e-6))
        at = max(at, found + 1)
    return nods


def _done(nods: Sequence[ListenerEvent], now_s: Doubles, log_rate: float) -> Doubles:
    """(M, len(DONE)) of nods alone, all of them over."""
    rows = np.full((len(now_s), len(DONE)), np.inf)
    columns = {name: index for index, name in enumerate(DONE)}
    rows[:, columns["at_person_s"]] = np.nan
    rows[:, columns["log_rate"]] = log_rate
    starts = np.array([nod.start_s for nod in nods[-64:]])
    rows[:, columns["root_nods_30s"]] = np.sqrt((now_s[:, None] - starts <= COUNTED_S + 1e-6).sum(axis=1))
    if nods:
        rows[:, columns["nod_s"]] = now_s - nods[-1].start_s
        rows[:, columns["nod_end_s"]] = np.maximum(0.0, now_s - max(nod.end_s for nod in nods[-4:]))
    return rows


def people_did(one: EventStudent) -> Doubles:
    """Seconds at which he began to nod while listening."""
    starts = one.person.nods[:, 0]
    at = np.floor(starts * FRAME_HZ + 1e-6).astype(np.int64)
    return np.asarray(starts[(at < len(one.listening)) & one.listening[np.minimum(at, len(one.listening) - 1)]])


def count(one: EventStudent, onsets_s: Doubles) -> Nodding:
    """Of one person."""
    listening = steps_of(one.listening)[: len(one.evidence)]
    steps = np.minimum(np.floor(onsets_s / STEP_S + 1e-6).astype(np.int64), len(listening) - 1)
    evidence = one.evidence

    def column(name: str) -> Doubles:
        return evidence[:, AT[name]]

    spoken_to = listening & (column("one_speaks") == 1) & (column("own_voice_s") >= 1) & (column("gaze_known") == 1)
    looked = column("looked_at") == 1
    ends = phrase_ends(one.others, FRAME_HZ)
    listened_s = np.cumsum(listening) * STEP_S
    return Nodding(
        listening=_pair(listening, steps),
        addressed=_pair(spoken_to & looked, steps),
        bystander=_pair(spoken_to & ~looked, steps),
        phrase_end=phrase_end_counts(onsets_s, ends, one.listening, FRAME_HZ),
        intervals_s=np.diff(np.sort(listened_s[steps])),
    )


def _pair(mask: Bools, steps: Ints) -> tuple[float, float]:
    return float(mask[steps].sum()), minutes(mask)


def total(parts: Sequence[Nodding]) -> Nodding:
    """Return the sum over people."""

    def add(name: str) -> Any:
        return tuple(np.sum([getattr(part, name) for part in parts], axis=0).tolist())

    return Nodding(
        listening=add("listening"),
        addressed=add("addressed"),
        bystander=add("bystander"),
        phrase_end=add("phrase_end"),
        intervals_s=np.concatenate([part.intervals_s for part in parts]),
    )


def figures(found: Nodding) -> dict[str, float]:
    def rate(pair: tuple[float, float]) -> float:
        return pair[0] / pair[1] if pair[1] else float("nan")

    return {
        "nods_per_minute": rate(found.listening),
        "addressed_nods_per_minute": rate(found.addressed),
        "bystander_nods_per_minute": rate(found.bystander),
        "phrase_end_ratio": found.ratio,
    }


def interval_distance(one: Nodding, other: Nodding) -> float:
    """Kolmogorov and Smirnov's distance of the times between nods."""
    from scipy import stats

    return float(stats.ks_2samp(one.intervals_s, other.intervals_s).statistic)
