"""Labels for the hazards: events of one person of a meeting, and the steps in which they could have happened.

    nod, shake, tilt, laugh, mm_hm     as annotated
    smile, brow_raise                  not annotated: drawn as in composed dyads, from laughs of others, own
                                       "mm-hm" and nods, and from questions asked; a reaction late
    gaze_shift                         a look away from a person who speaks or has the floor, where annotated

A hazard is evaluated every 80 ms; an event belongs to the step in which it begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, Doubles
from sfms_robot.lab.corpora.compose.ami import MeetingPerson
from sfms_robot.lab.corpora.compose.composed import Stretch, active
from sfms_robot.lab.evaluation.phrase_timing import listening_mask, near
from sfms_robot.lab.evaluation.whole_recordings import Bools, Ints, Scene, counts_in
from sfms_robot.listeners.events.model import STEP_FRAMES, STEP_S

LEARNED: Final = ("nod", "shake", "tilt", "laugh", "smile", "mm_hm", "brow_raise", "gaze_shift")
REACTION_S: Final = 0.3  # of a smile to a laugh, of brows to a question
SMILES: Final = {"laugh": 0.6, "mm_hm": 0.3, "nod": 0.12}  # shares followed by a smile: others' laughs, own the rest
BROWS: Final = {"question": 0.5, "nod": 0.15}
SMILE_S, BROW_S = 1.6, 0.8


@dataclass(frozen=True)
class Lesson:
    """One kind of event of one person, M steps of 80 ms.

    Attributes:
        onsets: (K,) steps in which one begins that could.
        may: (M,) steps in which it could begin: the person listens and is not inside one.
    """

    onsets: Ints
    may: Bools


def steps_of(mask: Bools) -> Bools:
    """Map frames (N,) to steps (N // 2,), by the last frame before each; nothing holds before the first."""
    before: Bools = np.r_[False, mask[STEP_FRAMES - 1 :: STEP_FRAMES]]
    return before[: len(mask) // STEP_FRAMES]


def spans_of(person: MeetingPerson, rng: np.random.Generator) -> dict[str, Doubles]:
    """Return spans (K, 2) of all events of the person; those that were not annotated are drawn."""
    others, nods = person.others_laughs[:, 0], person.nods[:, 0]
    smiles = _some(others, SMILES["laugh"], rng), _some(person.mm_hms[:, 0], SMILES["mm_hm"], rng)
    brows = _some(person.asked, BROWS["question"], rng)
    return {
        "nod": person.nods,
        "shake": person.shakes,
        "tilt": person.tilts,
        "laugh": person.laughs,
        "mm_hm": person.mm_hms,
        "smile": _spans(np.r_[smiles[0] + REACTION_S, smiles[1], _some(nods, SMILES["nod"], rng)], SMILE_S),
        "brow_raise": _spans(np.r_[brows + REACTION_S, _some(nods, BROWS["nod"], rng)], BROW_S),
    }


def _some(at_s: Doubles, share: float, rng: np.random.Generator) -> Doubles:
    return at_s[rng.random(len(at_s)) < share]


def _spans(starts_s: Doubles, length_s: float) -> Doubles:
    starts = np.sort(starts_s)
    return np.stack([starts, starts + length_s], axis=1)


def lesson(spans_s: Doubles, listening: Bools) -> Lesson:
    """Return the lesson of events (K, 2); none begins inside another."""
    taken = near(spans_s + [0.0, -FRAME_S], len(listening), FRAME_HZ, 0.0)
    begins = np.floor(spans_s[:, 0] / STEP_S + 1e-6).astype(np.int64)
    heard = steps_of(listening)
    onsets = np.unique(begins[(begins >= 0) & (begins < len(heard))])
    onsets = onsets[heard[onsets]]
    may = heard & ~taken[: len(heard) * STEP_FRAMES : STEP_FRAMES]  # that one is over is known as it ends
    may[onsets] = True
    return Lesson(onsets, may)


def looks_of(person: MeetingPerson, scene: Scene) -> tuple[Doubles, Bools, Lesson]:
    """Return the gaze of a person with annotations: the spans (K, 2) from each shift to the next, aside (K,), a lesson.

    A look goes aside if its target neither speaks nor has the floor. In the lesson the gaze leaves such a person.
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
    may = steps_of(at_speaker)
    begins = np.floor(np.array(away) * FRAME_HZ / STEP_FRAMES + 1e-6).astype(np.int64)
    onsets = np.unique(begins[(begins > 0) & (begins < len(may))])
    may[onsets] = True
    return np.array([look[:2] for look in gaze], np.float64).reshape(-1, 2), aside, Lesson(onsets, may)


def minutes(mask: Bools) -> float:
    """Return the minutes of steps in which a mask is True."""
    return float(mask.sum()) * STEP_S / 60


# --- A meeting from the place of one of its people, frame by frame: who speaks, who looks at them, who laughs and nods
#
# `listeners.events.evidence` makes its numbers of that; annotations take the place of a microphone and a camera.


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
    at = np.floor(spans_by(person.others_nods)[:, 0] * FRAME_HZ + 1e-6).astype(np.int64)
    nods[at[(at >= 0) & (at < whole.frames)]] = True
    laughs = active(person.others_laughs, whole)
    scene = Scene(np.stack(speaks, axis=1), looks, laughs, nods, np.zeros_like(laughs))
    return scene, listening_in(person, whole)


def listening_in(person: MeetingPerson, stretch: Stretch) -> Bools:
    """Return (N,): others spoke in the last 2 s, the participant is silent and in view."""
    others, own, unseen = (active(spans, stretch) for spans in (person.others, person.talk, person.unseen))
    return listening_mask(others, FRAME_HZ, own) & ~unseen


def spans_by(events_s: Sequence[tuple[float, float, str]], agent: str | None = None) -> Doubles:
    """Return the spans (K, 2) of events (start, end, agent) of one agent, or of all."""
    return np.array([(a, b) for a, b, who in events_s if agent in (None, who)], np.float64).reshape(-1, 2)
