"""Conversion between joint angles and servo ticks: zero, sign and ratio of every joint, and limits rounded inward.

ticks = zero_ticks + sign x ratio x angle / (2 pi / ticks per revolution)
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfms_robot.config import Joint
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles, Ints, Reals

_ROUNDING_TICKS = 1e-6  # a limit this close to a whole tick counts as that tick


class Calibration:
    """The `ports.TickConversion` of the joints of one bus.

    Args:
        joints: name -> joint, in the order of the angles.
        ticks_per_revolution: (J,) ticks of one turn of each joint's servo.

    Attributes:
        zero_ticks: (J,) at angle 0.
        ticks_per_rad: (J,) with sign.
        low_ticks, high_ticks: (J,) first and last tick inside the position limits.

    Raises ConfigError when the range of a joint exceeds the one turn of a servo in position mode. A geared joint
    (`ratio` other than 1) may need several turns: its servo then works in extended position mode, if the model has it.
    """

    def __init__(self, joints: Mapping[str, Joint], ticks_per_revolution: Reals) -> None:
        turns = np.asarray(ticks_per_revolution, dtype=np.float64)
        self.zero_ticks = np.array([joint.zero_ticks for joint in joints.values()], dtype=np.float64)
        self.ticks_per_rad = np.array([j.sign * j.ratio for j in joints.values()]) * turns / (2 * np.pi)
        low = self.zero_ticks + self.ticks_per_rad * np.array([joint.min_rad for joint in joints.values()])
        high = self.zero_ticks + self.ticks_per_rad * np.array([joint.max_rad for joint in joints.values()])
        self.low_ticks = np.ceil(np.minimum(low, high) - _ROUNDING_TICKS).astype(np.int64)
        self.high_ticks = np.floor(np.maximum(low, high) + _ROUNDING_TICKS).astype(np.int64)
        for name, first, last, turn in zip(joints, self.low_ticks, self.high_ticks, turns, strict=True):
            if joints[name].ratio == 1.0 and (first < 0 or last > turn - 1):
                raise ConfigError(
                    f"joints.{name}: min_deg..max_deg is {first}..{last} ticks, outside the servo's 0..{turn - 1:.0f};"
                    f" change zero_ticks = {joints[name].zero_ticks}, ratio, or the range"
                )
            if first > last:
                raise ConfigError(f"joints.{name}: min_deg..max_deg holds no tick of the servo")

    def to_ticks(self, angles_rad: Doubles) -> Ints:
        """Return the nearest ticks (J,) inside the limits. Raises ValueError for an angle that is not finite."""
        finite = np.isfinite(angles_rad)
        if np.count_nonzero(finite) < finite.size:
            raise ValueError(f"joint {int(np.argmin(finite))} angle is not finite: {angles_rad}")
        ticks = self.ticks_per_rad * angles_rad
        ticks += self.zero_ticks
        inside: Doubles = np.minimum(np.maximum(np.rint(ticks), self.low_ticks), self.high_ticks)
        return inside.astype(np.int64)

    def to_rad(self, ticks: Ints) -> Doubles:
        """Return angles (J,) of servo positions, also of those outside the limits."""
        return (ticks - self.zero_ticks) / self.ticks_per_rad
