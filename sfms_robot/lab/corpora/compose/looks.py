"""Where listeners look: annotated looks away from whoever has the floor, and how long people look, learned from them.

Across a table with papers people look away a lot more than in front of one face, and watch slides for minutes: a share
of the looks is kept, and none lasts longer than a look aside by lot of those who had no table between them
(`signals.event_sizes`), which is what a listener's own events go by. What is drawn where nobody annotated gaze goes by
these kept ones, at somebody and away in turns, each as long as some annotated one was. That they do not hang on what is
heard is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.lab.corpora.compose.ami import Person
from sfms_robot.signals.event_sizes import aside_s

Look = tuple[float, float, str]  # start, end, where (`acting.Score.gaze`)

_KEPT: Final = 0.4
_NEAR_S: Final = 300.0  # no look is longer
_PLACES: Final = {"table": "down", "slide-screen": "screen", "whiteboard": "screen"}


@dataclass(frozen=True)
class Dwell:
    """How long (seconds each) people looked at whoever had the floor, and elsewhere: where, and how long."""

    at_s: tuple[float, ...]
    away: tuple[tuple[float, str], ...]

    def looks(self, length_s: float, rng: np.random.Generator) -> tuple[Look, ...]:
        """Looks away in `length_s` seconds; none where nothing was learned."""
        found: list[Look] = []
        if not self.at_s or not self.away:
            return ()
        at = float(rng.uniform(0, 1)) * self.at_s[int(rng.integers(len(self.at_s)))]
        while at < length_s:
            lasts_s, where = self.away[int(rng.integers(len(self.away)))]
            found.append((at, min(at + lasts_s, length_s), where))
            at += lasts_s + self.at_s[int(rng.integers(len(self.at_s)))]
        return tuple(found)


def learn_dwell(people: Sequence[Person]) -> Dwell:
    """From everybody whose gaze was annotated; an empty one where nobody's was."""
    rng = np.random.default_rng(0)
    at_s: list[float] = []
    elsewhere: list[tuple[float, str]] = []
    for person in people:
        looks = away(person, 0.0, person.until_s, rng)
        at_s += [after[0] - before[1] for before, after in zip(looks[:-1], looks[1:], strict=True)]
        elsewhere += [(end - start, where) for start, end, where in looks]
    return Dwell(tuple(lasts for lasts in at_s if lasts > 0), tuple(elsewhere))


def away(person: Person, start_s: float, end_s: float, rng: np.random.Generator) -> list[Look]:
    """His kept looks away between two times of the meeting."""
    found: list[Look] = []
    near = [(a, b, who) for a, b, who in person.floor if a < end_s + _NEAR_S and b > start_s - _NEAR_S]
    floor = {agent: np.array([(a, b) for a, b, who in near if who == agent]) for agent in {who for _, _, who in near}}
    for start, end, target in person.gaze or ():
        if end < start_s or start > end_s:
            continue
        where = _PLACES.get(target, "away") if len(target) != 1 else f"side {target}"
        if len(target) == 1 and target in floor:
            spoke = floor[target]
            if ((spoke[:, 0] < end + 1) & (spoke[:, 1] > start - 1)).any():
                continue  # he speaks during the look, or is about to, or just has
        if rng.random() < _KEPT:
            found.append((start, min(end, start + aside_s(rng.random())), where))
    return found
