"""One emulated servo: a register file with the rules of the firmware, and a plant behind it.

Control tables come from the firmware map. The servo is as unkind as the worst real one: at power-up its goal is the
middle of its range, wherever it stands, so a host that enables torque before it has set a goal sees a jump.

Not modelled: homing offset, reverse mode, profiles by time, indirect addressing, and any operating mode but the
three position modes (3, 4, 5), in which alone the motor moves.
"""

from __future__ import annotations

import struct
from typing import Final

from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.registers import Field, Table
from sfms_robot.simulator.plant import Drive, Plant

WATCHDOG_TICK_S: Final = 0.02
_POSITION_MODES: Final = (3, 4, 5)
_SUPPLY_RAW: Final = 50  # 5.0 V
_TEMPERATURE_C: Final = 31
_GOALS: Final = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})
# Registers that are worked out whenever somebody reads them, in the order of `_live_values`.
_LIVE: Final = (
    "realtime_tick", "moving", "moving_status", "present_pwm", "present_current", "present_velocity",
    "present_position", "velocity_trajectory", "position_trajectory", "present_input_voltage", "present_temperature",
)  # fmt: skip
_STRUCT_CODES: Final = {
    (1, False): "B",
    (2, False): "H",
    (4, False): "I",
    (1, True): "b",
    (2, True): "h",
    (4, True): "i",
}


class Servo:
    """A servo that answers instructions. All times are seconds of the chain's clock."""

    def __init__(self, servo_id: int, table: Table, baud: int, start_ticks: int, firmware: int) -> None:
        self.table = table
        self.dead = False
        self.fault_status = 0
        self.plant = Plant(float(start_ticks), reference=float(start_ticks))
        self._memory = bytearray(table.size)
        self._firmware = firmware
        self._plans: dict[tuple[int, int], tuple[Field, ...]] = {}
        self._registered = b""
        self._heard_at_s = 0.0
        self._tripped = False
        self._drive: Drive | None = None
        self._live_address, self._live = _live_struct(table)
        self._reset(keep={}, areas=(True, False))
        self._put("id", servo_id)
        self._put("baud_rate", next(code for code, rate in table.baud_codes.items() if rate == baud))
        self._put("goal_position", table.center_ticks)
        self._settings()

    # --- instructions -------------------------------------------------------------------------------------------

    def read(self, address: int, length: int, now_s: float) -> tuple[int, bytes]:
        """(error, data)."""
        self.advance(now_s)
        end = address + length
        if length == 0 or end > len(self._memory):
            return dxl2.DATA_RANGE_ERROR, b""
        if address < self._live_address + self._live.size and end > self._live_address:
            self._live.pack_into(self._memory, self._live_address, *self._live_values(now_s))
        return 0, bytes(self._memory[address:end])

    def write(self, address: int, data: bytes, now_s: float) -> int:
        """Error number, 0 when it was taken. Nothing is changed unless all of it is allowed."""
        self.advance(now_s)
        plan = self._plans.get((address, len(data)))
        if plan is None:
            plan = self._plans[address, len(data)] = self._covered(address, address + len(data))
        if not plan:
            return dxl2.ACCESS_ERROR
        for field in plan:
            error = self._refusal(field, data, field.address - address)
            if error:
                return error
        for field in plan:
            offset = field.address - address
            self._memory[field.address : field.address + field.size] = data[offset : offset + field.size]
        if len(plan) == 1 and plan[0].name == "goal_position":
            self._goal_written()
        else:
            self._written({field.name for field in plan})
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

    def reboot(self, now_s: float) -> None:
        """RAM back to its start values, torque off, hardware error cleared. The shaft stays where it is."""
        self.advance(now_s)
        self.fault_status, self._tripped, self._registered = 0, False, b""
        self._reset(keep={}, areas=(False,))
        self._put("goal_position", self.table.center_ticks)
        self._settings()

    def factory_reset(self, option: int, now_s: float) -> None:
        """0xFF everything, 1 all but the id, 2 all but id and baud; then a reboot."""
        kept = {0xFF: (), 1: ("id",), 2: ("id", "baud_rate")}.get(option, ())
        self._reset(keep={name: self._get(name) for name in kept}, areas=(True,))
        self.reboot(now_s)

    def fail(self, status: int, now_s: float) -> None:
        """Latch hardware errors until a reboot; those in `shutdown` take the torque away."""
        self.advance(now_s)
        self.fault_status |= status
        self._put("hardware_error_status", self.fault_status)
        if self.fault_status & self._get("shutdown"):
            self._put("torque_enable", 0)
        self._settings()

    def feed_watchdog(self, now_s: float) -> None:
        """Any instruction packet on the wire does."""
        if self.watchdog:
            self.advance(now_s)
        self._heard_at_s = now_s

    def advance(self, now_s: float) -> None:
        """Move the plant on, stopping it where the bus watchdog trips."""
        if self.watchdog > 0 and self._drive is not None:
            trip_s = self._heard_at_s + self.watchdog * WATCHDOG_TICK_S
            if now_s >= trip_s:
                self.plant.advance(trip_s, self._drive)
                self._put("bus_watchdog", -1)
                self._put("goal_position", round(self.plant.position))
                self._tripped = True
                self._settings()
        self.plant.advance(now_s, self._drive)

    # --- inside -------------------------------------------------------------------------------------------------

    def _refusal(self, field: Field, data: bytes, offset: int) -> int:
        if not field.writable or (field.eeprom and self.torque):
            return dxl2.ACCESS_ERROR
        if offset < 0 or offset + field.size > len(data):
            return dxl2.DATA_LENGTH_ERROR
        value = field.from_bytes(data[offset : offset + field.size])
        if not field.low <= value <= field.high or (field.name == "bus_watchdog" and value < 0):
            return dxl2.DATA_RANGE_ERROR
        if self._tripped and field.name in _GOALS:
            return dxl2.DATA_RANGE_ERROR
        if field.name == "goal_position" and self.mode == 3 and not self._lowest <= value <= self._highest:
            return dxl2.DATA_LIMIT_ERROR
        if field.name == "torque_enable" and value and self.fault_status & self._get("shutdown"):
            return dxl2.ACCESS_ERROR
        return 0

    def _covered(self, address: int, end: int) -> tuple[Field, ...]:
        return tuple(f for f in self.table.fields.values() if f.address < end and f.address + f.size > address)

    def _goal_written(self) -> None:
        if not self.torque and self._get("drive_mode") & 0x08:  # torque on by goal update
            self._put("torque_enable", 1)
            self._settings()
        elif self._drive is not None:
            self._drive = self._drive._replace(goal=float(self._get("goal_position")))

    def _written(self, names: set[str]) -> None:
        if "operating_mode" in names:
            self._put("goal_position", round(self.plant.position))
            self._put("profile_velocity", 0)
            self._put("profile_acceleration", 0)
        if "bus_watchdog" in names:
            self._tripped = False
        if "goal_position" in names:
            self._goal_written()
        self._settings()

    def _settings(self) -> None:
        """Take over what the registers say now; called after every change but a goal."""
        get = self._get
        self.id: int = get("id")
        self.baud: int | None = self.table.baud_codes.get(get("baud_rate"))
        self.return_level: int = get("status_return_level")
        self.torque: int = get("torque_enable")
        self.mode: int = get("operating_mode")
        self.watchdog: int = get("bus_watchdog")
        self._lowest: int = get("min_position_limit")
        self._highest: int = get("max_position_limit")
        self._drive = None
        if self.torque and self.mode in _POSITION_MODES:
            table, turn = self.table, self.table.ticks_per_revolution
            speed = table["profile_velocity"].to_unit(get("profile_velocity")) * turn / 60.0
            acceleration = table["profile_acceleration"].to_unit(get("profile_acceleration")) * turn / 3600.0
            self._drive = Drive(float(get("goal_position")), table.top_speed_ticks_s, speed, acceleration)

    def _live_values(self, now_s: float) -> tuple[int, ...]:
        plant, table = self.plant, self.table
        per_tick = 60.0 / (table.ticks_per_revolution * table["present_velocity"].scale)
        moving = plant.speed != 0.0
        arrived = self._drive is None or abs(self._drive.goal - plant.position) < 8.0
        return (
            int(now_s * 1000.0) & 0x7FFF,
            int(moving),
            int(arrived) | (int(not arrived) << 1),
            round(885.0 * plant.speed / table.top_speed_ticks_s),
            round(plant.current_mA(table.top_speed_ticks_s)),
            round(plant.speed * per_tick),
            round(plant.position),
            round(plant.reference_speed * per_tick),
            round(plant.reference),
            _SUPPLY_RAW,
            _TEMPERATURE_C,
        )

    def _reset(self, keep: dict[str, int], areas: tuple[bool, ...]) -> None:
        for field in self.table.fields.values():
            if field.eeprom in areas:
                self._put(field.name, keep.get(field.name, field.initial))
        self._put("model_number", self.table.model_number)
        self._put("firmware_version", self._firmware)

    def _get(self, name: str) -> int:
        field = self.table.fields[name]
        return field.from_bytes(self._memory[field.address : field.address + field.size])

    def _put(self, name: str, value: int) -> None:
        field = self.table.fields[name]
        self._memory[field.address : field.address + field.size] = field.to_bytes(value)


def _live_struct(table: Table) -> tuple[int, struct.Struct]:
    """Address and layout of the live registers, which every X-series table holds in one block."""
    fields = [table[name] for name in _LIVE]
    address, length = table.span(_LIVE)
    codes = "<" + "".join(_STRUCT_CODES[field.size, field.signed] for field in fields)
    layout = struct.Struct(codes)
    if layout.size != length or [f.address for f in fields] != sorted(f.address for f in fields):
        raise ValueError(f"{table.model}: the present registers are not one block in the usual order")
    return address, layout
