"""Fits of hazards on meetings: evidence of every step, onsets against the steps in which nothing began.

Of the steps without an onset one in six is kept and counts six times. A hazard is judged by how it ranks the onsets of
a person above the other steps in which they were possible, given the person's history (AUC, mean over people).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, Doubles, Floats, ListenerEvent
from sfms_robot.lab.corpora.compose.ami import MeetingPerson
from sfms_robot.lab.evaluation.intervals import Sums
from sfms_robot.lab.evaluation.phrase_timing import phrase_end_counts, phrase_ends, rank_auc, ratio_of
from sfms_robot.lab.evaluation.whole_recordings import Bools, done_at, event_spans, heard_in
from sfms_robot.lab.learning.events.labels import (
    Lesson,
    lesson,
    looks_of,
    meeting_scene,
    minutes,
    spans_of,
    steps_of,
)
from sfms_robot.listeners.events.evidence import AT, HEARD, NUMBERS
from sfms_robot.listeners.events.model import STEP_FRAMES, STEP_S, EventModel, Hazard, HazardBank
from sfms_robot.signals.phase import piecewise_linear_basis

Knots = tuple[float, ...]
Groups = Mapping[str, Knots]  # evidence -> knots of its curve; none for a number

KEPT: Final = 6  # of the steps without an onset, one in so many
PRIOR_NODS, PRIOR_PER_MINUTE = 3.0, 2.2  # of a person's rate so far
LEAST_ONSETS: Final = 3  # of a person in a meeting, to be ranked
# Long ago these no longer matter: their last hat is left out, their last value 0.
FORGOTTEN: Final = frozenset(
    ("holder_silence_s", "own_voice_s", "nod_s", "nod_end_s", "mm_hm_s", "laugh_end_s", "smile_end_s", "shake_end_s",
     "tilt_end_s", "brow_raise_end_s", "looked_at_silence_s", "laugh_s", "others_nod_s", "others_smile_s")
)  # fmt: skip

_SILENCE: Final = (0.0, 0.12, 0.24, 0.4, 0.6, 0.9, 1.3, 2.0, 4.0, 8.0)
_LONG: Final = (0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
_LAUGH: Final = (0.0, 0.4, 1.0, 2.0, 4.0, 8.0)
_WHILE: Final = (0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0)
_SHORT: Final = (0.0, 0.2, 0.5, 1.0, 2.0, 4.0)
PHASE: Final[Groups] = {
    "phrase_s": (0.0, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0, 8.0, 16.0),
    "silence_s": _SILENCE,
    "last_phrase_s": (0.0, 0.4, 0.8, 1.5, 3.0, 6.0, 12.0),
    "one_speaks": (),
    "several_speak": (),
}
FLOOR: Final[Groups] = {
    "floor_mine": (),
    "floor_s": (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
    "holder_silence_s": _SILENCE,
}
OWN_VOICE: Final[Groups] = {"own_voice_s": _LONG}
OWN_NODS: Final[Groups] = {"nod_end_s": _LONG, "root_nods_30s": (), "log_rate": ()}
GAZE: Final[Groups] = {
    "gaze_known": (),
    "looked_at": (),
    "looked_at_s": (0.0, 0.3, 0.8, 1.6, 3.0, 6.0),
    "looked_at_silence_s": (0.0, 0.24, 0.6, 1.3, 4.0),
}
OTHERS: Final[Groups] = {"laugh_s": _LAUGH, "others_nod_s": (0.0, 0.4, 0.8, 1.5, 3.0, 6.0, 12.0)}
NOD: Final[Groups] = {**PHASE, **FLOOR, **OWN_VOICE, **OWN_NODS, **GAZE, **OTHERS}  # 89 inputs: the study's
STUDY_RIDGE, RIDGE = 10.0, 3.0  # the second, and what is added below, did better on validation
GROUPS: Final[Mapping[str, Groups]] = {
    "nod": {**NOD, "mm_hm_s": _WHILE, "laugh_end_s": _WHILE},
    "mm_hm": {**PHASE, **FLOOR, **OWN_VOICE, "nod_s": _SHORT, "mm_hm_s": _LONG, **GAZE, **OTHERS},
    "laugh": {
        **PHASE,
        **FLOOR,
        **OWN_VOICE,
        **GAZE,
        **OTHERS,
        "laugh_end_s": (*_LAUGH, 16.0, 32.0, 64.0),
        "nod_s": _WHILE,
    },
    "smile": {**PHASE, **OWN_VOICE, "nod_s": _SHORT, "mm_hm_s": _SHORT, "laugh_s": _LAUGH},
    "brow_raise": {**PHASE, **OWN_VOICE, "nod_s": _SHORT},
    "shake": {"silence_s": _SILENCE, "one_speaks": (), "several_speak": (), **OWN_VOICE, "shake_end_s": _LONG, **GAZE},
    "tilt": {"silence_s": _SILENCE, "one_speaks": (), "several_speak": (), **OWN_VOICE, "tilt_end_s": _LONG, **GAZE},
    "gaze_shift": {**PHASE, **FLOOR, **OWN_VOICE, "at_person_s": (0.0, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8), "nod_s": _SHORT},
}


@dataclass(frozen=True, kw_only=True)
class EventStudent:
    """Training rows of one person in one meeting: M steps of 80 ms.

    Attributes:
        evidence: (M, len(EVIDENCE)) as each step begins.
        listening, others: (N,) frames in which the person listens, and in which another one speaks.
        lessons: by kind.
    """

    person: MeetingPerson
    evidence: Doubles
    listening: Bools
    others: Bools
    lessons: Mapping[str, Lesson]


def student(person: MeetingPerson, rng: np.random.Generator) -> EventStudent:
    """Return the training rows of one person; `rng` draws the events that were not annotated."""
    scene, listening = meeting_scene(person)
    spans = spans_of(person, rng)
    nods = _begun_in(spans["nod"], listening)
    lessons = {kind: lesson(each, listening) for kind, each in spans.items()}
    own, aside = {**spans, "nod": nods}, None
    if person.gaze is not None:
        own["gaze_shift"], aside, lessons["gaze_shift"] = looks_of(person, scene)
    ends_s = np.arange(1.0, len(listening) + 1) * FRAME_S
    rows = np.concatenate([heard_in(scene), done_at(own, ends_s, log_rate(nods, listening), aside)], axis=1)
    before = np.concatenate([np.full((1, rows.shape[1]), np.nan), rows[STEP_FRAMES - 1 :: STEP_FRAMES]])
    return EventStudent(
        person=person,
        evidence=before[: len(rows) // STEP_FRAMES],  # known as each step begins: before the first, nothing
        listening=listening,
        others=np.asarray(scene.speaks[:, 1:].any(axis=1)),
        lessons=lessons,
    )


def log_rate(nods_s: Doubles, listening: Bools) -> Doubles:
    """Return (N,) the logarithm of a person's nods per minute of listening so far, shrunk toward the mean while it
    is short.
    """
    begun = np.searchsorted(np.sort(nods_s[:, 0]), (np.arange(len(listening)) + 1) * FRAME_S - 1e-6)
    listened = np.cumsum(listening) / FRAME_HZ / 60
    return np.asarray(np.log((begun + PRIOR_NODS) / (listened + PRIOR_NODS / PRIOR_PER_MINUTE)))


def _begun_in(spans: Doubles, mask: Bools) -> Doubles:
    at = np.floor(spans[:, 0] * FRAME_HZ + 1e-6).astype(np.int64)
    return spans[(at < len(mask)) & mask[np.minimum(at, len(mask) - 1)]]


# --- fitting ----------------------------------------------------------------------------------------------------


def inputs(evidence: Doubles, groups: Groups) -> Floats:
    """(M, len(EVIDENCE)) -> (M, K): hats of curves and plain numbers, in the order of the groups."""
    parts = []
    for name, knots in groups.items():
        value = evidence[:, AT[name]]
        if name in NUMBERS:
            parts.append(np.nan_to_num(value)[:, None])
        else:
            parts.append(piecewise_linear_basis(value, knots)[:, : -1 if name in FORGOTTEN else None])
    return np.concatenate(parts, axis=1).astype(np.float32)


def teach(students: Iterable[EventStudent], kind: str, groups: Groups, seed: int = 0, ridge: float = RIDGE) -> Logistic:
    """Fit the hazard of one kind on all onsets and a sixth of the other steps."""
    rows, happens, counts = [], [], []
    for number, one in enumerate(students):
        if (given := one.lessons.get(kind)) is not None:
            onset = np.isin(np.arange(len(given.may)), given.onsets)
            lot = np.random.default_rng([seed, number]).integers(KEPT, size=len(onset)) == 0
            kept = given.may & (onset | lot)
            rows.append(one.evidence[kept])
            happens.append(onset[kept])
            counts.append(np.where(onset[kept], 1.0, KEPT))
    happened = np.concatenate(happens).astype(np.float64)
    return fit(inputs(np.concatenate(rows), groups), happened, np.concatenate(counts), ridge)


def hazard(learned: Logistic, groups: Groups, learned_from: str, per_minute: float) -> Hazard:
    """As it is written down: curves by knot."""
    weights: dict[str, float | dict[float, float]] = {}
    at = 0
    for name, knots in groups.items():
        count = 1 if name in NUMBERS else len(knots) - (name in FORGOTTEN)
        values = [round(float(value), 3) for value in learned.weights[at : at + count]]
        weights[name] = values[0] if name in NUMBERS else dict(zip(knots, [*values, 0.0], strict=False))
        at += count
    return Hazard(
        learned_from=learned_from,
        per_minute=round(per_minute, 3),
        intercept=round(learned.intercept, 3),
        weights=weights,
    )


# --- ranking ----------------------------------------------------------------------------------------------------


def ranked(students: Iterable[EventStudent], kind: str, score: Callable[[Doubles], Doubles]) -> Doubles:
    """Return the AUC of each person (P,): how well `score`, (M, E) -> (M,), ranks onsets above other steps.

    Meetings of a person are weighted by onsets.
    """
    found: dict[str, list[tuple[float, int]]] = {}
    for one in students:
        given = one.lessons.get(kind)
        if given is None or len(given.onsets) < LEAST_ONSETS:
            continue
        others = given.may.copy()
        others[given.onsets] = False
        auc = rank_auc(score(one.evidence), given.onsets, others)
        if np.isfinite(auc):
            found.setdefault(one.person.participant, []).append((auc, len(given.onsets)))
    return np.array(
        [np.average(aucs, weights=onsets) for aucs, onsets in (zip(*each, strict=True) for each in found.values())]
    )


def rate_per_minute(students: Iterable[EventStudent], kind: str) -> float:
    """Return the onsets per minute of the time in which they may happen; 0 without any."""
    lessons = [one.lessons[kind] for one in students if kind in one.lessons]
    onsets, time = sum(len(one.onsets) for one in lessons), sum(minutes(one.may) for one in lessons)
    return float(onsets / time) if time else 0.0


# --- Logistic regression with a ridge, by Newton's method: few inputs, many rows, no options ----------------------

NEWTON_STEPS: Final = 8
_ROWS: Final = 65_536  # at once


@dataclass(frozen=True)
class Logistic:
    """log-odds = intercept + inputs @ weights (K,)."""

    intercept: float
    weights: Doubles

    def log_odds(self, inputs: Floats) -> Doubles:
        """(N, K) -> (N,)."""
        return np.asarray(self.intercept + inputs @ self.weights, np.float64)


def fit(inputs: Floats, happens: Doubles, counts: Doubles, ridge: float = 10.0) -> Logistic:
    """Maximise the likelihood of `happens` (N,) 0 or 1, less ridge / 2 * |weights|^2; the intercept is free.

    Each row of the inputs (N, K) counts `counts` (N,) times.
    """
    columns = inputs.shape[1]
    share = float((happens * counts).sum() / counts.sum())
    at = np.r_[np.log(share / (1 - share)), np.zeros(columns)]
    penalty = np.r_[0.0, np.full(columns, ridge)]
    before, fit_before = at, -np.inf
    for _ in range(NEWTON_STEPS):
        goodness, slope, bend = _at(at, inputs, happens, counts, penalty)
        while not goodness >= fit_before:  # too far: a start at the mean may overshoot
            at = (at + before) / 2
            goodness, slope, bend = _at(at, inputs, happens, counts, penalty)
        before, fit_before = at, goodness - 1e-9 * abs(goodness)
        at = at + np.linalg.solve(bend, slope)
    return Logistic(float(at[0]), at[1:])


def _at(
    at: Doubles, inputs: Floats, happens: Doubles, counts: Doubles, penalty: Doubles
) -> tuple[float, Doubles, Doubles]:
    """Return the penalised log-likelihood, its gradient and its negative curvature."""
    goodness = -0.5 * float(penalty @ at**2)
    slope, bend = -penalty * at, np.diag(penalty + 1e-9)
    for start in range(0, len(inputs), _ROWS):
        part = slice(start, start + _ROWS)
        x = np.concatenate([np.ones((len(inputs[part]), 1)), inputs[part]], axis=1)
        odds = np.clip(x @ at, -40, 40)
        chance = 1.0 / (1.0 + np.exp(-odds))
        goodness += float(counts[part] @ (happens[part] * odds - np.log1p(np.exp(odds))))
        slope += x.T @ (counts[part] * (happens[part] - chance))
        bend += x.T @ (x * (counts[part] * chance * (1 - chance))[:, None])
    return goodness, slope, bend


# --- Roll-out --------------------------------------------------------------------------------------------------------
#
# Between two nods all inputs are known in advance, so a stretch is evaluated as a whole: the first step whose random
# number falls below its probability is the next nod.

STRETCH: Final = 400  # steps looked at together


def roll_out(model: EventModel, one: EventStudent, per_minute: float, seed: int) -> list[ListenerEvent]:
    """Return the nods (nothing else is decided) in one person's place at a rate."""
    evidence = one.evidence.copy()
    own = len(HEARD)
    listening = steps_of(one.listening)[: len(evidence)]
    draws = np.random.default_rng(seed).random(len(evidence))
    at, nods = 1, list[ListenerEvent]()
    bank = HazardBank({"nod": model.tables.hazards["nod"]})
    while at < len(evidence):
        steps = np.arange(at, min(at + STRETCH, len(evidence)))
        rows = evidence[steps]
        now_s = np.asarray(steps * STEP_S, np.float64)
        rows[:, own:] = done_at({"nod": event_spans(nods, "nod")}, now_s, float(np.log(per_minute)))
        odds = bank.log_odds(bank.contributions(rows))[:, 0]
        happens = listening[steps] & (draws[steps] < 1 / (1 + np.exp(-odds)))
        if not happens.any():
            at = int(steps[-1]) + 1
            continue
        found = int(steps[np.argmax(happens)])
        nod = model.shaped("nod", found, seed)
        nods.append(ListenerEvent("nod", found * STEP_S, nod.duration_s, nod.size, nod.swings))
        at = max(found + 1, int(np.ceil(nods[-1].end_s / STEP_S - 1e-6)))
    return nods


def people_did(one: EventStudent) -> Doubles:
    """Return the onsets [s] of the person's nods while listening."""
    return _begun_in(one.person.nods, one.listening)[:, 0]


def count(one: EventStudent, onsets_s: Doubles) -> tuple[Sums, Doubles]:
    """Return the counts of one person's nods: pairs (nods, minutes); and the intervals [s] in listening time."""
    listening = steps_of(one.listening)[: len(one.evidence)]
    steps = np.minimum(np.floor(onsets_s / STEP_S + 1e-6).astype(np.int64), len(listening) - 1)
    one_speaks, own_voice_s, known, looked_at = one.evidence[
        :, [AT[name] for name in ("one_speaks", "own_voice_s", "gaze_known", "looked_at")]
    ].T
    spoken_to = listening & (one_speaks == 1) & (own_voice_s >= 1) & (known == 1)
    masks = {"": listening, "addressed_": spoken_to & (looked_at == 1), "bystander_": spoken_to & (looked_at != 1)}
    counts = phrase_end_counts(onsets_s, phrase_ends(one.others, FRAME_HZ), one.listening, FRAME_HZ)
    rates = {f"{who}nods_per_minute": np.array([mask[steps].sum(), minutes(mask)]) for who, mask in masks.items()}
    return {**rates, "phrase_end": np.array(counts)}, np.diff(np.sort(np.cumsum(listening)[steps] * STEP_S))


def figures(found: Sums) -> dict[str, float]:
    """Return the rates and the phrase-end ratio of counts; NaN where they are not defined."""
    rates = {name: pair[0] / pair[1] if pair[1] else np.nan for name, pair in found.items() if "minute" in name}
    return {**rates, "phrase_end_ratio": ratio_of(found["phrase_end"].tolist())}
