"""An event that is asked for: is it seen in the motion, in time, and as large as people's?

The detectors of `signals.events` look at two motions of the same events: what a listener did that was told of them, and
what the people did. People's own figures are what the detector can see at all, so the listener is compared with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.corpora.clips import Dyad
from sfms_robot.frames import FRAME_HZ, Doubles, Floats
from sfms_robot.signals.events import MOTION_EVENTS

IN_TIME_S: Final = 0.12
NEARBY_S: Final = 0.5  # a detection this close to an event may be its own: from these the detector's lateness is taken


@dataclass(frozen=True)
class Agreement:
    """Of one kind of event. Shares are NaN where there is nothing to share.

    Attributes:
        asked: events of the dyads.
        recall: share of those that are seen within `IN_TIME_S` of their start; precision: share of what is seen that
            was asked for; both one to one, the detector's own lateness taken out.
        people_recall, people_precision: the same of the dyads' own listeners.
        size_ratio: median size of what is seen beside the median of what is seen in people.
    """

    asked: int
    recall: float
    precision: float
    people_recall: float
    people_precision: float
    size_ratio: float


def event_agreement(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> dict[str, Agreement]:
    """Of every kind that can be seen: motions (N, 58) of a listener that was told of the dyads' events.

    Only dyads that say their events count.
    """
    pairs = [(motion, dyad) for motion, dyad in zip(motions, dyads, strict=True) if dyad.events is not None]
    found = {}
    for kind, told in MOTION_EVENTS.items():
        asked = [np.sort([e.start_s for e in dyad.events or () if e.kind == kind]) for _, dyad in pairs]
        seen, people = (
            [np.array(told.find(told.signal(one), FRAME_HZ)).reshape(-1, 3) for one in some]
            for some in ([motion for motion, _ in pairs], [dyad.listener for _, dyad in pairs])
        )
        late_s = _lateness_s(asked, people)
        recall, precision = _shares(asked, seen, late_s)
        people_recall, people_precision = _shares(asked, people, late_s)
        found[kind] = Agreement(
            sum(map(len, asked)), recall, precision, people_recall, people_precision, _median(seen) / _median(people)
        )
    return found


def _lateness_s(asked: Sequence[Doubles], seen: Sequence[Doubles]) -> float:
    """Median time from an event to the detection nearest to it."""
    gaps = [
        float(gap)
        for starts, detected in zip(asked, seen, strict=True)
        if len(detected)
        for start in starts
        if abs(gap := (detected[:, 0] - start)[np.abs(detected[:, 0] - start).argmin()]) <= NEARBY_S
    ]
    return float(np.median(gaps)) if gaps else 0.0


def _shares(asked: Sequence[Doubles], seen: Sequence[Doubles], late_s: float) -> tuple[float, float]:
    """Recall and precision."""
    hits = sum(pairs_within(a, s[:, 0] - late_s, IN_TIME_S) for a, s in zip(asked, seen, strict=True))
    return _share(hits, sum(map(len, asked))), _share(hits, sum(map(len, seen)))


def pairs_within(first_s: Doubles, second_s: Doubles, within_s: float) -> int:
    """The most pairs of instants of two sorted lists that lie `within_s` of one another, each in one pair at most."""
    pairs, at = 0, 0
    for instant in first_s:
        while at < len(second_s) and second_s[at] < instant - within_s - 1e-9:
            at += 1
        if at < len(second_s) and second_s[at] <= instant + within_s + 1e-9:
            pairs, at = pairs + 1, at + 1
    return pairs


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def _median(events: Sequence[Doubles]) -> float:
    sizes = np.concatenate([one[:, 2] for one in events]) if events else np.zeros(0)
    return float(np.median(sizes)) if len(sizes) else float("nan")
