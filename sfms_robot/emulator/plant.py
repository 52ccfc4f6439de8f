"""Motor of an emulated servo: a profile generator, then a motor that follows it and heats up.

    reference   trapezoid towards the goal under profile velocity and acceleration (0 = no limit: it jumps)
    motor       x'' = w^2 (reference - x) - 2 w x' - load, with |x''| and |x'| limited to those of the motor
    heat        T' = (ambient + _HEATING * effort^2 - T) / _COOLING_S

The motor is critically damped, so a servo lags a ramp by 2 / w = 33 ms and does not oscillate. Under a load it stays a
little below its goal, like a proportional controller. Time advances on a fixed grid of `STEP_S`: the position depends
on the commands and their times, never on the number of reads.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import Final, NamedTuple

STEP_S: Final = 0.002
AMBIENT_C: Final = 31.0
OVERLOAD_S: Final = 1.0  # time at full effort without turning until overload
_STIFFNESS: Final = 60.0  # w, 1/s
_SPIN_UP_S: Final = 0.05  # time from rest to top speed
_FRICTION_MA: Final = 25.0
_CREEP: Final = 20.0  # speed from which on friction is full, ticks/s
_STALL_MA: Final = 1200.0  # current at full effort
_THERE: Final = 0.02  # distance from the goal at which a motor has arrived, ticks
_HEATING: Final = 110.0  # final temperature above ambient of a motor that stalls permanently, degrees
_COOLING_S: Final = 45.0
_HEAT_STEPS: Final = 100
_DECAY: Final = 1.0 - math.exp(-_HEAT_STEPS * STEP_S / _COOLING_S)
_STRAINED: Final = 0.95  # fraction of full effort from which on the motor is strained


class MotorCommand(NamedTuple):
    """Command of a motor, in ticks and seconds; a profile limit of 0 means unlimited.

    Attributes:
        goal: A position, or a speed if `by_speed`.
        torque: Fraction of its full torque that the motor may use.
    """

    goal: float
    top_speed: float
    profile_speed: float = 0.0
    profile_acceleration: float = 0.0
    torque: float = 1.0
    by_speed: bool = False


@dataclass(slots=True)
class Plant:
    """State of one motor, in ticks and seconds.

    Attributes:
        effort: Fraction of full torque that the motor uses now, signed.
        load: Fraction of full torque that is needed to hold its position.
        stuck: True if the shaft does not turn.
        strained_steps: Number of steps at full effort without turning.
    """

    position: float
    _: KW_ONLY
    speed: float = 0.0
    acceleration: float = 0.0
    reference: float = 0.0
    reference_speed: float = 0.0
    step: int = 0
    effort: float = 0.0
    load: float = 0.0
    stuck: bool = False
    temperature_C: float = AMBIENT_C
    strained_steps: int = 0
    _heat: float = 0.0

    @property
    def overloaded(self) -> bool:
        return self.strained_steps * STEP_S >= OVERLOAD_S

    def advance(self, now_s: float, drive: MotorCommand | None) -> None:
        """Advance to the last grid point at or before `now_s`; do nothing if that is not later.

        `drive` None: no torque, the shaft stays.
        """
        steps = int(now_s / STEP_S + 1e-6) - self.step
        if steps <= 0:
            return
        if drive is None:
            self.speed = self.acceleration = self.reference_speed = 0.0
            self.reference = self.position
            self._rest(steps)
            return
        for done in range(steps):
            if self.speed == 0.0 and self._arrived(drive):
                self._rest(steps - done)
                return
            if drive.by_speed:
                self._turn(drive)
            else:
                self._follow(drive)
            self.step += 1
            self._heat += self.effort * self.effort
            if self.step % _HEAT_STEPS == 0:
                self._warm()

    def _arrived(self, drive: MotorCommand) -> bool:
        if drive.by_speed:
            return drive.goal == 0.0 == self.reference_speed
        return self.position == drive.goal == self.reference and self.load == 0.0

    def _follow(self, drive: MotorCommand) -> None:
        self._plan(drive)
        self._move(drive, _STIFFNESS * (_STIFFNESS * (self.reference - self.position) - 2.0 * self.speed))
        if self.reference == drive.goal and abs(drive.goal - self.position) < _THERE and abs(self.speed) < 1.0:
            if self.load == 0.0:
                self.position, self.speed, self.acceleration, self.effort = drive.goal, 0.0, 0.0, 0.0

    def _turn(self, drive: MotorCommand) -> None:
        change = drive.profile_acceleration * STEP_S or 2.0 * drive.top_speed
        self.reference_speed += min(max(drive.goal - self.reference_speed, -change), change)
        self._move(drive, 2.0 * _STIFFNESS * (self.reference_speed - self.speed))
        self.reference = self.position
        if drive.goal == 0.0 == self.reference_speed and abs(self.speed) < 1.0:
            self.speed = self.acceleration = self.effort = 0.0

    def _move(self, drive: MotorCommand, pull: float) -> None:
        """Advance by one step a motor whose controller demands the acceleration `pull`."""
        full = drive.top_speed / _SPIN_UP_S
        limit = full * drive.torque
        motor = min(max(pull, -limit), limit)
        self.effort = motor / full
        if self.stuck:
            self.speed = self.acceleration = 0.0
        else:
            self.acceleration = motor - self.load * full
            speed = self.speed + self.acceleration * STEP_S
            self.speed = min(max(speed, -drive.top_speed), drive.top_speed)
            self.position += self.speed * STEP_S
        strained = abs(self.effort) >= _STRAINED and abs(self.speed) < 0.01 * drive.top_speed
        self.strained_steps = self.strained_steps + 1 if strained else 0

    def _plan(self, drive: MotorCommand) -> None:
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

    def _rest(self, steps: int) -> None:
        self.effort, self.strained_steps = 0.0, 0
        times = (self.step + steps) // _HEAT_STEPS - self.step // _HEAT_STEPS
        self.step += steps
        for _ in range(times):
            if self._heat == 0.0 and self.temperature_C == AMBIENT_C:
                return
            self._warm()

    def _warm(self) -> None:
        """Update the temperature from the effort of the last `_HEAT_STEPS` steps; called once in as many steps."""
        target = AMBIENT_C + _HEATING * self._heat / _HEAT_STEPS
        self._heat = 0.0
        self.temperature_C += _DECAY * (target - self.temperature_C)
        if abs(self.temperature_C - AMBIENT_C) < 1e-3 and target == AMBIENT_C:
            self.temperature_C = AMBIENT_C

    def current_mA(self) -> float:
        """Return a plausible winding current: a part for friction while it turns, and a part for its effort."""
        if self.speed == 0.0 and self.effort == 0.0:
            return 0.0
        friction = _FRICTION_MA * min(max(self.speed / _CREEP, -1.0), 1.0)
        return friction + _STALL_MA * self.effort
