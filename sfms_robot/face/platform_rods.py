"""How the rods of a six-legged platform stand: two angles each, for a picture of it.

In the frame of a leg's servo (x, y in the plane of the crank, z its axis; see `config.kinematics.Leg`) the crank's tip
is (c cos a, c sin a, 0), and the rod's head end is q = T H b with T = `servo_from_body`, H the head's pose seen from
the body, and b = `rod_end_m`. Seen from the turned crank the rod points along d = Rz(-a) (q - tip) / l: it swings
about z by atan2(dy, dx) and leans out of the crank's plane, about -y, by asin(dz).
"""

from __future__ import annotations

import numpy as np

from sfms_robot.config.kinematics import StewartPlatform
from sfms_robot.frames import Doubles


class PlatformRods:
    """Geometry of the six legs of one platform."""

    def __init__(self, config: StewartPlatform) -> None:
        self._servo = np.array([leg.servo_from_body for leg in config.legs])  # (6, 3, 4)
        self._ends_m = np.array([leg.rod_end_m for leg in config.legs])  # (6, 3)
        self._crank_m, self._height_m = config.crank_m, config.home_height_m

    def angles(self, cranks_rad: Doubles, rotation: Doubles, place_m: Doubles) -> Doubles:
        """Crank angles (6,) and the head's pose seen from the body, R (3, 3) and t (3,) -> swing and lean (6, 2)."""
        ends = self._ends_m @ rotation.T + place_m + [0.0, 0.0, self._height_m]
        q = np.einsum("lij,lj->li", self._servo[..., :3], ends) + self._servo[..., 3]
        cosine, sine = np.cos(cranks_rad), np.sin(cranks_rad)
        x = cosine * q[:, 0] + sine * q[:, 1] - self._crank_m
        y = cosine * q[:, 1] - sine * q[:, 0]
        return np.stack([np.arctan2(y, x), np.arctan2(q[:, 2], np.hypot(x, y))], axis=-1)
