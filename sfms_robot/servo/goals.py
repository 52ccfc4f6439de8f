"""Which goals a bus may send: inside the limits of each joint, whole ticks, and no leap after a servo was away.

A servo that stands outside the limits of its joint is held where it stands; it may come in, and never go further out.
A servo that comes back to a running bus is led from where it stands to where it should be at `EASE_RAD_S`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles
from sfms_robot.ports import TickConversion

EASE_RAD_S: Final = 1.0
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
        self._easing: dict[int, tuple[float, float]] = {}  # index -> last goal, when

    def hold(self, index: int, angle_rad: float) -> bool:
        """A servo has torque at this angle; whether that is inside the limits of its joint."""
        servo = self._servos[index]
        self._lowest[index] = min(servo.min_rad, angle_rad)
        self._highest[index] = max(servo.max_rad, angle_rad)
        self._easing.pop(index, None)
        return servo.min_rad <= angle_rad <= servo.max_rad

    def ease(self, index: int, from_rad: float, now_s: float) -> None:
        """It is back, and stands at `from_rad`: lead it to its goal."""
        self._easing[index] = (from_rad, now_s)

    def check(self, goals_rad: Doubles) -> None:
        """Raises ValueError for goals of the wrong shape, not finite, or outside the limits."""
        if goals_rad.shape != self._lowest.shape:
            raise ValueError(f"bus {self._bus!r} has {len(self._servos)} joints, got goals of shape {goals_rad.shape}")
        inside = (goals_rad >= self._lowest - _SLACK_RAD) & (goals_rad <= self._highest + _SLACK_RAD)  # no NaN is
        if not inside.all():
            i = int(np.argmin(inside))
            allowed = f"{self._lowest[i]:g}..{self._highest[i]:g} rad"
            raise ValueError(f"goal of {self._servos[i].joint} = {goals_rad[i]:g} rad is not in {allowed}")

    def ticks(self, goals_rad: Doubles, enabled: Sequence[int], now_s: float) -> NDArray[np.int64]:
        """Ticks (J,) to send. `enabled`: indices of those that will be sent; the way out closes behind those."""
        goals = self._eased(goals_rad, now_s)
        ticks = self._conversion.to_ticks(goals)
        for i in enabled:
            servo, goal = self._servos[i], goals[i]
            if not servo.min_rad <= goal <= servo.max_rad:
                # On its way in from outside: the conversion would jump to the limit, so the tick is worked out here.
                ticks[i] = round((goal - self._rad_at_zero[i]) / self.rad_per_tick[i])
            if self._lowest[i] < servo.min_rad or self._highest[i] > servo.max_rad:
                self._lowest[i] = min(servo.min_rad, goal)
                self._highest[i] = max(servo.max_rad, goal)
        return ticks

    def _eased(self, goals_rad: Doubles, now_s: float) -> Doubles:
        if not self._easing:
            return goals_rad
        goals = goals_rad.copy()
        for i, (last_rad, last_s) in list(self._easing.items()):
            step = EASE_RAD_S * max(0.0, now_s - last_s)
            gap = goals[i] - last_rad
            if abs(gap) <= step:
                del self._easing[i]
            else:
                goals[i] = last_rad + np.copysign(step, gap)
                self._easing[i] = (float(goals[i]), now_s)
        return goals
