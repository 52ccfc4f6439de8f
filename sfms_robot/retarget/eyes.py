"""How an eye jumps. Directions are those of `signals.eye_angles`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfms_robot.frames import Doubles
from sfms_robot.signals.minimum_jerk import ease


@dataclass(frozen=True)
class Jump:
    """A saccade: directions (2,) [rad] that are left and reached, and when."""

    start_rad: Doubles
    end_rad: Doubles
    began_s: float
    duration_s: float

    @classmethod
    def between(cls, start_rad: Doubles, end_rad: Doubles, began_s: float) -> Jump:
        """With the main sequence of human saccades: 25 ms and 2.35 ms per degree ("Eyes Alive", Lee et al. 2002)."""
        size_deg = math.degrees(float(np.hypot(*(end_rad - start_rad))))
        return cls(start_rad, end_rad, began_s, 0.025 + 0.00235 * size_deg)

    @property
    def end_s(self) -> float:
        return self.began_s + self.duration_s

    def at(self, times_s: Doubles) -> Doubles:
        """Directions (N, 2) at (N,) instants."""
        share = ease((times_s - self.began_s) / self.duration_s)[:, None]
        direction: Doubles = self.start_rad + share * (self.end_rad - self.start_rad)
        return direction
