"""The range in force of every joint: the one rule that limiter, goals and audit share.

A joint has its own range, that of the head's file. A joint that is found outside it is held where it was found, and
the range in force is extended to that position. Every goal shrinks it again: the range in force is the own range,
extended to the last goal. So a joint outside its own range moves in or stands still, and cannot move out again. Once a
goal lies inside the own range, the range in force equals the own range, until the joint is found outside again.

No other memory is needed, so all parts that have the last goal agree. A slow bus, which receives every k-th goal, is
never stricter than a part that receives all goals, because goals outside the own range only move in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfms_robot.frames import Bools, Doubles


@dataclass(frozen=True)
class Range:
    """Lowest and highest angles of joints [rad], (J,) each: their own range, or the range in force."""

    low: Doubles
    high: Doubles

    def reaching(self, last_rad: Doubles) -> Range:
        """Return the range in force for an own range and joints found at, or last sent to, `last_rad` (J,)."""
        return Range(np.minimum(self.low, last_rad), np.maximum(self.high, last_rad))

    def holds(self, angles_rad: Doubles, slack_rad: float = 0.0) -> Bools:
        """Return True for angles (J,) in the range, its ends included; False for angles that are not finite."""
        return np.asarray((angles_rad >= self.low - slack_rad) & (angles_rad <= self.high + slack_rad))

    def nearest(self, angles_rad: Doubles) -> Doubles:
        """Return the angles (J,), with those outside moved to the nearest end of the range."""
        return np.asarray(np.minimum(np.maximum(angles_rad, self.low), self.high))
