"""Which of several faces is the person who is talked with: the nearest, and not another one at every breath.

One that was chosen stays it while it is seen. Another takes its place only when it has been clearly nearer for a while,
or when the chosen one is gone. A face is known again by where it is: it does not jump between two pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfms_robot.frames import Floats

NEARER: Final = 0.8  # of the chosen one's distance: clearly nearer
TAKE_OVER_S: Final = 1.0  # for so long, without a break
GONE_S: Final = 0.5  # one that has not been seen for so long is gone
STEP: Final = 0.25  # of its distance: no further away from where it was can a face be the same one


@dataclass(frozen=True)
class Choice:
    """The person chosen so far: where and when they were last seen, and since when another one is clearly nearer."""

    place_m: Floats
    seen_s: float
    rival_since_s: float | None = None


def choose(places_m: Sequence[Floats], time_s: float, before: Choice | None) -> tuple[int | None, Choice | None]:
    """The index of the person among the faces of a picture, by place (3,) from the camera; None where they are not.

    `before` is what the last picture gave, None at first. The order of the faces does not matter.
    """
    distances_m = [float(np.linalg.norm(place)) for place in places_m]
    same = _same(places_m, before)
    if before is None or same is None:
        if before is not None and time_s - before.seen_s < GONE_S:
            return None, replace(before, rival_since_s=None)
        if not places_m:
            return None, None
        nearest = int(np.argmin(distances_m))
        return nearest, Choice(places_m[nearest], time_s)
    nearest = int(np.argmin(distances_m))
    if distances_m[nearest] >= NEARER * distances_m[same]:
        return same, Choice(places_m[same], time_s)
    since_s = time_s if before.rival_since_s is None else before.rival_since_s
    if time_s - since_s < TAKE_OVER_S:
        return same, Choice(places_m[same], time_s, since_s)
    return nearest, Choice(places_m[nearest], time_s)


def _same(places_m: Sequence[Floats], before: Choice | None) -> int | None:
    """The face that is where the chosen one was, or None."""
    if before is None or not places_m:
        return None
    steps_m = [float(np.linalg.norm(place - before.place_m)) for place in places_m]
    same = int(np.argmin(steps_m))
    return same if steps_m[same] <= STEP * float(np.linalg.norm(before.place_m)) else None
