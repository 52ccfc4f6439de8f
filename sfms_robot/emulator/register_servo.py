"""Emulated servo with a control table: registers with the rules of its firmware, and the motor that they drive.

The servo behaves like the worst real servo. At power-up its goal is the middle of its range, at any position, so it
jumps if a host enables torque before it has set a goal. Dynamixel 1.0 and Feetech switch their torque on when a goal is
written. A locked EEPROM accepts a value and loses it at the next power-up (Feetech), or ignores it without an error
(Dynamixel 1.0). In cases that the sources do not describe, the servo does the least helpful thing.

    rule                    Dynamixel 2.0                 Dynamixel 1.0                Feetech
    bad write               one error number, no change   error bits, no change        no error, the rest is written
    faults                  latched until a reboot        in each status, overload     as Dynamixel 1.0
                                                          until torque is enabled
    supply out of limits    latched                       as long as it lasts          as long as it lasts
    EEPROM under torque     access error                  written                      written
    read beyond the table   data range error              range error                  answered up to address 255

Sources: ROBOTIS e-manual, control tables of the X series, xl320, ax-12a and mx-28, "Status Packet", "Bus Watchdog";
Feetech memory table V3.6 and communication protocol manual.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import reduce
from typing import Final

from sfms_robot.data import Report
from sfms_robot.emulator.control_table import (
    POSITIONING,
    TORQUE_ON_BY_GOAL,
    ControlTable,
    Mode,
    ServoFrame,
    angle_limits,
    mode_of,
    motor_command,
)
from sfms_robot.emulator.emulated_wire import EmulatedServo
from sfms_robot.emulator.plant import MotorCommand, Plant
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.registers import Field, Table, Values

WATCHDOG_TICK_S: Final = 0.02
_CHECK_S: Final = 0.1  # interval at which the firmware checks the load and the temperature of its motor
_DELAY_TICK_S: Final = 2e-6  # unit of the return delay
_BROWN_OUT: Final = 0.7  # fraction of the lowest allowed supply, below which the controller itself stops
_BAUD_TOLERANCE: Final = 0.03  # rate error that a UART tolerates
_FULL_TORQUE: Final = 1000
_NEAR_TICKS: Final = 8.0  # distance from its goal within which a Dynamixel 2.0 reports "in position"
USUAL_BITS: Final = {"voltage": 0x01, "overheating": 0x04, "overload": 0x20}  # for faults not in the firmware map
_SUPPLIES: Final = ((7.5, 5.0), (9.0, 7.4), (16.5, 12.0))  # highest allowed supply up to this [V] -> usual supply
_PENDING: Final = ("registered_instruction", "registered", "async_write_flag")  # 1 from REG WRITE to ACTION


class RegisterServo(ABC):
    """A servo that answers instructions. All times are seconds of the wire's clock.

    Attributes:
        dead: True if it is silent, as with its cable unplugged; its motor keeps following its last command.
        mute: True if it obeys, but never answers.
        fault_status: Bits of its faults, with the numbers of the firmware map.
        plant: The motor; its ticks are those of the shaft.
        group_reads: Instructions to several servos at once that it answers.
        fault_bits: Bit of the voltage, overheating and overload fault, by name.
        id, second_id, baud, return_delay_s, torque: Present values of the registers.
    """

    def __init__(self, what: EmulatedServo, table: Table) -> None:
        self.table = table
        self.dead = self.mute = False
        self.fault_status = 0
        self.firmware = what.firmware
        self.drive: MotorCommand | None = None
        self._is_feetech = table.family == "feetech"
        self._memory = ControlTable(table)
        self._get, self._put = self._memory.get, self._memory.put
        self._registered: tuple[int, bytes] | None = None
        self._powered, self._tripped = True, False
        self._received_at_s = self._deaf_until_s = 0.0
        self._checks = 0
        self._roles = {field.name: role for role in table.roles if (field := table.role(role))}
        speed = table.role("present_speed")
        self._speed_unit = table.in_ticks(speed) if speed else 1.0
        current = table.role("present_current")
        self._current_scale = current.scale or 1.0 if current else 1.0
        named = table.servo_faults.items()
        self.fault_bits = USUAL_BITS | {name: 1 << bit for bit, text in named for name in USUAL_BITS if name in text}
        self._reset_registers()
        self._put("id", what.id)
        self._put("baud_rate", next(code for code, rate in table.baud_codes.items() if rate == what.baud))
        for name, value in what.registers.items():
            self._put(name, value)
        self._stored = bytes(self._memory.raw)
        shaft = ServoFrame(self._memory, mode_of(self._memory)).shaft(float(what.start_ticks))
        self.plant = Plant(shaft, reference=shaft)
        highest = self._volts("max_voltage_limit")
        usual = next((volts for limit, volts in _SUPPLIES if highest <= limit), 24.0)
        self.supply_v = usual if what.supply_v is None else what.supply_v
        self._power_up()

    # --- instructions -------------------------------------------------------------------------------------------

    def hears(self, baud: int | None, now_s: float) -> bool:
        """Return whether it can receive from a host at `baud` now."""
        awake = self._powered and not self.dead and now_s >= self._deaf_until_s
        if not awake or self.baud is None or baud is None:
            return False
        return abs(self.baud - baud) <= _BAUD_TOLERANCE * self.baud

    def answers(self, level: int) -> bool:
        """Return whether it answers instructions of a status return level: 0 ping, 1 read, 2 all others."""
        return not self.mute and self._level >= level

    def read(self, address: int, length: int, now_s: float) -> tuple[int, bytes]:
        """Read a block of registers; return (error, data)."""
        self.advance(now_s)
        if length == 0 or address + length > len(self._memory.raw):
            return (0 if self._is_feetech else self._beyond), b""
        data = b""
        for start, size in self._memory.runs(address, length):
            for field in self._memory.covered(start, size):
                if (now := self._measured(self._roles.get(field.name, field.name), now_s)) is not None:
                    self._put(field.name, round(now))
            data += self._memory.raw[start : start + size]
        return 0, data

    def _measured(self, role: str, now_s: float) -> float | None:
        """Return the unrounded value of a register that is computed at every read; None for any other register."""
        plant, sign, drive = self.plant, self.frame.sign, self.drive
        match role:
            case "present_position":
                return self.frame.shown(plant.position)
            case "present_speed":
                return sign * plant.speed / self._speed_unit
            case "present_current":
                return sign * plant.current_mA() / self._current_scale
            case "present_load":
                return 1000.0 * sign * plant.effort
            case "present_pwm":
                return 885.0 * sign * plant.speed / self.table.top_speed_ticks_s
            case "voltage":
                return 10.0 * self.supply_v
            case "temperature":
                return plant.temperature_C
            case "moving":
                return plant.speed != 0.0
            case "moving_status":  # bit 0: in position, bit 1: profile in progress, bits 4 and 5: kind of profile
                if drive is None or drive.by_speed or abs(drive.goal - plant.position) < _NEAR_TICKS:
                    return 0x01
                return 0x02 | (0x30 if drive.profile_acceleration else 0x10) * bool(drive.profile_speed)
            case "realtime_tick":
                return int(now_s * 1000.0) & 0x7FFF
            case "velocity_trajectory":
                return sign * plant.reference_speed / self._speed_unit
            case "position_trajectory":
                return self.frame.reported(plant.reference)
            case "error_status":
                return self.fault_status
        return None

    def write(self, address: int, data: bytes, now_s: float) -> int:
        """Write a block; return the error, 0 if there is none. A Dynamixel writes nothing unless all of it is valid."""
        self.advance(now_s)
        wanted: dict[str, int] = {}
        errors: list[int] = []
        done = 0
        for start, size in self._memory.runs(address, len(data)):
            part = data[done : done + size]
            done += size
            fields = self._memory.covered(start, size)
            errors += [] if fields else [self._unknown]
            for field in fields:
                at = field.address - start
                whole = 0 <= at <= size - field.size
                value = field.from_bytes(part[at : at + field.size]) if whole else None
                error = self._refusal(field, value)
                if value is None or error:
                    errors.append(error)
                else:
                    wanted[field.name] = value
        counted = errors[:1] if self.table.protocol == 2 else errors  # one number, or bits
        error = 0 if self._is_feetech else reduce(int.__or__, counted, 0)
        if not error:
            self._apply(wanted)
        return error

    def register(self, address: int, data: bytes) -> int:
        """Store a write for `action`."""
        self._set_registered((address, data))
        return 0

    def action(self, now_s: float) -> int:
        """Execute the registered write; return the error."""
        kept = self._registered
        self._set_registered(None)
        if kept is None:
            return self._nothing_registered
        return self.write(*kept, now_s)

    def factory_reset(self, now_s: float, keep: Sequence[str] = ()) -> None:
        """Set all registers except those in `keep` to their factory values, and restart."""
        self.advance(now_s)
        kept = {name: self._get(name) for name in keep}
        self._reset_registers()
        for name, value in kept.items():
            self._put(name, value)
        self._stored = bytes(self._memory.raw)
        self.power_cycle(now_s)

    def forget_turns(self, now_s: float) -> None:
        """Reduce the position to one turn; the shaft stays."""
        self.advance(now_s)
        self.plant.position %= self.table.ticks_per_revolution
        self.plant.reference = self.plant.position
        self._stay()
        self._settings()

    def feed_watchdog(self, now_s: float) -> None:
        """Note that a packet was on the wire; any instruction, to any servo, feeds the bus watchdog."""
        if self._watchdog:
            self.advance(now_s)
        self._received_at_s = now_s

    # --- events -------------------------------------------------------------------------------------------------

    def power_cycle(self, now_s: float) -> None:
        """Restart; RAM, whole turns, latched faults and values not stored (locked EEPROM) are lost. The shaft stays."""
        self.advance(now_s)
        self._memory.raw[:] = self._stored
        self.plant.position %= self.table.ticks_per_revolution
        self.fault_status, self._registered, self._tripped = 0, None, False
        self._deaf_until_s = now_s + self._start_s
        self._power_up()

    def fail(self, bits: int, now_s: float) -> None:
        """Set faults, as bits of `fault_status`; faults in the shutdown register switch torque off."""
        self.advance(now_s)
        self._fail(bits)

    def set_supply(self, volts: float, now_s: float) -> None:
        """Change the supply. If it is too low, the controller stops, and restarts when the supply is back."""
        self.advance(now_s)
        self.supply_v = volts
        was_powered, self._powered = self._powered, volts >= _BROWN_OUT * self._volts("min_voltage_limit")
        if not self._powered:
            self._put("torque_enable", 0)
            self._settings()
        elif not was_powered:
            self.power_cycle(now_s)
        self._watch_supply()

    def turn(self, ticks: float, now_s: float) -> None:
        """Turn the shaft by hand to reported position `ticks`."""
        self.advance(now_s)
        self.plant.position = self.frame.shaft(ticks)

    def state(self, now_s: float) -> Report:
        """Return the true state of the servo, independent of the wire."""
        self.advance(now_s)
        return {
            "position": self.frame.reported(self.plant.position),
            "speed": self.frame.sign * self.plant.speed,
            "goal": self._get("goal_position"),
            "torque": self._powered and self.torque == 1,
            "faults": ", ".join(self.table.faults_in(self.fault_status)),
            "temperature_C": self.plant.temperature_C,
        }

    def advance(self, now_s: float) -> None:
        """Advance the motor. If the bus watchdog trips meanwhile, it takes effect at that time."""
        trip_s = self._received_at_s + self._watchdog * WATCHDOG_TICK_S
        if self.drive is not None and self._watchdog > 0 and now_s >= trip_s:
            self._advance(trip_s)
            self._put("bus_watchdog", -1)
            self._tripped = True
            if self.table.watchdog != "flags_only":  # since firmware 53 the servo stops at its position
                self._stay()
                self._put("goal_velocity", 0)
            self._settings()
        self._advance(now_s)

    def _advance(self, now_s: float) -> None:
        """Advance the motor; its firmware checks it on a fixed grid of time, independent of the times of reads."""
        while self._checks * _CHECK_S <= now_s:
            if self.drive is None:
                self._checks = int(now_s / _CHECK_S) + 1
                break
            self.plant.advance(self._checks * _CHECK_S, self.drive)
            self._checks += 1
            self._watch_motor()
        self.plant.advance(now_s, self.drive)
        if self.drive is None:
            self._watch_motor()

    # --- firmware -----------------------------------------------------------------------------------------------

    group_reads: set[int]
    _beyond: int  # error of a read beyond the table
    _unknown: int  # error of a write to an address without register
    _nothing_registered = 0
    _start_s = 0.0  # time after power-up in which it neither receives nor answers

    @property
    def alert(self) -> int:
        """Return the bits that its faults add to the error of every answer."""
        return self.fault_status

    @abstractmethod
    def _refusal(self, field: Field, value: int | None) -> int:
        """Return the error of a write to a register, 0 for none. `value` None: a write of only a part of it."""

    def _apply(self, wanted: Values) -> None:
        locked = self._get("lock") == 1
        for name, value in wanted.items():
            field = self.table[name]
            if locked and not self._is_feetech and (field.eeprom or name == "lock"):
                continue  # a locked Dynamixel stays locked until its supply is switched off
            if name == "goal_position" and self._is_feetech and self._mode is Mode.JOINT:  # clipped, not refused
                value = min(max(value, self._lowest), self._highest) if self._lowest < self._highest else value
            self._put(name, value)
            if field.eeprom and not locked:
                self._keep(field)
        torque = self.table.role("torque_enable")
        if torque is not None and torque.name in wanted:
            self._torque_written(wanted[torque.name], locked)
        elif "goal_position" in wanted and self._goal_enables and not self.torque and not self._shut_down():
            self._put("torque_enable", 1)
        elif not self._by_time and wanted.keys() == {"goal_position"}:  # the write of every tick
            if self.drive is not None and self._mode in POSITIONING:
                goal = self.frame.shaft(float(self._get("goal_position")))
                stepped = self._stepped(wanted["goal_position"])
                self.drive = self.drive._replace(goal=stepped if self._mode is Mode.STEP else goal)
            return
        self._settings(wanted.get("goal_position", 0))
        if wanted.keys() & {"min_voltage_limit", "max_voltage_limit"}:
            self._watch_supply()

    def _stay(self) -> None:
        """Set the goal to the present position."""
        self._put("goal_position", round(self.frame.reported(self.plant.position)))

    def _keep(self, field: Field) -> None:
        """Store a register, so that it survives the next power-up."""
        end = field.address + field.size
        self._stored = self._stored[: field.address] + bytes(self._memory.raw[field.address : end]) + self._stored[end:]

    def _stepped(self, step: int) -> float:
        """Return the goal of the steps written so far and another step in step mode, in shaft ticks."""
        start = self.drive.goal if self.drive is not None and self._mode is Mode.STEP else self.plant.position
        return start + step

    def _torque_written(self, value: int, locked: bool) -> None:
        """Apply the other effects of a write to torque enable."""
        return

    def _set_registered(self, write: tuple[int, bytes] | None) -> None:
        self._registered = write
        for name in _PENDING:
            self._put(name, int(write is not None))

    def _shut_down(self) -> bool:
        return bool(self.fault_status & self._get("shutdown", self._get("unloading_condition")))

    def _fail(self, bits: int) -> None:
        self.fault_status |= bits
        if self._shut_down():
            self._put("torque_enable", 0)
        self._settings()

    def _watch_motor(self) -> None:
        if self.plant.overloaded and not self.fault_status & self.fault_bits["overload"]:
            self._fail(self.fault_bits["overload"])
        if 0 < self._hottest_C < self.plant.temperature_C:
            self._fail(self.fault_bits["overheating"])

    def _watch_supply(self) -> None:
        low, high = self._volts("min_voltage_limit"), self._volts("max_voltage_limit")
        if self._powered and high and not low <= self.supply_v <= high:
            self._fail(self.fault_bits["voltage"])
        elif self.table.protocol == 1:
            self.fault_status &= ~self.fault_bits["voltage"]

    def _power_up(self) -> None:
        for field in self.table.fields.values():
            if not field.eeprom:
                self._put(field.name, field.initial)
        self._put("torque_enable", 0)
        self._put("goal_position", self.table.center_ticks)  # the least helpful goal: with torque it jumps
        self._put("torque_limit", self._get("max_torque") or _FULL_TORQUE)
        self._settings()
        self._watch_supply()

    def _reset_registers(self) -> None:
        """Set all registers to their factory values."""
        for field in self.table.fields.values():
            self._put(field.name, field.initial)
        self._put("model_number", self.table.model_number or 0)
        self._put("firmware_version", self.firmware)
        self._put("firmware_major", self.firmware)
        self._put("endianness_flag", int(self.table.byte_order == "big"))

    def _settings(self, step: int = 0) -> None:
        """Update all settings from the registers. `step`: a step that has just been written, in step mode."""
        get, stepped = self._get, self._stepped(step)
        self.id = get("id")
        second = get("secondary_id", 255)
        self.second_id = second if second <= dxl2.MAX_ID and second != self.id else None
        self.baud = self.table.baud_codes.get(get("baud_rate"))
        self.return_delay_s = _DELAY_TICK_S * get("return_delay")
        self._level = get("status_level", 2) + self._is_feetech  # a Feetech answers reads at level 0 too
        self.torque = get("torque_enable")
        self._watchdog, self._hottest_C = get("bus_watchdog"), get("temperature_limit")
        self._lowest, self._highest = angle_limits(self._memory)
        # Only Protocol 2.0 has drive mode (10); all other servos always switch torque on by a goal.
        drive_mode = get("drive_mode") if self.table.protocol == 2 else TORQUE_ON_BY_GOAL
        self._goal_enables, self._by_time = bool(drive_mode & TORQUE_ON_BY_GOAL), bool(drive_mode & 0x04)
        self._mode = mode_of(self._memory)
        self.frame = ServoFrame(self._memory, self._mode)
        self.drive = None
        if self.torque == 1:
            self.drive = motor_command(self._memory, self._mode, self.frame, self.plant.reference, stepped)

    def _volts(self, name: str) -> float:
        return self.table[name].to_unit(self._get(name))
