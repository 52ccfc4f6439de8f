"""Which goals a bus may send: inside the limits of each joint, and whole ticks.

A servo that stands outside the limits of its joint is held where it stands; it may come in, and never go further out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles
from sfms_robot.ports import TickConversion

_SLACK_RAD: Final = 1e-9


class JointRange(Protocol):
    """The part of a bus servo that matters here."""

    @property
    def joint(self) -> str: ...

    @property
    def min_rad(self) -> float: ...

    @property
    def max_rad(self) -> float: ...


class Goals:
    """Checks and converts the goals of one bus, joints in bus order.

    Args:
        bus: its name, for messages.
        servos: in joint order.
        conversion: joint angles (J,) <-> ticks (J,), affine per joint.
    """

    def __init__(self, bus: str, servos: Sequence[JointRange], conversion: TickConversion) -> None:
        self._bus = bus
        self._servos = tuple(servos)
        self._conversion = conversion
        self._lowest = np.array([servo.min_rad for servo in servos])
        self._highest = np.array([servo.max_rad for servo in servos])
        zero = conversion.to_rad(np.zeros(len(servos), np.int64))
        self.rad_per_tick: Doubles = conversion.to_rad(np.ones(len(servos), np.int64)) - zero
        self._rad_at_zero = zero
        self._outside: set[int] = set()  # who was found outside its limits, and may still be on its way in

    def hold(self, index: int, angle_rad: float) -> bool:
        """A servo has torque at this angle; whether that is inside the limits of its joint."""
        servo = self._servos[index]
        self._lowest[index] = min(servo.min_rad, angle_rad)
        self._highest[index] = max(servo.max_rad, angle_rad)
        inside = servo.min_rad <= angle_rad <= servo.max_rad
        if not inside:
            self._outside.add(index)
        return inside

    def check(self, goals_rad: Doubles) -> None:
        """Raises ValueError for goals of the wrong shape, not finite, or outside the limits."""
        if goals_rad.shape != self._lowest.shape:
            raise ValueError(f"bus {self._bus!r} has {len(self._servos)} joints, got goals of shape {goals_rad.shape}")
        inside = (goals_rad >= self._lowest - _SLACK_RAD) & (goals_rad <= self._highest + _SLACK_RAD)  # no NaN is
        if not inside.all():
            i = int(np.argmin(inside))
            allowed = f"{self._lowest[i]:g}..{self._highest[i]:g} rad"
            raise ValueError(f"goal of {self._servos[i].joint} = {goals_rad[i]:g} rad is not in {allowed}")

    def ticks(self, goals_rad: Doubles) -> NDArray[np.int64]:
        """Ticks (J,) to send; the way out closes behind a joint that comes in."""
        ticks = self._conversion.to_ticks(goals_rad)
        for i in list(self._outside):
            servo, goal = self._servos[i], goals_rad[i]
            self._lowest[i] = min(servo.min_rad, goal)
            self._highest[i] = max(servo.max_rad, goal)
            if servo.min_rad <= goal <= servo.max_rad:
                self._outside.discard(i)
            else:
                # On its way in from outside: the conversion would jump to the limit, so the tick is worked out here.
                ticks[i] = round((goal - self._rad_at_zero[i]) / self.rad_per_tick[i])
        return ticks
