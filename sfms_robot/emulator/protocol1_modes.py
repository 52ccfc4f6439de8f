"""From registers to motion: what mode, limits and goals of a Dynamixel 1.0 or Feetech servo tell its motor.

    family           mode          chosen by                          goal
    AX               wheel         both angle limits 0                moving speed (32), open loop, 1023 = all it has
    MX (1.0)         wheel         both angle limits 0                moving speed (32), closed loop, 0.114 rpm
    MX (1.0)         multi-turn    both angle limits 4095             goal position (30), offset (20), divider (22)
    STS              wheel         register 33 = 1                    goal speed (46), step/s
    STS              PWM           register 33 = 2                    register 44, sign in bit 11, 1000 = all it has
    STS              step          register 33 = 3                    goal position (42) is so much further on
    STS              multi-turn    both angle limits 0                goal position (42) beyond one turn
    SCS              PWM           both angle limits 0                register 44, sign in bit 10, 1000 = all it has

In every other case it is a joint: a position within its angle limits. Limits the wrong way round drive nothing.

Sources: ROBOTIS e-manual ax-12a and mx-28, "CW/CCW Angle Limit" and "Moving Speed"; Feetech memory table V3.6 and the
SCS15 manual, "Minimum/Maximum angle", "Operating mode", "Running time".
"""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from sfms_robot.emulator.plant import MotorCommand
from sfms_robot.emulator.register_servo import RegisterFile
from sfms_robot.servo.registers import Field

_MX_MULTI_TURN: Final = 4095
_FULL_DUTY: Final = 1000.0
_FULL_AX_SPEED: Final = 1023.0
_SCS_SIGN: Final = 1 << 10
_COUNTS_TURNS: Final = 0x10  # of the STS phase register: positions are told beyond one turn


class Mode(Enum):
    JOINT = auto()
    MULTI_TURN = auto()
    WHEEL = auto()
    PWM = auto()
    STEP = auto()
    NONE = auto()


POSITIONING: Final = frozenset({Mode.JOINT, Mode.MULTI_TURN, Mode.STEP})
_STS_MODES: Final = {1: Mode.WHEEL, 2: Mode.PWM, 3: Mode.STEP}


def angle_limits(file: RegisterFile) -> tuple[int, int]:
    """Lowest and highest goal of a joint."""
    lowest = file.get("min_position_limit", file.get("cw_angle_limit"))  # Feetech, Dynamixel
    return lowest, file.get("max_position_limit", file.get("ccw_angle_limit"))


def mode_of(file: RegisterFile) -> Mode:
    limits, fields = angle_limits(file), file.table.fields
    if "operating_mode" in fields:
        joint = Mode.MULTI_TURN if limits == (0, 0) else Mode.JOINT
        return _STS_MODES.get(file.get("operating_mode"), joint)
    if limits == (0, 0):
        return Mode.PWM if file.table.family == "feetech" else Mode.WHEEL
    if limits == (_MX_MULTI_TURN, _MX_MULTI_TURN) and "multi_turn_offset" in fields:
        return Mode.MULTI_TURN
    if limits[0] < limits[1] or file.table.family == "feetech":
        return Mode.JOINT
    return Mode.NONE


class PositionFrame:
    """Position registers <-> ticks of the shaft, as the registers stand."""

    sign = 1.0

    def __init__(self, file: RegisterFile, mode: Mode) -> None:
        table = file.table
        self._turn = table.ticks_per_revolution
        self._highest = table["goal_position"].high if table["goal_position"].high < self._turn else None
        many = mode is Mode.MULTI_TURN and "multi_turn_offset" in table.fields
        self._divider = max(1, file.get("resolution_divider", 1)) if many else 1
        self._offset = file.get("multi_turn_offset") if many else -file.get("homing_offset")
        self._counts = many or bool(file.get("phase") & _COUNTS_TURNS and "operating_mode" in table.fields)

    def reported(self, shaft: float) -> float:
        """Ticks of the registers, beyond one turn as well."""
        return shaft / self._divider + self._offset

    def shaft(self, told: float) -> float:
        return (told - self._offset) * self._divider

    def shown(self, shaft: float) -> int:
        """What the present position reads: a servo that does not count turns knows one, with or without a gap."""
        told = round(self.reported(shaft))
        if self._counts:
            return told
        told = round(told % self._turn) if not 0 <= told < self._turn else told
        if self._highest is None:
            return told % round(self._turn)
        if told > self._highest:  # in the gap of a potentiometer
            return self._highest if told < (self._highest + self._turn) / 2 else 0
        return told


def motor_command(
    file: RegisterFile, mode: Mode, frame: PositionFrame, stepped: float, torque: float
) -> MotorCommand | None:
    """What a motor under torque is told; None where it is told nothing. `stepped`: shaft ticks where steps lead."""
    table = file.table
    top, speed = table.top_speed_ticks_s, table.role("moving_speed")
    acceleration = _rate(file, table.fields.get("acceleration") or table.fields.get("goal_acceleration"))
    if mode in POSITIONING:
        goal = stepped if mode is Mode.STEP else frame.shaft(float(file.get("goal_position")))
        return MotorCommand(goal, top, abs(_rate(file, speed)), acceleration, torque)
    if mode is Mode.NONE or not torque:
        return None
    if mode is Mode.PWM:
        wanted = top * _duty(file)
    elif table.family == "dynamixel" and "multi_turn_offset" not in table.fields:
        wanted = top * file.get("moving_speed") / _FULL_AX_SPEED
    else:
        wanted = _rate(file, speed)
    return MotorCommand(min(max(wanted, -top), top), top, 0.0, acceleration, torque, by_speed=True)


def _duty(file: RegisterFile) -> float:
    """-1..1 of the whole voltage."""
    value = file.get("goal_time")
    if "operating_mode" not in file.table.fields and value & _SCS_SIGN:
        value = -(value & _SCS_SIGN - 1)
    return min(max(value / _FULL_DUTY, -1.0), 1.0)


def _rate(file: RegisterFile, field: Field | None) -> float:
    """A speed or acceleration register in ticks and seconds, with its sign; 0 where there is none."""
    if field is None:
        return 0.0
    per_turn = 60.0 if field.unit == "rpm" else 360.0
    return field.to_unit(file.get(field.name)) * file.table.ticks_per_revolution / per_turn
