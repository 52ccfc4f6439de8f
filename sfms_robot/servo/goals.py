"""Which goals a bus may send: inside the range in force of each joint (`sfms_robot.ranges`), and whole ticks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles
from sfms_robot.ports import TickConversion
from sfms_robot.ranges import Range

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
        self._own = Range(np.array([servo.min_rad for servo in servos]), np.array([servo.max_rad for servo in servos]))
        self._last_rad = self._own.low.copy()  # where each was found, or sent to last
        self._lowest, self._highest = self._own.low - _SLACK_RAD, self._own.high + _SLACK_RAD
        self._outside = False  # somebody was found outside its own range, and may not be in yet
        self._rad_at_zero = conversion.to_rad(np.zeros(len(servos), np.int64))
        self.rad_per_tick: Doubles = conversion.to_rad(np.ones(len(servos), np.int64)) - self._rad_at_zero

    def hold(self, index: int, angle_rad: float) -> bool:
        """A servo has torque at this angle, which its range now reaches; whether that is inside its own range."""
        self._last_rad[index] = angle_rad
        inside = bool(self._servos[index].min_rad <= angle_rad <= self._servos[index].max_rad)
        self._outside |= not inside
        return inside

    def allows(self, index: int, goal_rad: float) -> bool:
        """Whether a goal lies in the range in force of a servo."""
        return bool(self._own.reaching(self._last_rad).holds(np.asarray(goal_rad), _SLACK_RAD)[index])

    def ticks(self, goals_rad: Doubles, sent: NDArray[np.intp]) -> NDArray[np.int64]:
        """Goals (J,) -> ticks (J,); those of the indices `sent` (n,) will be put on the wire, and are judged for it.

        The range in force of a joint that is sent closes behind its goal; the others keep theirs. Raises ValueError,
        with nothing changed, for another shape, a goal that is not finite, or one of `sent` outside the range in force.
        """
        if goals_rad.shape != self._last_rad.shape:
            raise ValueError(f"bus {self._bus!r} has {len(self._servos)} joints, got goals of shape {goals_rad.shape}")
        if not self._outside and np.logical_and.reduce((goals_rad >= self._lowest) & (goals_rad <= self._highest)):
            return self._conversion.to_ticks(goals_rad)  # nearly always: every own range is the range in force
        finite = np.isfinite(goals_rad)
        if not finite.all():
            raise ValueError(f"goal of {self._servos[int(np.argmin(finite))].joint} is not finite")
        in_force = self._own.reaching(self._last_rad)
        refused = sent[~in_force.holds(goals_rad, _SLACK_RAD)[sent]]
        if refused.size:
            first = int(refused[0])
            allowed = f"{in_force.low[first]:g}..{in_force.high[first]:g} rad"
            raise ValueError(f"goal of {self._servos[first].joint} = {goals_rad[first]:g} rad is not in {allowed}")
        ticks = self._conversion.to_ticks(goals_rad)
        # On the way in from outside: the conversion would jump to the limit, so the tick is worked out here.
        for i in np.flatnonzero(~self._own.holds(goals_rad, _SLACK_RAD) & in_force.holds(goals_rad, _SLACK_RAD)):
            ticks[i] = round((goals_rad[i] - self._rad_at_zero[i]) / self.rad_per_tick[i])
        self._last_rad[sent] = in_force.nearest(goals_rad)[sent]
        self._outside = not self._own.holds(self._last_rad).all()
        return ticks
