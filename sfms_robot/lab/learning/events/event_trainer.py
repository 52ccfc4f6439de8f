"""Fits of hazards on meetings: evidence of every step, onsets compared with the steps in which no event began.

    nod, shake, tilt, laugh, mm_hm     as annotated
    smile, brow_raise                  not annotated: drawn as in composed dyads, from smiles and laughs of others, own
                                       "mm-hm" and nods, and from questions asked; with a reaction time
    gaze_shift                         a look away from a person who speaks or has the floor, where annotated

A hazard is evaluated every 80 ms; an event belongs to the step in which it begins. Of the steps without an onset one in
six is kept and counts six times. A hazard is judged by how it ranks the onsets of a person above the other steps in
which they were possible, given the person's history (AUC, mean over people).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import FRAME_HZ, FRAME_S, Bools, Doubles, Floats, Ints
from sfms_robot.lab.corpora.compose.ami import MeetingPerson, interval_table
from sfms_robot.lab.corpora.compose.composed import Stretch, active, spans_by
from sfms_robot.lab.corpora.compose.motions import Rng
from sfms_robot.lab.corpora.phrase_timing import (
    listening_mask,
    near,
    phrase_end_counts,
    phrase_ends,
    rank_auc,
    ratio_of,
)
from sfms_robot.lab.evaluation.intervals import Sums
from sfms_robot.lab.evaluation.whole_recordings import Scene, counts_in, done_at, heard_in, unspoken
from sfms_robot.listeners.events.evidence import AT, HEARD, MINE, NUMBERS
from sfms_robot.listeners.events.model import LEAD_FRAMES, LISTENING_S, STEP_FRAMES, STEP_S, Hazard
from sfms_robot.signals import event_sizes as sizes
from sfms_robot.signals.phase import piecewise_linear_basis

_Number = TypeVar("_Number", bound=np.generic)
Knots = tuple[float, ...]
Groups = Mapping[str, Knots]  # evidence -> knots of its curve; no knots for a number

KEPT: Final = 6  # one of this many steps without an onset is kept
PRIOR_NODS, PRIOR_PER_MINUTE = 3.0, 2.2  # prior of a person's rate of nods so far
LEAST_ONSETS: Final = 3  # onsets of a person in a meeting that are needed to rank them
# Evidence that has no effect after a long time: its last basis function is left out, its last value is 0.
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
OWN_VOICE: Final[Groups] = {"own_voice_s": _LONG, "own_voice_known": ()}
GAZE: Final[Groups] = {
    "gaze_known": (),
    "looked_at": (),
    "looked_at_s": (0.0, 0.3, 0.8, 1.6, 3.0, 6.0),
    "looked_at_silence_s": (0.0, 0.24, 0.6, 1.3, 4.0),
}
OTHERS: Final[Groups] = {"laugh_s": _LAUGH, "others_nod_s": (0.0, 0.4, 0.8, 1.5, 3.0, 6.0, 12.0)}
STUDY: Final[Groups] = {  # 89 inputs
    **PHASE,
    **FLOOR,
    "own_voice_s": _LONG,
    "nod_end_s": _LONG,
    "root_nods_30s": (),
    "log_rate": (),
    **GAZE,
    **OTHERS,
}
STUDY_RIDGE, RIDGE = 10.0, 3.0  # `RIDGE`, and the evidence added below, did better on validation
THEIR_SMILE: Final[Groups] = {"others_smile_s": (0.0, 0.06, 0.12, 0.24, 0.4, 0.8, 1.6, 3.2)}
GROUPS: Final[Mapping[str, Groups]] = {
    "nod": {**STUDY, **OWN_VOICE, "mm_hm_s": _WHILE, "laugh_end_s": _WHILE},
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
    "smile": {**PHASE, **OWN_VOICE, "nod_s": _SHORT, "mm_hm_s": _SHORT, "laugh_s": _LAUGH, **THEIR_SMILE},
    "brow_raise": {**PHASE, **OWN_VOICE, "nod_s": _SHORT},
    **{
        kind: {
            "silence_s": _SILENCE,
            "one_speaks": (),
            "several_speak": (),
            **OWN_VOICE,
            f"{kind}_end_s": _LONG,
            **GAZE,
        }
        for kind in ("shake", "tilt")
    },
    "gaze_shift": {**PHASE, **FLOOR, **OWN_VOICE, "at_person_s": (0.0, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8), "nod_s": _SHORT},
}


LEARNED: Final = ("nod", "shake", "tilt", "laugh", "smile", "mm_hm", "brow_raise", "gaze_shift")
REACTION_S: Final = 0.3  # of a smile after a laugh, of brows after a question
SEEN_S: Final = 0.68  # from the onset of another's smile until `evidence` has it; no smile is returned earlier
LEAD_S: Final = LEAD_FRAMES * FRAME_S  # from a decision until its event begins
BROWS: Final = {"question": 0.5, "nod": 0.15}
SMILE_S, BROW_S = 1.6, 0.8


@dataclass(frozen=True, kw_only=True)
class EventStudent:
    """Training rows of one person in one meeting: M steps of 80 ms.

    Attributes:
        scene: Scene of all frames.
        evidence: (M, len(EVIDENCE)) at the beginning of each step.
        listening: (N,) frames in which the person listens.
        lessons: by kind.
    """

    person: MeetingPerson
    scene: Scene
    evidence: Doubles
    listening: Bools
    lessons: Mapping[str, Lesson]


def student(person: MeetingPerson, rng: Rng) -> EventStudent:
    """Return the training rows of one person; `rng` draws the events that were not annotated."""
    scene, listening = meeting_scene(person)
    smiles, laughs = sizes.others_smiles(len(listening) * FRAME_S, rng.spawn(1)[0]), person.others_laughs
    # Laughs are visible as `render_events.speaker_motion` shows them.
    seen = np.stack([laughs[:, 0] - 0.2, laughs[:, 1] + 1.1, np.full(len(laughs), np.mean(sizes.LAUGH))], axis=1)
    shown = np.zeros(len(listening))  # sizes of smiles, from when they are seen until they end
    for start, end, size in np.concatenate([smiles, seen]).tolist():
        first = max(0, _seen(start))
        shown[first : max(first + 1, round(end * FRAME_HZ))] = size
    scene = replace(scene, smiles=shown)
    spans = spans_of(person, rng, smiles)
    nods = begun_in(spans["nod"], listening)
    heard = heard_in(scene)
    smiled = (heard[:, AT["others_smile_s"]] <= LISTENING_S) & ~scene.speaks[:, MINE]
    lessons = {kind: lesson(each, listening | smiled if kind == "smile" else listening) for kind, each in spans.items()}
    own, aside = {**spans, "nod": nods}, None
    if person.gaze is not None:
        own["gaze_shift"], aside, lessons["gaze_shift"] = looks_of(person, scene)
    ends_s = np.arange(1.0, len(listening) + 1) * FRAME_S
    rows = np.concatenate([heard, done_at(own, ends_s, log_rate(nods, listening), aside)], axis=1)
    return EventStudent(
        person=person, scene=scene, evidence=by_step(rows, np.nan), listening=listening, lessons=lessons
    )


def _seen(start_s: float) -> int:
    """Return the frame in which a smile from `start_s` on is first seen."""
    return round((start_s + SEEN_S) * FRAME_HZ)


def muted(one: EventStudent) -> EventStudent:
    """Return the rows without the person's own voice in the evidence."""
    evidence = one.evidence.copy()
    evidence[:, : len(HEARD)] = by_step(heard_in(unspoken(one.scene)), np.nan)
    return replace(one, evidence=evidence)


def log_rate(nods_s: Doubles, listening: Bools) -> Doubles:
    """Return (N,) the logarithm of a person's nods per minute of listening so far.

    It is shrunk toward the mean while the listening time is short.
    """
    begun = np.searchsorted(np.sort(nods_s[:, 0]), (np.arange(len(listening)) + 1) * FRAME_S - 1e-6)
    listened = np.cumsum(listening) / FRAME_HZ / 60
    return np.log((begun + PRIOR_NODS) / (listened + PRIOR_NODS / PRIOR_PER_MINUTE))


def step_at(times_s: Doubles, step_s: float) -> Ints:
    """Return the index of the step of this length in which each time lies; a time just before a step counts in it."""
    return np.floor(times_s / step_s + 1e-6).astype(np.int64)


def begun_in(spans: Doubles, mask: Bools) -> Doubles:
    """Return those of the spans (K, 2) that begin in frames of a mask (N,)."""
    at = step_at(spans[:, 0], FRAME_S)
    return spans[(at < len(mask)) & mask[np.minimum(at, len(mask) - 1)]]


# --- labels: events of one person of a meeting, and the steps in which they could have happened ---------------------


@dataclass(frozen=True)
class Lesson:
    """One kind of event of one person, M steps of 80 ms.

    Attributes:
        onsets: (K,) steps in which an event begins that could begin there.
        may: (M,) steps in which an event could begin: the person listens and no such event is under way.
    """

    onsets: Ints
    may: Bools


def by_step(frames: NDArray[_Number], before: float = False) -> NDArray[_Number]:
    """Map frames (N, ...) to steps (N // 2, ...), by the last frame before each; `before` for the first."""
    known = np.concatenate([np.full_like(frames[:1], before), frames[STEP_FRAMES - 1 :: STEP_FRAMES]])
    return known[: len(frames) // STEP_FRAMES]


def spans_of(person: MeetingPerson, rng: Rng, others_smiles: Doubles) -> dict[str, Doubles]:
    """Return spans (K, 2) of all events of the person; those that were not annotated are drawn.

    `others_smiles`: (K, 3) start, end [s], size. A smile is returned at the earliest when it can be seen.
    """
    nods, after = person.nods[:, 0], sizes.SMILES_AFTER
    smiles = [_some(person.others_laughs[:, 0], after["laugh"], rng) + REACTION_S]
    smiles += [_some(person.mm_hms[:, 0], after["mm_hm"], rng), _some(nods, after["nod"], rng)]
    for smile in others_smiles:
        answers = sizes.returned(smile[None], rng)
        first = np.ceil((_seen(smile[0]) + 1) / STEP_FRAMES) * STEP_S  # the first step that has it in its evidence
        smiles.append(np.maximum(answers[:, 0] - LEAD_S, first))
    brows = _some(person.asked, BROWS["question"], rng)
    return {
        "nod": person.nods,
        "shake": person.shakes,
        "tilt": person.tilts,
        "laugh": person.laughs,
        "mm_hm": person.mm_hms,
        "smile": _spans(np.concatenate(smiles), SMILE_S),
        "brow_raise": _spans(np.r_[brows + REACTION_S, _some(nods, BROWS["nod"], rng)], BROW_S),
    }


def _some(at_s: Doubles, share: float, rng: Rng) -> Doubles:
    return at_s[rng.random(len(at_s)) < share]


def _spans(starts_s: Doubles, length_s: float) -> Doubles:
    starts = np.sort(starts_s)
    return np.stack([starts, starts + length_s], axis=1)


def lesson(spans_s: Doubles, listening: Bools) -> Lesson:
    """Return the lesson of events (K, 2); no event can begin inside another."""
    taken = near(spans_s + [0.0, -FRAME_S], len(listening), 0.0)
    begins = step_at(spans_s[:, 0], STEP_S)
    heard = by_step(listening)
    onsets = np.unique(begins[(begins >= 0) & (begins < len(heard))])
    onsets = onsets[heard[onsets]]
    may = heard & ~taken[: len(heard) * STEP_FRAMES : STEP_FRAMES]  # an event counts as over once it ends
    may[onsets] = True
    return Lesson(onsets, may)


def looks_of(person: MeetingPerson, scene: Scene) -> tuple[Doubles, Bools, Lesson]:
    """Return the gaze of a person with annotations: the spans (K, 2) from each shift to the next, aside (K,), a lesson.

    A look goes aside if its target neither speaks nor has the floor. In the lesson the gaze leaves a target that speaks
    or has the floor.
    """
    counts, gaze, agents = counts_in(scene), person.gaze or (), agents_of(person)
    frames = len(counts)
    target = np.zeros(frames, np.int64)  # column of the person looked at; 0, oneself, for anything else
    columns = [agents.index(where) if where in agents else 0 for _, _, where in gaze]
    first = [min(max(round(start * FRAME_HZ), 0), frames - 1) for start, _, _ in gaze]
    for column, begin, (_, end, _) in zip(columns, first, gaze, strict=True):
        target[begin : max(begin, round(end * FRAME_HZ))] = column
    at_speaker = (target > 0) & counts[np.arange(frames), target]
    aside = np.array(
        [not (column and counts[begin, column]) for column, begin in zip(columns, first, strict=True)], bool
    )
    away = [start for (start, _, _), begin, goes in zip(gaze, first, aside, strict=True)
            if goes and begin and at_speaker[begin - 1]]  # fmt: skip
    may = by_step(at_speaker)
    begins = step_at(np.array(away), STEP_S)
    onsets = np.unique(begins[(begins > 0) & (begins < len(may))])
    may[onsets] = True
    return interval_table(look[:2] for look in gaze), aside, Lesson(onsets, may)


def minutes(mask: Bools) -> float:
    """Return the minutes of steps in which a mask is True."""
    return float(mask.sum()) * STEP_S / 60


# --- A meeting from the place of one of its people, frame by frame: who speaks, who looks at them, who laughs and nods
#
# `listeners.events.evidence` computes its numbers from this; annotations replace a microphone and a camera.


def agents_of(person: MeetingPerson) -> tuple[str, ...]:
    """Return the letters of the people of a meeting: the participant, then the others by letter."""
    return (person.agent, *sorted(set(person.words) - {person.agent}))


def meeting_scene(person: MeetingPerson) -> tuple[Scene, Bools]:
    """Return the scene of the whole time in which a person's head was annotated, by `agents_of`, and listening (N,).

    Looks are NaN where not annotated; smiles were not annotated.
    """
    whole = Stretch(person=person, start_s=0.0, end_s=int(person.until_s * FRAME_HZ) / FRAME_HZ)
    agents = agents_of(person)
    speaks = [active(person.words.get(agent, np.zeros((0, 2))), whole) for agent in agents]
    looks = np.full((whole.frames, len(agents)), np.nan)
    for column, agent in enumerate(agents[1:], start=1):
        if agent in person.gaze_known:
            looks[:, column] = active(spans_by(person.looked_at, agent), whole)
    nods = np.zeros(whole.frames, bool)
    at = step_at(spans_by(person.others_nods)[:, 0], FRAME_S)
    nods[at[(at >= 0) & (at < whole.frames)]] = True
    laughs = active(person.others_laughs, whole)
    scene = Scene(np.stack(speaks, axis=1), looks, laughs, nods, np.zeros(whole.frames))
    return scene, listening_in(person, whole)


def listening_in(person: MeetingPerson, stretch: Stretch) -> Bools:
    """Return a mask (N,): others spoke in the last 2 s, and the participant is silent and in view."""
    others, own, unseen = (active(spans, stretch) for spans in (person.others, person.talk, person.unseen))
    listening: Bools = listening_mask(others, own) & ~unseen
    return listening


# --- fitting ----------------------------------------------------------------------------------------------------


def inputs(evidence: Doubles, groups: Groups) -> Floats:
    """Map evidence (M, len(EVIDENCE)) to inputs (M, K): basis functions of curves, and numbers, by group."""
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
    """Return the fitted hazard in the form of the file, with curves by knot."""
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


# --- Logistic regression with a ridge, by Newton's method: few inputs, many rows, no options ----------------------

NEWTON_STEPS: Final = 8
_ROWS: Final = 65_536  # rows processed at once


@dataclass(frozen=True)
class Logistic:
    """log-odds = intercept + inputs @ weights (K,)."""

    intercept: float
    weights: Doubles

    def log_odds(self, inputs: Floats) -> Doubles:
        """Return the log-odds (N,) of inputs (N, K)."""
        return self.intercept + inputs @ self.weights


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
        while not goodness >= fit_before:  # the step was too long: it may overshoot from the mean
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


# --- nods of people and of hazards, counted in the same way ----------------------------------------------------------


def count(one: EventStudent, onsets_s: Doubles) -> tuple[Sums, Doubles]:
    """Return the counts of one person's nods: pairs (nods, minutes); and the intervals [s] in listening time."""
    listening = by_step(one.listening)[: len(one.evidence)]
    steps = np.minimum(step_at(onsets_s, STEP_S), len(listening) - 1)
    one_speaks, own_voice_s, known, looked_at = one.evidence[
        :, [AT[name] for name in ("one_speaks", "own_voice_s", "gaze_known", "looked_at")]
    ].T
    spoken_to = listening & (one_speaks == 1) & (own_voice_s >= 1) & (known == 1)
    masks = {"": listening, "addressed_": spoken_to & (looked_at == 1), "bystander_": spoken_to & (looked_at != 1)}
    others = np.asarray(one.scene.speaks[:, 1:].any(axis=1))
    counts = phrase_end_counts(onsets_s, phrase_ends(others), one.listening)
    rates = {f"{who}nods_per_minute": np.array([mask[steps].sum(), minutes(mask)]) for who, mask in masks.items()}
    return {**rates, "phrase_end": np.array(counts)}, np.diff(np.sort(np.cumsum(listening)[steps] * STEP_S))


def figures(found: Sums) -> dict[str, float]:
    """Return the rates and the phrase-end ratio of counts; NaN where they are not defined."""
    rates = {name: pair[0] / pair[1] if pair[1] else np.nan for name, pair in found.items() if "minute" in name}
    return {**rates, "phrase_end_ratio": ratio_of(found["phrase_end"].tolist())}
