"""The moving part of an emulated servo: a profile generator, then a motor that follows it.

    reference   trapezoid towards the goal under profile velocity and acceleration (0 = no limit: it jumps)
    motor       x'' = w^2 (reference - x) - 2 w x', with |x''| and |x'| held to what the motor can do

Critically damped, so a servo lags a ramp by 2 / w = 33 ms and does not ring. Time runs on a fixed grid of `STEP_S`:
where the servo is depends on what it was told when, never on how often somebody looked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

STEP_S: Final = 0.002
_STIFFNESS: Final = 60.0  # w, 1/s
_SPIN_UP_S: Final = 0.05  # from rest to top speed
_FRICTION_MA: Final = 25.0
_INERTIA_MA: Final = 500.0  # at full acceleration
_THERE: Final = 0.02  # ticks from the goal at which a motor counts as there


class Drive(NamedTuple):
    """What a motor is told. Ticks and seconds; a profile limit of 0 is no limit."""

    goal: float
    top_speed: float
    profile_speed: float = 0.0
    profile_acceleration: float = 0.0


@dataclass(slots=True)
class Plant:
    """State of one motor, in ticks and seconds. `drive` None = no torque: it stays where it is."""

    position: float
    speed: float = 0.0
    acceleration: float = 0.0
    reference: float = 0.0
    reference_speed: float = 0.0
    step: int = 0

    def advance(self, now_s: float, drive: Drive | None) -> None:
        """Move on to the last grid point at or before `now_s`; going back in time does nothing."""
        steps = int(now_s / STEP_S + 1e-6) - self.step
        if steps <= 0:
            return
        self.step += steps
        if drive is None:
            self.speed = self.acceleration = self.reference_speed = 0.0
            self.reference = self.position
            return
        for _ in range(steps):
            if self.speed == 0.0 and self.position == drive.goal == self.reference:
                return
            self._follow(drive)

    def _follow(self, drive: Drive) -> None:
        self._plan(drive)
        limit = drive.top_speed / _SPIN_UP_S
        pull = _STIFFNESS * (_STIFFNESS * (self.reference - self.position) - 2.0 * self.speed)
        self.acceleration = min(max(pull, -limit), limit)
        speed = self.speed + self.acceleration * STEP_S
        self.speed = min(max(speed, -drive.top_speed), drive.top_speed)
        self.position += self.speed * STEP_S
        if self.reference == drive.goal and abs(drive.goal - self.position) < _THERE and abs(self.speed) < 1.0:
            self.position, self.speed, self.acceleration = drive.goal, 0.0, 0.0

    def _plan(self, drive: Drive) -> None:
        """Move the reference one step towards the goal."""
        if drive.profile_speed == 0.0:
            self.reference, self.reference_speed = drive.goal, 0.0
            return
        gap = drive.goal - self.reference
        wanted = drive.profile_speed
        if drive.profile_acceleration > 0.0:
            change = drive.profile_acceleration * STEP_S
            wanted = min(
                wanted, (2.0 * drive.profile_acceleration * abs(gap)) ** 0.5, abs(self.reference_speed) + change
            )
        wanted = min(wanted, abs(gap) / STEP_S)
        self.reference_speed = wanted if gap >= 0.0 else -wanted
        self.reference += self.reference_speed * STEP_S
        if abs(drive.goal - self.reference) < 1e-6:
            self.reference, self.reference_speed = drive.goal, 0.0

    def current_mA(self, top_speed: float) -> float:
        """Plausible winding current: friction while it turns, and what accelerates it."""
        if self.speed == 0.0:
            return 0.0
        friction = _FRICTION_MA if self.speed > 0.0 else -_FRICTION_MA
        return friction + _INERTIA_MA * self.acceleration * _SPIN_UP_S / top_speed
