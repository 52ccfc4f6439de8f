"""The range in force of every joint: one rule, by which limiter, goals and audit all judge.

A joint has its own range, that of the head's file. One that is found outside it is held where it was found, and its
range reaches out to there. Every goal draws that in: the range in force reaches from the own range to the last goal.
So a joint outside its range moves in or stands still, the way out closes behind it, and once a goal lies inside its
own range that is the range in force for good, until it is found outside again.

No other memory is needed, so that all parts that know the last goal agree. A slow bus, which gets every k-th goal, is
never stricter than a part that gets all of them, because goals outside the own range only ever move in.
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
        """Return True for angles (J,) in the range, its ends included; False for one that is not finite."""
        return np.asarray((angles_rad >= self.low - slack_rad) & (angles_rad <= self.high + slack_rad))

    def nearest(self, angles_rad: Doubles) -> Doubles:
        """Return the angles (J,), those outside moved to the end of the range."""
        return np.asarray(np.minimum(np.maximum(angles_rad, self.low), self.high))
