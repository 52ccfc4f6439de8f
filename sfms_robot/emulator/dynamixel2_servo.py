"""One emulated Protocol 2.0 servo: a register file with the rules of the firmware, and a plant behind it.

Control tables come from the firmware map. The servo is as unkind as the worst real one: at power-up its goal is the
middle of its range, wherever it stands, so a host that enables torque before it has set a goal sees a jump.
"""

from __future__ import annotations

import struct
from itertools import groupby
from operator import itemgetter
from typing import Final

from sfms_robot.emulator.device import EmulatedServo
from sfms_robot.emulator.dynamixel2_modes import POSITION, TORQUE_ON_BY_GOAL, TickFrames, motor_command
from sfms_robot.emulator.register_servo import RegisterServo
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.registers import Field, Table

WATCHDOG_TICK_S: Final = 0.02
REBOOT_S: Final = 0.3  # deaf and dumb after a reboot
_DELAY_TICK_S: Final = 2e-6
_MAX_ID: Final = dxl2.MAX_ID
_RESULT_FAIL: Final = 1
_GOALS: Final = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})
_BOUND_BY: Final = {"goal_pwm": "pwm_limit", "goal_current": "current_limit", "goal_velocity": "velocity_limit"}
_TURNS_CLEARED: Final = b"\x01\x44\x58\x4c\x22"  # parameters of `clear`
FAULT_BITS: Final = {"voltage": 0, "overheating": 2, "overload": 5}  # of the X series; others say it in the map
# Registers that are worked out whenever somebody reads them, in the order of the values.
LIVE: Final = (
    "realtime_tick", "moving", "moving_status", "present_pwm", "present_current", "present_load", "present_velocity",
    "present_speed", "present_position", "velocity_trajectory", "position_trajectory", "present_input_voltage",
    "present_voltage", "present_temperature",
)  # fmt: skip
_CODES: Final = {(1, "no"): "B", (2, "no"): "H", (4, "no"): "I",
                 (1, "twos_complement"): "b", (2, "twos_complement"): "h", (4, "twos_complement"): "i"}  # fmt: skip


class Dynamixel2Servo(RegisterServo):
    """`fault_status` is what `hardware_error_status` reads: latched until a reboot."""

    _frame: TickFrames

    def __init__(self, what: EmulatedServo, table: Table) -> None:
        super().__init__(table)
        self.firmware = what.firmware
        self.supply_v = _usual_supply(table) if what.supply_v is None else what.supply_v
        self._registered = b""
        self._heard_at_s = 0.0
        self._deaf_until_s = 0.0
        self._tripped = False
        self._live = PresentValues(table)
        self._bits = _fault_bits(table)
        self._reset(keep={}, areas=(True, False))
        self._take_stored(what)
        self.plant.position = self.plant.reference = TickFrames(self._file).shaft(float(what.start_ticks))
        self._power_up()

    @property
    def return_level(self) -> int:
        """0 answers pings, 1 reads too, 2 everything; below 0 nothing."""
        return -1 if self.mute else self._return_level

    # --- instructions -------------------------------------------------------------------------------------------

    def hears(self, now_s: float) -> bool:
        return self._powered and not self.dead and now_s >= self._deaf_until_s

    def read(self, address: int, length: int, now_s: float) -> tuple[int, bytes]:
        """(error, data)."""
        self.advance(now_s)
        file, end = self._file, address + length
        if length == 0 or end > len(file.raw):
            return dxl2.DATA_RANGE_ERROR, b""
        windows = file.has_windows(address, length)
        if windows or (address < self._live.end and end > self._live.address):
            self._live.put(file.raw, self._live_values(now_s))
        if windows:
            return 0, bytes(file.raw[at] for at in file.seen_through(address, length))
        return 0, bytes(file.raw[address:end])

    def write(self, address: int, data: bytes, now_s: float) -> int:
        """Error number, 0 when it was taken. Nothing is changed unless all of it is allowed."""
        self.advance(now_s)
        file = self._file
        pieces = [(address, data)]
        if file.has_windows(address, len(data)):
            pieces = _pieces(list(file.seen_through(address, len(data))), data)
        names: set[str] = set()
        for start, part in pieces:
            fields = file.covered(start, len(part))
            if not fields:
                return dxl2.ACCESS_ERROR
            for field in fields:
                if error := self._refusal(field, part, field.address - start):
                    return error
                names.add(field.name)
        for start, part in pieces:
            for field in file.covered(start, len(part)):
                offset = field.address - start
                file.raw[field.address : field.address + field.size] = part[offset : offset + field.size]
        if names == {"goal_position"}:
            self._goal_written()
        else:
            self._written(names)
        return 0

    def register(self, address: int, data: bytes) -> int:
        """Keep a write for `action`."""
        self._registered = address.to_bytes(2, "little") + data
        self._put("registered_instruction", 1)
        return 0

    def action(self, now_s: float) -> int:
        kept, self._registered = self._registered, b""
        self._put("registered_instruction", 0)
        if not kept:
            return 0
        return self.write(int.from_bytes(kept[:2], "little"), kept[2:], now_s)

    def clear(self, params: bytes, now_s: float) -> int:
        """Forget whole turns; only at rest."""
        self.advance(now_s)
        if params != _TURNS_CLEARED:
            return dxl2.DATA_RANGE_ERROR
        if self.plant.speed != 0.0:
            return _RESULT_FAIL
        self.plant.position %= self.table.ticks_per_revolution
        self.plant.reference = self.plant.position
        self._put("goal_position", round(self._frame.reported(self.plant.position)))
        self._settings()
        return 0

    def reboot(self, now_s: float) -> None:
        """RAM back to its start values, torque off, errors cleared, turns forgotten; then deaf for a while."""
        self.advance(now_s)
        self.fault_status, self._tripped, self._registered = 0, False, b""
        self._deaf_until_s = now_s + REBOOT_S
        self.plant.position %= self.table.ticks_per_revolution
        self._reset(keep={}, areas=(False,))
        self._power_up()

    def factory_reset(self, option: int, now_s: float) -> None:
        """0xFF everything, 1 all but the id, 2 all but id and baud; then a reboot."""
        kept = {0xFF: (), 1: ("id",), 2: ("id", "baud_rate")}.get(option, ())
        self._reset(keep={name: self._get(name) for name in kept}, areas=(True,))
        self.reboot(now_s)

    # --- what happens to it -------------------------------------------------------------------------------------

    def fail(self, status: int, now_s: float) -> None:
        """Latch hardware errors until a reboot; those in `shutdown` take the torque away."""
        self.advance(now_s)
        self._latch(status)

    def _lose_power(self) -> None:
        self._put("torque_enable", 0)
        self._settings()

    def _start_anew(self, now_s: float) -> None:
        self.reboot(now_s)

    def _fault_names(self) -> str:
        return self.table.fault_names(self.fault_status)

    def feed_watchdog(self, now_s: float) -> None:
        """Any instruction packet on the wire does."""
        if self.watchdog:
            self.advance(now_s)
        self._heard_at_s = now_s

    def advance(self, now_s: float) -> None:
        """Move the plant on, stopping it where the bus watchdog trips, and see what that did to it."""
        if self.watchdog > 0 and self._drive is not None:
            trip_s = self._heard_at_s + self.watchdog * WATCHDOG_TICK_S
            if now_s >= trip_s:
                self.plant.advance(trip_s, self._drive)
                self._put("bus_watchdog", -1)
                self._tripped = True
                if self.table.watchdog != "flags_only":
                    self._put("goal_position", round(self._frame.reported(self.plant.position)))
                    self._put("goal_velocity", 0)
                self._settings()
        self.plant.advance(now_s, self._drive)
        if self.plant.strained_steps and self.plant.overloaded:
            self._latch(self._bits["overload"])
        if self.plant.temperature_C > self._hottest_c:
            self._latch(self._bits["overheating"])

    # --- inside -------------------------------------------------------------------------------------------------

    def _power_up(self) -> None:
        self._put("torque_limit", self._get("max_torque"))  # XL-320
        self._put("goal_position", self.table.center_ticks)
        self._settings()
        self._watch_supply()

    def _refusal(self, field: Field, data: bytes, offset: int) -> int:
        if not field.writable or (field.eeprom and self.torque):
            return dxl2.ACCESS_ERROR
        if offset < 0 or offset + field.size > len(data):
            return dxl2.DATA_LENGTH_ERROR
        value = field.from_bytes(data[offset : offset + field.size])
        if not field.low <= value <= field.high or (field.name == "bus_watchdog" and value < 0):
            return dxl2.DATA_RANGE_ERROR
        if field.name in _GOALS:
            if self._tripped:
                return dxl2.DATA_RANGE_ERROR
            if field.name == "goal_position" and self.mode == POSITION and not self._lowest <= value <= self._highest:
                return dxl2.DATA_LIMIT_ERROR
            bound = _BOUND_BY.get(field.name, "")
            if bound in self.table.fields and abs(value) > self._get(bound):
                return dxl2.DATA_LIMIT_ERROR
        if field.name == "torque_enable" and value and self.fault_status & self._get("shutdown"):
            return dxl2.ACCESS_ERROR
        return 0

    def _latch(self, status: int) -> None:
        if self.fault_status | status == self.fault_status:
            return
        self.fault_status |= status
        self._put("hardware_error_status", self.fault_status)
        if self.fault_status & self._get("shutdown"):
            self._put("torque_enable", 0)
        self._settings()

    def _watch_supply(self) -> None:
        if self._powered and not self._volts("min_voltage_limit") <= self.supply_v <= self._volts("max_voltage_limit"):
            self._latch(self._bits["voltage"])

    def _goal_written(self) -> None:
        if not self.torque and self._get("drive_mode") & TORQUE_ON_BY_GOAL:
            if not self.fault_status & self._get("shutdown"):
                self._put("torque_enable", 1)
                self._settings()
        elif self._drive is not None:
            goal = self._frame.shaft(float(self._get("goal_position")))
            if self._by_time:
                self._settings()
            elif not self._drive.by_speed:
                self._drive = self._drive._replace(goal=goal)

    def _written(self, names: set[str]) -> None:
        if "operating_mode" in names:
            self._frame = TickFrames(self._file)
            for name in ("profile_velocity", "profile_acceleration", "goal_velocity", "goal_pwm", "goal_current"):
                self._put(name, 0)
            self._put("goal_position", round(self._frame.reported(self.plant.position)))
        if "bus_watchdog" in names:
            self._tripped = False
        self._settings()
        if "goal_position" in names:
            self._goal_written()
        if "max_voltage_limit" in names or "min_voltage_limit" in names:
            self._watch_supply()

    def _settings(self) -> None:
        """Take over what the registers say now; called after every change but a goal."""
        get = self._get
        self.id = get("id")
        second = get("secondary_id", 255)
        self.second_id: int | None = second if second <= _MAX_ID else None
        self.baud = self.table.baud_codes.get(get("baud_rate"))
        self._return_level: int = get("status_return_level", 2)
        self.return_delay_s: float = get("return_delay_time") * _DELAY_TICK_S
        self.torque: int = get("torque_enable")
        self.watchdog: int = get("bus_watchdog")
        self._frame = TickFrames(self._file)
        self.mode: int = self._frame.mode
        self._by_time = bool(get("drive_mode") & 0x04)
        last = round(self.table.ticks_per_revolution) - 1
        self._lowest: int = get("min_position_limit", get("cw_angle_limit"))
        self._highest: int = get("max_position_limit", get("ccw_angle_limit", last))
        self._hottest_c: float = float(get("temperature_limit", 255))
        self._drive = None
        if self.torque:
            self._drive = motor_command(self._file, self._frame, self.plant.reference, self.table.top_speed_ticks_s)

    def _live_values(self, now_s: float) -> tuple[int, ...]:
        plant, table, sign = self.plant, self.table, self._frame.sign
        per_tick = self._live.speed_per_tick
        top = table.top_speed_ticks_s
        speed, current = sign * plant.speed, sign * plant.current_mA()
        drive = self._drive
        arrived = drive is None or drive.by_speed or abs(drive.goal - plant.position) < 8.0
        volts = round(10.0 * self.supply_v)
        status = int(arrived) | (0 if arrived else 0x02)
        if drive is not None and not arrived and drive.profile_speed:
            status |= 0x30 if drive.profile_acceleration else 0x10
        return (
            int(now_s * 1000.0) & 0x7FFF,
            int(plant.speed != 0.0),
            status,
            round(885.0 * speed / top),
            round(current / self._live.mA_per_tick),
            round(1000.0 * sign * plant.effort),
            round(speed * per_tick),
            round(speed * per_tick),
            round(self._frame.reported(plant.position)),
            round(sign * plant.reference_speed * per_tick),
            round(self._frame.reported(plant.reference)),
            volts,
            volts,
            round(plant.temperature_C),
        )

    def _reset(self, keep: dict[str, int], areas: tuple[bool, ...]) -> None:
        for field in self.table.fields.values():
            if field.eeprom in areas:
                self._put(field.name, keep.get(field.name, field.initial))
        self._put("model_number", self.table.model_number or 0)
        self._put("firmware_version", self.firmware)


def _fault_bits(table: Table) -> dict[str, int]:
    """Mask of each fault in `hardware_error_status`."""
    out = {}
    for name, usual in FAULT_BITS.items():
        named = [bit for bit, text in table.faults.items() if name[:7] in text]
        out[name] = 1 << (named[0] if named else usual)
    return out


def _usual_supply(table: Table) -> float:
    """A supply that the model is content with."""
    highest = table["max_voltage_limit"].to_unit(table["max_voltage_limit"].initial)
    return 5.0 if highest <= 7.5 else 7.4 if highest <= 9.0 else 12.0 if highest <= 16.5 else 24.0


def _pieces(addresses: list[int], data: bytes) -> list[tuple[int, bytes]]:
    """Bytes that go to scattered addresses, joined where the addresses follow one another."""
    numbered = enumerate(addresses)
    out = []
    for _, run in groupby(numbered, lambda item: item[1] - item[0]):
        places = list(run)
        out.append((places[0][1], bytes(data[index] for index, _ in places)))
    return out


# --- registers that are worked out at every read: position, speed, voltage, ... -------------------------------------


class PresentValues:
    """Where the live registers of a model lie. Every X-series table holds them in one block: one struct fills it."""

    def __init__(self, table: Table) -> None:
        fields = [table[name] for name in LIVE if name in table.fields]
        self._pick = itemgetter(*(i for i, name in enumerate(LIVE) if name in table.fields))
        self._fields = fields
        self.address = min(field.address for field in fields)
        self.end = max(field.address + field.size for field in fields)
        speed = table.fields.get("present_velocity") or table["present_speed"]
        self.speed_per_tick = 60.0 / (table.ticks_per_revolution * speed.scale)
        current = table.fields.get("present_current")
        self.mA_per_tick = current.scale if current is not None else 1.0
        layout = struct.Struct("<" + "".join(_CODES.get((field.size, field.sign), "") for field in fields))
        in_order = [f.address for f in fields] == sorted(f.address for f in fields)
        self._block = layout if in_order and layout.size == self.end - self.address else None

    def put(self, raw: bytearray, values: tuple[int, ...]) -> None:
        chosen = self._pick(values)
        if self._block is not None:
            self._block.pack_into(raw, self.address, *chosen)
            return
        for field, value in zip(self._fields, chosen, strict=True):
            held = min(max(value, field.low), field.high)
            raw[field.address : field.address + field.size] = field.to_bytes(held)
