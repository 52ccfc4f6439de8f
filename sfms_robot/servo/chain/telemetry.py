"""What the servos of a bus last said of themselves, decoded many at a time, whatever their family.

The registers that change lie close together in every table, so one read of a block tells all. Servos of one bus may
be of different models as long as those registers lie at the same place; what a raw value means (mA per tick, ticks per
turn) is each model's own. Every register has its own sign rule, and the series differ in byte order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import TickConversion
from sfms_robot.servo.policy import Measured
from sfms_robot.servo.registers import Field, Table

Block = tuple[int, int]  # address, length

_NEEDED: Final = ("present_position", "goal_position", "torque_enable")
_TOLD: Final = {"velocity": "present_speed", "voltage": "voltage", "temperature": "temperature"}
_REACH: Final = 8  # bytes by which a block grows for the present current: fewer than a request for it takes
_EXTRA: Final = ("current_mA", "load_percent", "velocity_rad_s", "voltage_V", "temperature_C")


class Telemetry:
    """Last known state of every servo, by index in bus order. Times are those of the port's clock.

    Args:
        bus: its name, for messages.
        family, protocol: what the servos of this bus speak, as in a firmware map.
        tables: of each servo.
        conversion: joint angles <-> ticks.

    Attributes:
        position: (address, length) of the present position alone.
        block: that of everything that is told at once, position included.
        health: that of torque enable, up to the hardware error status where there is one.
        goal, torque, error: registers, alike for all servos; `error` None where faults come with every answer.
        currents: per servo the register of its present current where that lies outside the block.
        ticks: (J,) last position.
        seen_s: (J,) when it came, -inf before the first.
        current_mA, load_percent, velocity_rad_s, voltage_V, temperature_C: (J,) NaN where not known.

    Raises ConfigError for servos of another family, or whose registers lie at different places.
    """

    def __init__(
        self, bus: str, family: str, protocol: int, tables: Sequence[Table], conversion: TickConversion
    ) -> None:
        for table in tables:
            if (table.family, table.protocol) != (family, protocol):
                raise ConfigError(
                    f"bus {bus!r}: {table.model} does not speak {family} protocol {protocol} and cannot be on it"
                )
        present, self.goal, self.torque = (_needed(bus, tables, role) for role in _NEEDED)
        self.error = common(bus, tables, "error_status") if protocol == 2 else None
        common(bus, tables, "bus_watchdog")
        self._fields = {"position": present}
        loads = [_load(table) for table in tables]
        if loads[0] is not None and all(_alike(load, loads[0]) for load in loads):
            self._fields["load"] = loads[0]
        for key, role in _TOLD.items():
            first = tables[0].role(role)
            if first is not None and all(_alike(table.role(role), first) for table in tables):
                self._fields[key] = first
        self.position: Block = (present.address, present.size)
        self.block = _span(self._fields.values())
        self.currents = [_apart(table, self._fields.get("load")) for table in tables]
        current = self.currents[0]
        if current is not None and all(_alike(each, current) for each in self.currents):
            wider = _span([*self._fields.values(), current])
            if wider[1] - self.block[1] <= _REACH:
                self._fields["current"], self.block = current, wider
                self.currents = [None] * len(tables)
        self.health = _span([self.torque] if self.error is None else [self.torque, self.error])
        self._layouts = {where: self._layout(where) for where in (self.position, self.block)}
        in_block = "load" in self._fields
        self._mA = np.array([load.scale if load and in_block and load.unit == "mA" else math.nan for load in loads])
        percent = [load.scale if load and in_block and load.unit == "percent" else math.nan for load in loads]
        self._percent = np.array(percent)
        self._conversion = conversion
        count = len(tables)
        zero = conversion.to_rad(np.zeros(count, np.int64))
        rad_per_tick = conversion.to_rad(np.ones(count, np.int64)) - zero
        self._rad_s = rad_per_tick * np.array([_ticks_s(table) for table in tables])
        self.ticks: NDArray[np.int64] = np.zeros(count, np.int64)
        self.seen_s = np.full(count, -np.inf)
        self.current_mA, self.load_percent = np.full(count, np.nan), np.full(count, np.nan)
        self.velocity_rad_s = np.full(count, np.nan)
        self.voltage_V, self.temperature_C = np.full(count, np.nan), np.full(count, np.nan)

    def forget(self) -> None:
        """Nothing was told yet: another connection."""
        self.seen_s[:] = -np.inf
        for values in (self.current_mA, self.load_percent, self.velocity_rad_s, self.voltage_V, self.temperature_C):
            values[:] = np.nan

    def capabilities(self, index: int) -> frozenset[str]:
        told = {"position", "torque"} | (set(self._fields) & {*_TOLD, "current"})
        current = math.isfinite(self._mA[index]) or self.currents[index] is not None
        return frozenset(told | ({"current"} if current else set()))

    def take(self, where: Block, indices: Sequence[int], data: Sequence[bytes], now_s: float) -> None:
        """Decode answers to a read of `where`, `position` or `block`; `data` hold its whole length."""
        rows = np.frombuffer(b"".join(data), self._layouts[where])
        at = np.asarray(indices, np.intp)
        values = {key: _signed(self._fields[key], rows[key]) for key in rows.dtype.names or ()}
        self.ticks[at] = values["position"]
        self.seen_s[at] = now_s
        if "velocity" in values:
            self.velocity_rad_s[at] = values["velocity"] * self._rad_s[at]
        if "load" in values:
            if "current" not in values and self.currents.count(None) == len(self.currents):
                self.current_mA[at] = values["load"] * self._mA[at]
            self.load_percent[at] = values["load"] * self._percent[at]
        if "current" in values:
            self.current_mA[at] = values["current"] * self._fields["current"].scale
        if "voltage" in values:
            self.voltage_V[at] = values["voltage"] * self._fields["voltage"].scale
        if "temperature" in values:
            self.temperature_C[at] = values["temperature"] * self._fields["temperature"].scale

    def take_current(self, index: int, field: Field, data: bytes) -> None:
        """An answer to a read of `currents[index]`."""
        self.current_mA[index] = field.to_unit(field.from_bytes(data))

    def health_of(self, data: bytes) -> tuple[bool, int]:
        """An answer to a read of `health`: whether torque is on, and the latched hardware errors (bits, or 0)."""
        start = self.health[0]
        bits = self.error.from_bytes(data[self.error.address - start :]) if self.error is not None else 0
        return bool(self.torque.from_bytes(data[self.torque.address - start :])), bits

    def measured(self, index: int) -> Measured:
        voltage, temperature = float(self.voltage_V[index]), float(self.temperature_C[index])
        return Measured(
            voltage if math.isfinite(voltage) else None, temperature if math.isfinite(temperature) else None
        )

    def supply_mA(self) -> float:
        """Sum of the motor currents that are known: an upper bound of what the servos take from the supply."""
        currents: list[float] = self.current_mA.tolist()
        return sum(abs(current) for current in currents if current == current)

    def readings(
        self, joints: Sequence[str], faults: Sequence[str | None], rejoined: set[int], now_s: float
    ) -> Mapping[str, Reading]:
        angles = self._conversion.to_rad(self.ticks).tolist()
        ages = (now_s - self.seen_s).tolist()
        columns: tuple[Doubles, ...] = (
            self.current_mA, self.load_percent, self.velocity_rad_s, self.voltage_V, self.temperature_C,
        )  # fmt: skip
        extras = zip(*(column.tolist() for column in columns), strict=True)
        out: dict[str, Reading] = {}
        for index, (joint, extra) in enumerate(zip(joints, extras, strict=True)):
            if ages[index] == math.inf:
                out[joint] = Reading(None, math.inf, faults[index])
                continue
            told = {key: value for key, value in zip(_EXTRA, extra, strict=True) if value == value}
            out[joint] = Reading(angles[index], ages[index], faults[index], told, index in rejoined)
        return out

    def _layout(self, where: Block) -> np.dtype[np.void]:
        address, length = where
        inside = {
            key: field
            for key, field in self._fields.items()
            if address <= field.address and field.address + field.size <= address + length
        }
        return np.dtype(
            {
                "names": list(inside),
                "formats": [_format(field) for field in inside.values()],
                "offsets": [field.address - address for field in inside.values()],
                "itemsize": length,
            }
        )


def common(bus: str, tables: Sequence[Table], role: str) -> Field | None:
    """The register of a role: one request has one address, so all servos of a bus have it at one place, in one form,
    or none has it. Raises ConfigError."""
    first = tables[0].role(role)
    for table in tables[1:]:
        if not _alike(table.role(role), first):
            raise ConfigError(
                f"bus {bus!r}: {table.model} and {tables[0].model} have {role} at different places or in different "
                "forms and cannot share a bus"
            )
    return first


def _needed(bus: str, tables: Sequence[Table], role: str) -> Field:
    field = common(bus, tables, role)
    if field is None:
        raise ConfigError(f"bus {bus!r}: {tables[0].model} has no register for {role}, which every tick needs")
    return field


def _alike(field: Field | None, other: Field | None) -> bool:
    """At the same place, in the same form."""
    return (field and (field[1:4], field.sign, field.byte_order)) == (
        other and (other[1:4], other.sign, other.byte_order)
    )


def _load(table: Table) -> Field | None:
    """Dynamixel 2.0 has current or load at one place of the block; the others have load, and perhaps a current."""
    return (table.role("present_current") if table.protocol == 2 else None) or table.role("present_load")


def _apart(table: Table, load: Field | None) -> Field | None:
    current = table.role("present_current")
    apart = current is not None and current.unit == "mA" and table.protocol != 2
    return current if apart and current != load else None


def _span(fields: Iterable[Field]) -> Block:
    each = list(fields)
    first = min(field.address for field in each)
    return first, max(field.address + field.size for field in each) - first


def _format(field: Field) -> str:
    order = ">" if field.byte_order == "big" else "<"
    return f"{order}{'i' if field.sign == 'twos_complement' else 'u'}{field.size}"


def _signed(field: Field, raw: NDArray[Any]) -> NDArray[Any]:
    """Values of raw registers, as `Field.from_bytes` does for one."""
    if field.sign == "offset_2048":
        return np.asarray(raw.astype(np.int64) - 2048)
    if field.sign.startswith("sign_bit_"):
        wide, bit = raw.astype(np.int64), 1 << int(field.sign[9:])
        magnitude = wide & (bit - 1)
        return np.where(wide & bit, -magnitude, magnitude)
    return raw


def _ticks_s(table: Table) -> float:
    """Ticks per second of one raw unit of speed: told in rpm or in degrees per second."""
    field = table.role("present_speed")
    if field is None:
        return math.nan
    return field.scale * table.ticks_per_revolution / (60.0 if field.unit == "rpm" else 360.0)
