"""Eye channels as angles and back, the direction of a place, and how an eye jumps.

An eye's direction is (yaw, pitch): yaw + to the head's left, pitch + down, as the head's own yaw and pitch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, Doubles, Floats
from sfms_robot.signals.minimum_jerk import ease

_LEFT = tuple(CHANNEL_INDEX[f"eyeLook{way}Left"] for way in ("Out", "In", "Down", "Up"))
_RIGHT = tuple(CHANNEL_INDEX[f"eyeLook{way}Right"] for way in ("In", "Out", "Down", "Up"))
_PLUS = np.array([_LEFT[0], _LEFT[2], _RIGHT[0], _RIGHT[2]])
_MINUS = np.array([_LEFT[1], _LEFT[3], _RIGHT[1], _RIGHT[3]])


def directions(motion: Floats, full_rad: Doubles) -> Doubles:
    """Motion (..., 58) -> (..., 2, 2): left and right eye, yaw and pitch [rad]; a channel of 1 is `full_rad` (2,)."""
    turned = motion.take(_PLUS, axis=-1).astype(np.float64) - motion.take(_MINUS, axis=-1)
    return turned.reshape(*motion.shape[:-1], 2, 2) * full_rad


def turn(motion: Floats, directions_rad: Doubles, full_rad: Doubles) -> None:
    """Write directions (..., 2, 2) into `motion` (..., 58), as far as the channels go."""
    share = (directions_rad / full_rad).reshape(*motion.shape[:-1], 4)
    motion[..., _PLUS] = np.minimum(np.maximum(share, 0.0), 1.0)
    motion[..., _MINUS] = np.minimum(np.maximum(-share, 0.0), 1.0)


def direction_to(place_m: Doubles) -> Doubles:
    """Return yaw and pitch (..., 2) [rad] of a look from the origin to the place (..., 3)."""
    x, y, z = np.moveaxis(place_m, -1, 0)
    return np.stack([np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y))], axis=-1)


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
