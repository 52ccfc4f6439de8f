"""What the servos of a bus last said of themselves, decoded many at a time.

The registers that change lie close together in every table, so one read of a block tells all. Servos of one bus may
be of different models as long as those registers lie at the same place; what the register at "load" means (current,
or a share of full torque) is each model's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Reading
from sfms_robot.ports import TickConversion
from sfms_robot.servo.codecs.dxl2 import Packet
from sfms_robot.servo.policy import Measured
from sfms_robot.servo.registers import Field, Table

Block = tuple[int, int]  # address, length

_RPM: Final = "rpm"
_PLAIN: Final = ("no", "twos_complement")
_EXTRA: Final = ("current_mA", "velocity_rad_s", "voltage_V", "temperature_C")
_ONE_PLACE: Final = ("goal_position", "present_position", "torque_enable", "error_status", "bus_watchdog")


def common(bus: str, tables: Sequence[Table], role: str) -> Field | None:
    """The register of a role, which has to lie at one place in all tables of a bus. Raises ConfigError."""
    first = tables[0].role(role)
    for table in tables[1:]:
        other = table.role(role)
        if (first and first[1:4]) != (other and other[1:4]):  # address, size, sign
            raise ConfigError(
                f"bus {bus!r}: {table.model} and {tables[0].model} have {role} at different places "
                "and cannot share a bus"
            )
    return first


class Telemetry:
    """Last known state of every servo, by index in bus order.

    Attributes:
        position: block of the present position alone.
        block: block that holds everything that is told, position included.
        health: block from torque enable to error status.
        seen_s: (J,) when a position came last, -inf before the first.
        ticks: (J,) last position.
        current_mA: (J,) NaN where it is not known.
    """

    def __init__(self, bus: str, tables: Sequence[Table], conversion: TickConversion) -> None:
        for role in _ONE_PLACE:
            common(bus, tables, role)
        present = _required(common(bus, tables, "present_position"), bus, "present_position")
        self._fields = {"position": present}
        load = _load(tables[0])
        if load is not None and all(_like(_load(table), load) for table in tables):
            self._fields["load"] = load
        for key, role in (("velocity", "present_speed"), ("voltage", "voltage"), ("temperature", "temperature")):
            field = _shared(tables, role)
            if field is not None:
                self._fields[key] = field
        self.position: Block = (present.address, present.size)
        self.block = _span(self._fields.values())
        torque = _required(common(bus, tables, "torque_enable"), bus, "torque_enable")
        error = common(bus, tables, "error_status")
        self.torque, self.error = torque, error
        self.health = _span([torque, error] if error is not None else [torque])
        self._layouts = {where: self._layout(where) for where in (self.position, self.block)}
        self._tables = list(tables)
        count = len(tables)
        self._conversion = conversion
        zero = conversion.to_rad(np.zeros(count, np.int64))
        self._rad_per_tick = conversion.to_rad(np.ones(count, np.int64)) - zero
        self._rad_s = self._rad_per_tick * np.array([_ticks_s(table) for table in tables])
        self._mA = np.array([_mA(table) for table in tables])
        self.ticks = np.zeros(count, np.int64)
        self.seen_s = np.full(count, -np.inf)
        self.velocity_rad_s = np.full(count, np.nan)
        self.current_mA = np.full(count, np.nan)
        self.voltage_V = np.full(count, np.nan)
        self.temperature_C = np.full(count, np.nan)

    def capabilities(self, index: int) -> frozenset[str]:
        told = {"position", "torque"} | (set(self._fields) & {"velocity", "voltage", "temperature"})
        return frozenset(told | ({"current"} if math.isfinite(self._mA[index]) and "load" in self._fields else set()))

    def take(self, where: Block, indices: Sequence[int], packets: Sequence[Packet], now_s: float) -> None:
        """Decode answers to a read of `where`; `packets` hold its whole length."""
        rows = np.frombuffer(b"".join(packet.params for packet in packets), self._layouts[where])
        at = np.asarray(indices, np.intp)
        self.ticks[at] = rows["position"]
        self.seen_s[at] = now_s
        if where != self.block:
            return
        names = rows.dtype.names or ()
        if "velocity" in names:
            self.velocity_rad_s[at] = rows["velocity"] * self._rad_s[at]
        if "load" in names:
            self.current_mA[at] = rows["load"] * self._mA[at]
        if "voltage" in names:
            self.voltage_V[at] = rows["voltage"] * self._fields["voltage"].scale
        if "temperature" in names:
            self.temperature_C[at] = rows["temperature"] * self._fields["temperature"].scale

    def measured(self, index: int) -> Measured:
        voltage, temperature = float(self.voltage_V[index]), float(self.temperature_C[index])
        return Measured(
            voltage if math.isfinite(voltage) else None, temperature if math.isfinite(temperature) else None
        )

    def supply_mA(self) -> float:
        """Sum of the winding currents: an upper bound of what the servos take from the supply."""
        return float(np.nansum(np.abs(self.current_mA)))

    def readings(
        self, joints: Sequence[str], faults: Sequence[str | None], rejoined: set[int], now_s: float
    ) -> Mapping[str, Reading]:
        angles = self._conversion.to_rad(self.ticks).tolist()
        ages = (now_s - self.seen_s).tolist()
        extras = zip(
            self.current_mA.tolist(),
            self.velocity_rad_s.tolist(),
            self.voltage_V.tolist(),
            self.temperature_C.tolist(),
            strict=True,
        )
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
                "formats": [f"<{'i' if field.signed else 'u'}{field.size}" for field in inside.values()],
                "offsets": [field.address - address for field in inside.values()],
                "itemsize": length,
            }
        )


def _required(field: Field | None, bus: str, role: str) -> Field:
    if field is None:
        raise ConfigError(f"bus {bus!r}: its servos have no register for {role}")
    return field


def _load(table: Table) -> Field | None:
    return table.role("present_current") or table.role("present_load")


def _shared(tables: Sequence[Table], role: str) -> Field | None:
    """The register of a role where all tables have it at one place and as plain two's complement or unsigned."""
    first = tables[0].role(role)
    return first if first is not None and all(_like(table.role(role), first) for table in tables) else None


def _like(field: Field | None, other: Field) -> bool:
    """At the same place, in a form that can be decoded many at a time."""
    return field is not None and field[1:4] == other[1:4] and field.sign == other.sign and field.sign in _PLAIN


def _span(fields: Iterable[Field]) -> Block:
    each = list(fields)
    first = min(field.address for field in each)
    return first, max(field.address + field.size for field in each) - first


def _ticks_s(table: Table) -> float:
    """Ticks per second of one raw unit of speed; NaN where the unit is another."""
    field = table.role("present_speed")
    if field is None or field.unit != _RPM:
        return math.nan
    return field.scale * table.ticks_per_revolution / 60.0


def _mA(table: Table) -> float:
    field = table.role("present_current")
    return field.scale if field is not None and field.unit == "mA" else math.nan
