"""From registers to motion: what operating mode, limits and profile of a Dynamixel tell its motor.

Two frames of ticks. *Shaft*: what the encoder sees. *Told*: what the registers say, turned round by the reverse bit of
the drive mode and shifted by the homing offset, whose sign the reverse bit leaves alone.
"""

from __future__ import annotations

from typing import Final

from sfms_robot.emulator.plant import MotorCommand
from sfms_robot.emulator.register_servo import RegisterFile
from sfms_robot.servo.registers import Table

CURRENT, VELOCITY, POSITION, EXTENDED, CURRENT_POSITION, PWM = 0, 1, 3, 4, 5, 16
SINGLE_TURN_OFFSET: Final = 1024  # no more of the homing offset counts in position mode
_REVERSE, _PROFILE_BY_TIME, TORQUE_ON_BY_GOAL = 0x01, 0x04, 0x08
_FULL_PWM: Final = 885.0
_FULL_TORQUE: Final = 1000.0  # of the XL-320's torque limit, which goes to 1023
_XL320_MODES: Final = {1: VELOCITY, 2: POSITION}


class TickFrames:
    """The two frames of one servo, as its registers stand."""

    def __init__(self, file: RegisterFile) -> None:
        self.mode = mode_of(file)
        self.sign = -1.0 if file.get("drive_mode") & _REVERSE else 1.0
        offset = file.get("homing_offset")
        if self.mode == POSITION:
            offset = min(max(offset, -SINGLE_TURN_OFFSET), SINGLE_TURN_OFFSET)
        turned = file.table.ticks_per_revolution if self.sign < 0 and self.mode == POSITION else 0.0
        self.offset = offset + turned

    def reported(self, shaft: float) -> float:
        return self.sign * shaft + self.offset

    def shaft(self, told: float) -> float:
        return self.sign * (told - self.offset)


def mode_of(file: RegisterFile) -> int:
    if "operating_mode" in file.table.fields:
        return file.get("operating_mode")
    return _XL320_MODES.get(file.get("control_mode"), POSITION)


def motor_command(file: RegisterFile, frames: TickFrames, shaft: float, top_speed: float) -> MotorCommand | None:
    """What a motor under torque is told, standing at `shaft`; None in a mode that is none."""
    table, get = file.table, file.get
    torque = min(1.0, get("torque_limit", round(_FULL_TORQUE)) / _FULL_TORQUE)
    if frames.mode in (POSITION, EXTENDED, CURRENT_POSITION):
        goal = frames.shaft(float(get("goal_position")))
        speed, acceleration = _profile(file, abs(goal - shaft))
        if frames.mode == CURRENT_POSITION:
            torque = min(1.0, abs(get("goal_current")) / max(1, get("current_limit", 1)))
        return MotorCommand(goal, top_speed, speed, acceleration, torque)
    if frames.mode == VELOCITY:
        name = "goal_velocity" if "goal_velocity" in table.fields else "moving_speed"
        wanted = frames.sign * _ticks_s(table, name, get(name))
        acceleration = _profile(file, 0.0)[1]
        return MotorCommand(
            min(max(wanted, -top_speed), top_speed), top_speed, 0.0, acceleration, torque, by_speed=True
        )
    if frames.mode == PWM:
        return MotorCommand(frames.sign * top_speed * get("goal_pwm") / _FULL_PWM, top_speed, by_speed=True)
    if frames.mode == CURRENT:
        fraction = get("goal_current") / max(1, get("current_limit", 1))
        return MotorCommand(
            frames.sign * top_speed * fraction, top_speed, torque=min(1.0, abs(fraction)), by_speed=True
        )
    return None


def _profile(file: RegisterFile, distance: float) -> tuple[float, float]:
    """Profile velocity and acceleration in ticks and seconds; 0 = no limit."""
    table, get = file.table, file.get
    if "profile_velocity" not in table.fields:
        name = "moving_speed"
        return (_ticks_s(table, name, abs(get(name))) if name in table.fields else 0.0), 0.0
    velocity, acceleration = get("profile_velocity"), get("profile_acceleration")
    if get("drive_mode") & _PROFILE_BY_TIME:
        whole_s, ramp_s = velocity / 1e3, min(acceleration, velocity / 2) / 1e3
        if not whole_s or not distance:
            return 0.0, 0.0
        speed = distance / (whole_s - ramp_s)
        return speed, speed / ramp_s if ramp_s else 0.0
    per_minute = table["profile_acceleration"].to_unit(acceleration) * table.ticks_per_revolution
    return _ticks_s(table, "profile_velocity", velocity), per_minute / 3600.0


def _ticks_s(table: Table, name: str, value: int) -> float:
    return table[name].to_unit(value) * table.ticks_per_revolution / 60.0
