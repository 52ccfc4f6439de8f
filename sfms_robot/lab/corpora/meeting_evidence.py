"""A meeting as one of its people lived it, frame by frame: who spoke, who looked at him, who laughed and nodded.

What `listeners.events.evidence` makes its numbers of, from annotations where a head has a microphone and a camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sfms_robot.frames import FRAME_HZ, Doubles
from sfms_robot.lab.corpora.compose.ami import Person
from sfms_robot.lab.corpora.compose.composed import Stretch, active
from sfms_robot.lab.evaluation.phrase_timing import listening_mask
from sfms_robot.signals.events import Bools


@dataclass(frozen=True)
class MeetingEvidence:
    """N frames; the people are himself, then the others by letter.

    Attributes:
        agents: letters of the P people.
        speaks: (N, P) a word of each is under way.
        looks: (N, P) each looks at him (1) or not (0); NaN where nobody annotated, and of himself.
        laughs: (N,) one of the others does. Nobody annotated smiles.
        nods: (N,) one of the others begins to.
        listening: (N,) others spoke in the last 2 s, he is silent and in view.
        spans_s: (K, 2) of what he did, by kind.
    """

    agents: tuple[str, ...]
    speaks: Bools
    looks: Doubles
    laughs: Bools
    nods: Bools
    listening: Bools
    spans_s: Mapping[str, Doubles]


def meeting_evidence(person: Person) -> MeetingEvidence:
    """Of the whole time in which his head was annotated."""
    whole = Stretch(person, 0.0, int(person.until_s * FRAME_HZ) / FRAME_HZ)
    others = sorted(set(person.words) - {person.agent})
    speaks = [active(person.words.get(agent, np.zeros((0, 2))), whole) for agent in (person.agent, *others)]
    looks = np.full((whole.frames, len(others) + 1), np.nan)
    for column, agent in enumerate(others, start=1):
        if agent in person.gaze_known:
            looks[:, column] = active(_of(person.looked_at, agent), whole)
    own, talk = active(person.talk, whole), active(person.others, whole)
    return MeetingEvidence(
        (person.agent, *others),
        np.stack(speaks, axis=1),
        looks,
        active(person.others_laughs, whole),
        _beginnings((start for start, _, _ in person.others_nods), whole.frames),
        listening_mask(talk, FRAME_HZ, own) & ~active(person.unseen, whole),
        {
            "nod": person.nods,
            "shake": person.shakes,
            "tilt": person.tilts,
            "laugh": person.laughs,
            "mm_hm": person.mm_hms,
        },
    )


def _of(spans: Iterable[tuple[float, float, str]], agent: str) -> Doubles:
    return np.array([(start, end) for start, end, who in spans if who == agent], np.float64).reshape(-1, 2)


def _beginnings(starts_s: Iterable[float], frames: int) -> Bools:
    """(frames,) something begins in this frame."""
    out = np.zeros(frames, bool)
    at = np.floor(np.fromiter(starts_s, np.float64) * FRAME_HZ + 1e-6).astype(np.int64)
    out[at[(at >= 0) & (at < frames)]] = True
    return out
