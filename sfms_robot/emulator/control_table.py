"""Control table of an emulated servo: its bytes, and the commands for the motor that follow from them.

    family         mode              selected by                        goal
    X, MX (2.0)    current           operating mode 0                   goal current (102), fraction of its limit (38)
    X, MX (2.0)    velocity          operating mode 1                   goal velocity (104)
    X, MX (2.0)    position          operating mode 3                   goal position (116) within one turn
    X, MX (2.0)    extended          operating mode 4                   goal position (116) over many turns
    X, MX (2.0)    current-based     operating mode 5                   goal position (116), torque: goal current (102)
    X, MX (2.0)    PWM               operating mode 16                  goal PWM (100), 885 = full voltage
    XL-320         wheel, joint      control mode 1, 2                  moving speed (32), goal position (30)
    AX             wheel             both angle limits 0                moving speed (32), open loop, 1023 = full
    MX (1.0)       wheel             both angle limits 0                moving speed (32), closed loop, 0.114 rpm
    MX (1.0)       multi-turn        both angle limits 4095             goal position (30), offset (20), divider (22)
    STS            wheel             register 33 = 1                    goal speed (46), step/s
    STS            PWM               register 33 = 2                    register 44, sign in bit 11, 1000 = full voltage
    STS            step              register 33 = 3                    goal position (42), relative to the last goal
    STS            multi-turn        both angle limits 0                goal position (42) beyond one turn
    SCS            PWM               both angle limits 0                register 44, sign in bit 10, 1000 = full voltage

In all other cases the servo is a joint: it moves to a position within its angle limits. A Dynamixel 1.0 whose lower
limit is not below the upper one does not drive its motor.

Sources: ROBOTIS e-manual, "Operating Mode (11)", "Drive Mode (10)", "Homing Offset (20)", "Profile Velocity (112)" of
the X series, "CW/CCW Angle Limit" and "Moving Speed" of ax-12a and mx-28; Feetech memory table V3.6 and the SCS15
manual, "Minimum/Maximum angle", "Operating mode", "Running time".
"""

from __future__ import annotations

from enum import Enum, auto
from functools import lru_cache
from typing import Final

from sfms_robot.emulator.plant import MotorCommand
from sfms_robot.servo.registers import Field, Table

_WHOLE_SPACE: Final = 256
_WINDOW: Final = "indirect_data_"
_CACHED: Final = 1024  # size of the cache of `covered`: a host that sends noise must not fill the memory
_REVERSE, _PROFILE_BY_TIME, TORQUE_ON_BY_GOAL = 0x01, 0x04, 0x08  # drive mode (10), bits 0, 2 and 3
_SINGLE_TURN_OFFSET: Final = 1024  # homing offset (20) is limited to +-90 degrees in position mode
_MX_MULTI_TURN: Final = 4095
_FULL_PWM: Final = 885.0  # goal PWM (100): 100 %
_FULL_DUTY: Final = 1000.0  # Feetech, register 44 in PWM mode: 100 %
_FULL_TORQUE: Final = 1000  # torque limit, in units of 0.1 %, although Dynamixels allow values up to 1023
_FULL_AX_SPEED: Final = 1023.0
_SCS_SIGN: Final = 1 << 10
_COUNTS_TURNS: Final = 0x10  # STS phase (18), bit 4: positions beyond one turn are reported


class ControlTable:
    """Values of registers, by name or by role in their family, and raw bytes by address.

    Reading an absent register returns a default.

    An indirect data register is a window: byte k of the block shows the byte at the address in `indirect_address_k`.
    The address of the block is in the firmware map (it differs for X330 servos up to firmware 52).

    A Feetech answers a read of any address.
    """

    def __init__(self, table: Table) -> None:
        self.table = table
        self.raw = bytearray(_WHOLE_SPACE if table.family == "feetech" else table.size)
        fields = table.fields
        self._named = {role: field for role in table.roles if (field := table.role(role))} | dict(fields)
        self._ranges = {name: _value_range(field) for name, field in self._named.items()}
        self.covered = lru_cache(maxsize=_CACHED)(self._covered)
        self._windows = {  # address of an indirect data byte -> address of the word with the address that it shows
            field.address: fields[word].address
            for name, field in fields.items()
            if name.startswith(_WINDOW) and (word := f"indirect_address_{name.removeprefix(_WINDOW)}") in fields
        }
        self._first_window = min(self._windows, default=table.size)
        self._last_window = max(self._windows, default=-1)

    def get(self, name: str, default: int = 0) -> int:
        field = self._named.get(name)
        return default if field is None else field.from_bytes(self.raw[field.address : field.address + field.size])

    def put(self, name: str, value: int) -> None:
        """Set a register to the nearest value that it can hold; do nothing if the model has no such register."""
        field = self._named.get(name)
        if field is not None:
            low, high = self._ranges[name]
            self.raw[field.address : field.address + field.size] = field.to_bytes(min(max(value, low), high))

    def _covered(self, address: int, length: int) -> tuple[Field, ...]:
        """Return the registers that lie, wholly or in part, in a block."""
        end = address + length
        return tuple(f for f in self.table.fields.values() if f.address < end and f.address + f.size > address)

    def runs(self, address: int, length: int) -> list[tuple[int, int]]:
        """Return (address, length) of the pieces of memory that a block shows, with its windows resolved."""
        if address > self._last_window or address + length <= self._first_window:
            return [(address, length)]
        out: list[tuple[int, int]] = []
        for at in range(address, address + length):
            word = self._windows.get(at, -1)
            target = at if word < 0 else self.raw[word] | self.raw[word + 1] << 8
            if target >= len(self.raw) or (target != at and target in self._windows):  # no window of a window
                target = at
            if out and sum(out[-1]) == target:
                out[-1] = (out[-1][0], out[-1][1] + 1)
            else:
                out.append((target, 1))
        return out


def _value_range(field: Field) -> tuple[int, int]:
    """Return the smallest and the largest value that fit the register's size and sign rule."""
    if bit := field.sign_bit:
        return 1 - bit, bit - 1
    bits = 12 if field.signed == "offset_2048" else 8 * field.size
    low = -(1 << bits - 1) if field.signed != "no" else 0
    return low, low + (1 << bits) - 1


# --- modes ----------------------------------------------------------------------------------------------------------


class Mode(Enum):
    JOINT = auto()
    MULTI_TURN = auto()
    CURRENT_POSITION = auto()
    STEP = auto()
    WHEEL = auto()
    PWM = auto()
    CURRENT = auto()
    NONE = auto()


POSITIONING: Final = frozenset({Mode.JOINT, Mode.MULTI_TURN, Mode.CURRENT_POSITION, Mode.STEP})
_MODES: Final = {  # family, register -> value -> mode
    ("dynamixel", "operating_mode"): {
        0: Mode.CURRENT,
        1: Mode.WHEEL,
        3: Mode.JOINT,
        4: Mode.MULTI_TURN,
        5: Mode.CURRENT_POSITION,
        16: Mode.PWM,
    },
    ("dynamixel", "control_mode"): {1: Mode.WHEEL, 2: Mode.JOINT},
    ("feetech", "operating_mode"): {0: Mode.JOINT, 1: Mode.WHEEL, 2: Mode.PWM, 3: Mode.STEP},
}


def angle_limits(memory: ControlTable) -> tuple[int, int]:
    """Return the lowest and the highest goal of a joint; one whole turn if the model has no limits."""
    last = round(memory.table.ticks_per_revolution) - 1
    lowest = memory.get("min_position_limit", memory.get("cw_angle_limit"))
    return lowest, memory.get("max_position_limit", memory.get("ccw_angle_limit", last))


def mode_of(memory: ControlTable) -> Mode:
    """Return the mode that the registers select: the last matching row of the table at the top."""
    limits, table = angle_limits(memory), memory.table
    is_feetech, selector = table.family == "feetech", table.role("operating_mode")
    if selector is not None:
        modes = _MODES.get((table.family, selector.name))
        mode = Mode.JOINT if modes is None else modes.get(memory.get(selector.name), Mode.NONE)
        return Mode.MULTI_TURN if is_feetech and mode is Mode.JOINT and limits == (0, 0) else mode
    if limits == (0, 0):
        return Mode.PWM if is_feetech else Mode.WHEEL
    if limits == (_MX_MULTI_TURN, _MX_MULTI_TURN) and "multi_turn_offset" in table.fields:
        return Mode.MULTI_TURN
    return Mode.JOINT if is_feetech or limits[0] < limits[1] else Mode.NONE


class ServoFrame:
    """Conversion of position registers and ticks of the shaft: register = sign * shaft / divider + offset.

    Attributes:
        sign: -1 if the drive mode of a Dynamixel 2.0 reverses the direction. The homing offset keeps its sign.
    """

    def __init__(self, memory: ControlTable, mode: Mode) -> None:
        table, get, goal = memory.table, memory.get, memory.table["goal_position"]
        self._turn = table.ticks_per_revolution
        self._highest = goal.high if goal.high < self._turn else None  # a potentiometer covers only a part of the turn
        self._divider, self.sign = 1, 1.0
        homing = get("homing_offset")
        if table.protocol == 2:
            if mode is Mode.JOINT:
                homing = min(max(homing, -_SINGLE_TURN_OFFSET), _SINGLE_TURN_OFFSET)
            self._offset, self._counts = float(homing), self._highest is None
            if get("drive_mode") & _REVERSE:
                self.sign = -1.0
                self._offset += self._turn if mode is Mode.JOINT else 0.0
        elif mode is Mode.MULTI_TURN and "multi_turn_offset" in table.fields:  # MX (1.0)
            self._divider = max(1, get("resolution_divider", 1))
            self._offset, self._counts = float(get("multi_turn_offset")), True
        else:  # the offset of an STS is subtracted
            self._offset = -float(homing)
            self._counts = bool(get("phase") & _COUNTS_TURNS and "operating_mode" in table.fields)

    def reported(self, shaft: float) -> float:
        """Return the position in ticks of the registers, also beyond one turn."""
        return self.sign * shaft / self._divider + self._offset

    def shaft(self, reported: float) -> float:
        """Return the position of the shaft from a reported position."""
        return self.sign * (reported - self._offset) * self._divider

    def shown(self, shaft: float) -> int:
        """Return the value of register present position.

        A servo that does not count turns reports a position in one turn, and with a potentiometer none in its gap.
        """
        ticks = round(self.reported(shaft))
        if self._counts:
            return ticks
        ticks = round(ticks % self._turn) if not 0 <= ticks < self._turn else ticks
        if self._highest is None:
            return ticks % round(self._turn)
        if ticks > self._highest:  # in the gap of a potentiometer
            return self._highest if ticks < (self._highest + self._turn) / 2 else 0
        return ticks


def motor_command(
    memory: ControlTable, mode: Mode, frame: ServoFrame, reference: float, stepped: float
) -> MotorCommand | None:
    """Return the command of a motor under torque, or None if the registers command nothing.

    Args:
        reference: Position of the profile, ticks of the shaft.
        stepped: Goal of the steps in step mode, ticks of the shaft.
    """
    table, get = memory.table, memory.get
    top, torque = table.top_speed_ticks_s, min(1.0, get("torque_limit", _FULL_TORQUE) / _FULL_TORQUE)
    if not torque or mode is Mode.NONE:
        return None
    current = get("goal_current") / max(1, get("current_limit", 1))
    if mode in POSITIONING:
        goal = stepped if mode is Mode.STEP else frame.shaft(float(get("goal_position")))
        speed, acceleration = _profile(memory, abs(goal - reference))
        torque = min(1.0, abs(current)) if mode is Mode.CURRENT_POSITION else torque
        return MotorCommand(goal, top, speed, acceleration, torque)
    acceleration = _profile(memory, 0.0)[1]
    if mode is Mode.WHEEL and table.protocol == 1 and not {"multi_turn_offset", "goal_velocity"} & table.fields.keys():
        wanted = top * get("moving_speed") / _FULL_AX_SPEED
    elif mode is Mode.WHEEL:
        wanted = _rate(memory, table.fields.get("goal_velocity") or table.role("moving_speed"))
    elif mode is Mode.CURRENT:
        wanted, acceleration, torque = top * current, 0.0, min(1.0, abs(current))
    elif "goal_pwm" in table.fields:
        wanted, acceleration = top * get("goal_pwm") / _FULL_PWM, 0.0
    else:
        wanted = top * _duty(memory)
    return MotorCommand(frame.sign * min(max(wanted, -top), top), top, 0.0, acceleration, torque, by_speed=True)


def _profile(memory: ControlTable, distance: float) -> tuple[float, float]:
    """Return the limits of speed and acceleration over `distance`, in ticks and seconds; 0 means unlimited."""
    table = memory.table
    if memory.get("drive_mode") & _PROFILE_BY_TIME and table.protocol == 2:  # both registers are durations in ms
        whole_ms = memory.get("profile_velocity")
        ramp_s = min(memory.get("profile_acceleration"), whole_ms / 2) / 1e3
        if not whole_ms or not distance:
            return 0.0, 0.0
        speed = distance / (whole_ms / 1e3 - ramp_s)
        return speed, speed / ramp_s if ramp_s else 0.0
    return abs(_rate(memory, table.role("moving_speed"))), _rate(memory, table.acceleration)


def _duty(memory: ControlTable) -> float:
    """Return the duty cycle of a Feetech in PWM mode, -1..1."""
    value = memory.get("goal_time")
    if "operating_mode" not in memory.table.fields and value & _SCS_SIGN:
        value = -(value & _SCS_SIGN - 1)
    return min(max(value / _FULL_DUTY, -1.0), 1.0)


def _rate(memory: ControlTable, field: Field | None) -> float:
    """Return a speed or an acceleration in ticks and seconds, with its sign; 0 if the model has no such register."""
    return 0.0 if field is None else memory.table.in_ticks(field, memory.get(field.name))
