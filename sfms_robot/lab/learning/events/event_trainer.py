"""Teaches hazards from meetings: evidence of every step, onsets against the steps in which nothing began.

Of the steps without an onset one in six is kept and counts six times. How good a hazard is: does it rank the onsets of
a person above the other steps in which he might have, his own history as it was (AUC, mean over people).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, Doubles, Floats
from sfms_robot.lab.corpora.compose.ami import MeetingPerson
from sfms_robot.lab.evaluation.phrase_timing import rank_auc
from sfms_robot.lab.evaluation.whole_recordings import Bools, Scene, counts_in, done_in, heard_in
from sfms_robot.lab.learning.events.labels import (
    Lesson,
    Looks,
    MeetingEvidence,
    lesson,
    looks_of,
    meeting_evidence,
    minutes,
    spans_of,
    steps_of,
)
from sfms_robot.listeners.events.evidence import AT, NUMBERS
from sfms_robot.listeners.events.model import STEP_FRAMES, Hazard
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
    meeting = meeting_evidence(person)
    scene = scene_of(meeting)
    spans = spans_of(person, meeting, rng)
    nods = _begun_in(spans["nod"], meeting.listening)
    looks = looks_of(person, meeting, counts_in(scene)) if person.gaze is not None else None
    own = {**spans, "nod": nods} | ({} if looks is None else {"gaze_shift": looks.shifts_s})
    done = done_in(
        own, len(meeting.listening), log_rate(nods, meeting.listening), None if looks is None else looks.aside
    )
    evidence = np.concatenate([heard_in(scene), done], axis=1)
    lessons = {kind: lesson(spans[kind], meeting.listening) for kind in spans}
    if looks is not None:
        lessons["gaze_shift"] = _looking(looks)
    return EventStudent(
        person=person,
        evidence=_as_steps_begin(evidence),
        listening=meeting.listening,
        others=np.asarray(meeting.speaks[:, 1:].any(axis=1)),
        lessons=lessons,
    )


def scene_of(meeting: MeetingEvidence) -> Scene:
    """Return the scene as annotated; smiles were not."""
    return Scene(meeting.speaks, meeting.looks, meeting.laughs, meeting.nods, np.zeros_like(meeting.laughs))


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


def _as_steps_begin(rows: Doubles) -> Doubles:
    """(N, E) known after each frame -> (M, E) known as each step begins; before the first nothing is (NaN)."""
    steps = len(rows) // STEP_FRAMES
    before = np.concatenate([np.full((1, rows.shape[1]), np.nan), rows[STEP_FRAMES - 1 :: STEP_FRAMES]])
    return before[:steps]


def _looking(looks: Looks) -> Lesson:
    at = steps_of(looks.at_speaker)
    begins = np.floor(looks.away_s * FRAME_HZ / STEP_FRAMES + 1e-6).astype(np.int64)
    onsets = np.unique(begins[(begins > 0) & (begins < len(at))])
    may = at.copy()
    may[onsets] = True
    return Lesson(onsets, may)


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


def sampled(students: Iterable[EventStudent], kind: str, seed: int) -> tuple[Doubles, Doubles, Doubles]:
    """Evidence (R, E) of all onsets and of a sixth of the other steps, whether it happens (R,), how often it counts."""
    rows, happens, counts = [], [], []
    for number, one in enumerate(students):
        if kind not in one.lessons:
            continue
        given = one.lessons[kind]
        onset = np.zeros(len(given.may), bool)
        onset[given.onsets] = True
        lot = np.random.default_rng([seed, number]).integers(KEPT, size=len(onset)) == 0
        kept = given.may & (onset | lot)
        rows.append(one.evidence[kept])
        happens.append(onset[kept])
        counts.append(np.where(onset[kept], 1.0, KEPT))
    return np.concatenate(rows), np.concatenate(happens).astype(np.float64), np.concatenate(counts)


def teach(students: Sequence[EventStudent], kind: str, groups: Groups, seed: int = 0, ridge: float = RIDGE) -> Logistic:
    """The hazard of one kind."""
    rows, happens, counts = sampled(students, kind, seed)
    return fit(inputs(rows, groups), happens, counts, ridge=ridge)


def hazard(learned: Logistic, groups: Groups, learned_from: str, per_minute: float) -> Hazard:
    """As it is written down: curves by knot."""
    weights: dict[str, float | dict[float, float]] = {}
    at = 0
    for name, knots in groups.items():
        if name in NUMBERS:
            weights[name] = round(float(learned.weights[at]), 3)
            at += 1
            continue
        count = len(knots) - (name in FORGOTTEN)
        values = [round(float(value), 3) for value in learned.weights[at : at + count]]
        weights[name] = dict(zip(knots, [*values, 0.0][: len(knots)], strict=True))
        at += count
    return Hazard(
        learned_from=learned_from,
        per_minute=round(per_minute, 3),
        intercept=round(learned.intercept, 3),
        weights=weights,
    )


# --- ranking ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ranked:
    """AUC of each person (P,), by name."""

    people: tuple[str, ...]
    auc: Doubles

    @property
    def mean(self) -> float:
        return float(self.auc.mean()) if len(self.auc) else float("nan")

    def interval(self, seed: int = 0, draws: int = 2000) -> tuple[float, float]:
        """95 % of the mean, had other people been met."""
        if len(self.auc) < 2:
            return float("nan"), float("nan")
        drawn = np.random.default_rng(seed).integers(len(self.auc), size=(draws, len(self.auc)))
        low, high = np.quantile(self.auc[drawn].mean(axis=1), [0.025, 0.975])
        return float(low), float(high)


def ranked(students: Iterable[EventStudent], kind: str, score: Callable[[Doubles], Doubles]) -> Ranked:
    """Return how well `score`, (M, E) -> (M,), ranks onsets above other steps; meetings of a person weighted by
    onsets.
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
    means = [float(np.average([auc for auc, _ in each], weights=[n for _, n in each])) for each in found.values()]
    return Ranked(tuple(found), np.array(means))


def rate_per_minute(students: Iterable[EventStudent], kind: str) -> float:
    """Of the time in which they might."""
    pairs = [(len(one.lessons[kind].onsets), minutes(one.lessons[kind].may)) for one in students if kind in one.lessons]
    onsets, time = np.sum(pairs, axis=0) if pairs else (0.0, 0.0)
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


def fit(
    inputs: Floats, happens: Doubles, counts: Doubles, offset: Doubles | None = None, ridge: float = 10.0
) -> Logistic:
    """Maximum likelihood of `happens` (N,) 0 or 1, each row counting `counts` (N,) times, less ridge / 2 * |weights|^2.

    `offset` (N,) is added to the log-odds and not fitted. The intercept is free.
    """
    rows, columns = inputs.shape
    share = float((happens * counts).sum() / counts.sum())
    at = np.r_[np.log(share / (1 - share)), np.zeros(columns)]
    given = np.zeros(rows) if offset is None else offset
    penalty = np.r_[0.0, np.full(columns, ridge)]
    before, fit_before = at, -np.inf
    for _ in range(NEWTON_STEPS):
        goodness, slope, bend = _at(at, inputs, happens, counts, given, penalty)
        while not goodness >= fit_before:  # too far: whoever starts at the mean may overshoot
            at = (at + before) / 2
            goodness, slope, bend = _at(at, inputs, happens, counts, given, penalty)
        before, fit_before = at, goodness - 1e-9 * abs(goodness)
        at = at + np.linalg.solve(bend, slope)
    return Logistic(float(at[0]), at[1:])


def _at(
    at: Doubles, inputs: Floats, happens: Doubles, counts: Doubles, offset: Doubles, penalty: Doubles
) -> tuple[float, Doubles, Doubles]:
    """Penalised log-likelihood, its gradient and its negative curvature."""
    goodness = -0.5 * float(penalty @ at**2)
    slope, bend = -penalty * at, np.diag(penalty + 1e-9)
    for start in range(0, len(inputs), _ROWS):
        part = slice(start, start + _ROWS)
        x = np.concatenate([np.ones((len(inputs[part]), 1)), inputs[part]], axis=1)
        odds = np.clip(x @ at + offset[part], -40, 40)
        chance = 1.0 / (1.0 + np.exp(-odds))
        goodness += float(counts[part] @ (happens[part] * odds - np.log1p(np.exp(odds))))
        slope += x.T @ (counts[part] * (happens[part] - chance))
        bend += x.T @ (x * (counts[part] * chance * (1 - chance))[:, None])
    return goodness, slope, bend
