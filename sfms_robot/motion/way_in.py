"""How a joint that was found outside its own range comes in, whatever it is asked for.

From the angle where it was found to the near end of its range leads a quintic with neither speed nor acceleration at
its ends. It is slow (at least `GENTLE_S`) and uses at most `_SHARE` of each limit. A joint that is asked to be farther
out than this curve, or for nothing finite, is given the curve as its reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import Doubles
from sfms_robot.ranges import Bools, Range
from sfms_robot.signals.minimum_jerk import minimum_jerk

GENTLE_S: Final = 2.0  # longer than the easing of a run, so that usually the face asked for is ahead of the curve
_SHARE: Final = 0.8
# Highest speed, acceleration and jerk of 10 u^3 - 15 u^4 + 6 u^5 over u = 0..1.
_PEAKS: Final = (15 / 8, 10 / 3**0.5, 60.0)


def curve_s(distance_rad: Doubles, speed: Doubles, acceleration: Doubles, jerk: Doubles) -> Doubles:
    """Duration [s] (J,) of the curves over `distance_rad` (J,), under limits (J,)."""
    v, a, j = (peak * distance_rad / _SHARE for peak in _PEAKS)
    return np.asarray(np.maximum.reduce([v / speed, np.sqrt(a / acceleration), np.cbrt(j / jerk)]).clip(GENTLE_S))


def latest_s(distance_rad: Doubles, speed: Doubles, acceleration: Doubles, jerk: Doubles) -> Doubles:
    """Time [s] (J,) in which a joint `distance_rad` (J,) outside its range is inside it, whatever it is asked for.

    The duration of its curve, and once it stands still at the end of that: to come to a stop, wherever the joint is
    by then, and to come in from there as fast as the limits allow.
    """
    ramp = speed / acceleration + acceleration / jerk
    return np.asarray(curve_s(distance_rad, speed, acceleration, jerk) + distance_rad / speed + 2 * ramp)


@dataclass(frozen=True)
class WayIn:
    """The curves of joints that were found outside their own ranges, (J,) each.

    A joint that was found inside has a curve of no length, which is not asked for.

    Attributes:
        found_rad: where each was found.
        edge_rad: the near end of its range.
        duration_s: of its curve.
        elapsed_s: since it was found.
    """

    found_rad: Doubles
    edge_rad: Doubles
    duration_s: Doubles
    elapsed_s: Doubles

    @classmethod
    def of(cls, found_rad: Doubles, own: Range, *limits: Doubles) -> WayIn:
        """`limits`: speed, acceleration, jerk (J,)."""
        edge_rad = own.nearest(found_rad)
        return cls(found_rad, edge_rad, curve_s(np.abs(found_rad - edge_rad), *limits), np.zeros_like(found_rad))

    def after(self, dt_s: float) -> WayIn:
        return WayIn(self.found_rad, self.edge_rad, self.duration_s, self.elapsed_s + dt_s)

    def replaced(self, joints: Bools, by: WayIn) -> WayIn:
        """With other curves of some `joints` (J,)."""
        mine = (self.found_rad, self.edge_rad, self.duration_s, self.elapsed_s)
        theirs = (by.found_rad, by.edge_rad, by.duration_s, by.elapsed_s)
        return WayIn(*(np.where(joints, new, old) for new, old in zip(theirs, mine, strict=True)))

    def now(self) -> Doubles:
        """Angle, speed and acceleration (3, J) of the curves."""
        u = np.minimum(self.elapsed_s / self.duration_s, 1.0)
        left = 1.0 - minimum_jerk(u)
        speed = -30 * u**2 * (1 - u) ** 2 / self.duration_s
        acceleration = -60 * u * (1 - u) * (1 - 2 * u) / self.duration_s**2
        curve: Doubles = (self.found_rad - self.edge_rad) * np.stack([left, speed, acceleration])
        curve[0] += self.edge_rad
        return curve

    def guided(self, reference_rad: Doubles) -> Doubles:
        """References (3, J), and the curve in place of those that are farther out than it, or not finite."""
        curve = self.now()
        way_out = np.sign(self.found_rad - self.edge_rad)
        with np.errstate(invalid="ignore"):
            ahead = np.isfinite(reference_rad).all(axis=0) & ((reference_rad[0] - curve[0]) * way_out <= 0)
        return np.where(ahead, reference_rad, curve)
