"""The last reports of the servos of a bus, decoded many at a time, for every family.

The registers that change are close together in every table, so one read of a block gets all of them. Servos of one bus
may be of different models if those registers have the same addresses; the meaning of a raw value (mA per tick, ticks
per turn) depends on the model. Every register has its own sign rule, and the series differ in byte order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles, Ints, Reading, Readings
from sfms_robot.ports import TickConversion
from sfms_robot.servo.policy import tells_current
from sfms_robot.servo.registers import Field, Table, span_of

Block = tuple[int, int]  # address, length

_NEEDED: Final = ("present_position", "goal_position", "torque_enable")
_REACH: Final = 8  # bytes by which a block may grow for the present current: fewer than a separate request takes
_EXTRA: Final = ("current_mA", "load_percent", "velocity_rad_s", "voltage_V", "temperature_C")
_CURRENT, _PERCENT, _VELOCITY, _VOLTAGE, _TEMPERATURE = range(5)  # rows of `Telemetry.extra`
_CAPABILITIES: Final = {_CURRENT: "current", _VELOCITY: "velocity", _VOLTAGE: "voltage", _TEMPERATURE: "temperature"}


class Telemetry:
    """Last known state of every servo, by index in bus order. Times are those of the port's clock.

    Args:
        bus: its name, for messages.
        family, protocol: those of the servos of this bus, as in a firmware map.
        tables: control table of each servo.
        conversion: joint angles <-> ticks.

    Attributes:
        position: (address, length) of the present position alone.
        block: (address, length) of all registers read together, position included.
        health: (address, length) of torque enable, up to the hardware error status if there is one.
        goal, torque, error: registers, the same for all servos; `error` is None if faults come with every answer.
        currents: register of the present current of each servo, if it is outside the block; else None.
        ticks: (J,) last position.
        seen_s: (J,) time of that position, -inf before the first.
        extra: (5, J) `current_mA`, `load_percent`, `velocity_rad_s`, `voltage_V`, `temperature_C`; NaN if not known.

    Raises ConfigError for servos of another family, or with other addresses of these registers.
    """

    def __init__(
        self, bus: str, family: str, protocol: int, tables: Sequence[Table], conversion: TickConversion
    ) -> None:
        for table in tables:
            if (table.family, table.protocol) != (family, protocol):
                raise ConfigError(
                    f"bus {bus!r}: {table.model} does not speak {family} protocol {protocol} and cannot be on it"
                )
        needed = []
        for role in _NEEDED:
            if (field := common(bus, tables, role)) is None:
                raise ConfigError(f"bus {bus!r}: {tables[0].model} has no register for {role}, which every tick needs")
            needed.append(field)
        present, self.goal, self.torque = needed
        self.error = common(bus, tables, "error_status") if protocol == 2 else None
        common(bus, tables, "bus_watchdog")
        # Angles are affine in ticks, so two conversions give the angle of one tick.
        zero, one = (conversion.to_rad(np.full(len(tables), ticks, np.int64)) for ticks in (0, 1))
        # Protocol 2.0 has current or load at one address; the others have load, and some also a current in mA.
        loads = [(protocol == 2 and table.role("present_current")) or table.role("present_load") for table in tables]
        apart = [table.role("present_current") if protocol == 1 and tells_current(table) else None for table in tables]
        currents = loads if protocol == 2 else apart
        speeds, voltages, temperatures = (
            [table.role(role) for table in tables] for role in ("present_speed", "voltage", "temperature")
        )
        ticks_s = [table.in_ticks(field) if field else math.nan for table, field in zip(tables, speeds, strict=True)]
        sources = {  # row of `extra` -> register of each servo, and the factor of its raw value
            _CURRENT: (currents, _scales(currents, "mA")),
            _PERCENT: (loads, _scales(loads, "percent")),
            _VELOCITY: (speeds, (one - zero) * np.array(ticks_s)),
            _VOLTAGE: (voltages, _scales(voltages)),
            _TEMPERATURE: (temperatures, _scales(temperatures)),
        }
        shared = {  # registers that all servos have with the same address and form
            row: first
            for row, ((first, *others), _) in sources.items()
            if first and all(_alike(field, first) for field in others)
        }
        self._present = present, raw_type(present)
        self.position: Block = (present.address, present.size)
        self.block = span_of([present, *shared.values()])
        near = span_of([present, *(field for row, field in shared.items() if row != _CURRENT)])
        self.currents: list[Field | None] = [None] * len(tables)
        if _CURRENT not in shared or self.block[1] - near[1] > _REACH:
            shared.pop(_CURRENT, None)
            self.block, self.currents = near, apart  # read servo by servo
        columns = [(field, raw_type(field), row, sources[row][1]) for row, field in shared.items()]
        self._columns = [column for column in columns if np.isfinite(column[3]).any()]
        self.health = span_of([self.torque] if self.error is None else [self.torque, self.error])
        self._conversion = conversion
        self.ticks: Ints = np.zeros(len(tables), np.int64)
        self.seen_s = np.full(len(tables), -np.inf)
        self.extra = np.full((len(_EXTRA), len(tables)), np.nan)

    def forget(self) -> None:
        """Forget all reports, before another connection."""
        self.seen_s[:] = -np.inf
        self.extra[:] = np.nan

    def capabilities(self, index: int) -> frozenset[str]:
        """Return the capabilities of a servo; see `ports.Bus`."""
        known = {
            name
            for _, _, row, scales in self._columns
            if (name := _CAPABILITIES.get(row)) is not None and math.isfinite(scales[index])
        }
        return frozenset({"position", "torque", *known} | ({"current"} if self.currents[index] is not None else set()))

    def take(self, where: Block, indices: Sequence[int], data: Sequence[bytes], now_s: float) -> None:
        """Decode answers to a read of `where`, `position` or `block`; each of `data` has its whole length."""
        rows = b"".join(data)
        at = np.asarray(indices, np.intp)
        self.ticks[at] = _values(*self._present, rows, where)
        self.seen_s[at] = now_s
        if where == self.block:  # a read of the position alone has nothing else
            for field, raw_type, row, scales in self._columns:
                self.extra[row][at] = _values(field, raw_type, rows, where) * scales[at]

    def take_current(self, index: int, field: Field, data: bytes) -> None:
        """Decode an answer to a read of `currents[index]`."""
        self.extra[_CURRENT, index] = field.to_unit(field.from_bytes(data))

    def health_of(self, data: bytes) -> tuple[bool, int]:
        """Return (whether torque is on, latched hardware errors as bits) from an answer to a read of `health`."""
        start = self.health[0]
        bits = self.error.from_bytes(data[self.error.address - start :]) if self.error is not None else 0
        return bool(self.torque.from_bytes(data[self.torque.address - start :])), bits

    def measured(self, index: int) -> dict[str, float]:
        """Return the known values that are compared with thresholds of faults, by fault: see `policy.counts`."""
        values = {"input voltage": self.extra[_VOLTAGE, index], "overheating": self.extra[_TEMPERATURE, index]}
        return {fault: float(value) for fault, value in values.items() if math.isfinite(value)}

    def currents_mA(self) -> list[float]:
        """Return the last present current of every servo, NaN if not known."""
        currents: list[float] = self.extra[_CURRENT].tolist()
        return currents

    def supply_mA(self) -> float:
        """Return the sum of the known motor currents: an upper bound of the current from the supply."""
        return sum(abs(current) for current in self.currents_mA() if current == current)

    def readings(
        self, joints: Sequence[str], faults: Sequence[str | None], rejoined: set[int], now_s: float
    ) -> Readings:
        """Return the readings of all joints; `rejoined`: indices of servos that came back in this poll."""
        angles = self._conversion.to_rad(self.ticks).tolist()
        ages = (now_s - self.seen_s).tolist()
        extras = self.extra.T.tolist()
        out: dict[str, Reading] = {}
        for index, joint in enumerate(joints):
            if ages[index] == math.inf:
                out[joint] = Reading(None, math.inf, faults[index])
                continue
            known = {key: value for key, value in zip(_EXTRA, extras[index], strict=True) if value == value}
            out[joint] = Reading(angles[index], ages[index], faults[index], known, index in rejoined)
        return out


def common(bus: str, tables: Sequence[Table], role: str) -> Field | None:
    """Return the register of a role, the same for all servos of a bus, since one request has one address.

    The result is None if no servo has it. Raises ConfigError if addresses or forms differ.
    """
    first = tables[0].role(role)
    for table in tables[1:]:
        if not _alike(table.role(role), first):
            raise ConfigError(
                f"bus {bus!r}: {table.model} and {tables[0].model} have {role} at different places or in different "
                "forms and cannot share a bus"
            )
    return first


def _alike(field: Field | None, other: Field | None) -> bool:
    """Return whether two registers have the same address and form."""
    first, second = (each and (each.address, each.size, each.signed, each.byte_order) for each in (field, other))
    return first == second


def _scales(fields: Sequence[Field | None], unit: str | None = None) -> Doubles:
    """Return the scale of each register; NaN for a register that is missing or has another unit."""
    return np.array([field.scale if field and unit in (None, field.unit) else math.nan for field in fields])


def raw_type(field: Field) -> np.dtype[Any]:
    """Return the array type of the raw values of a register."""
    kind = ("<", ">")[field.byte_order == "big"] + ("u", "i")[field.signed == "twos_complement"]
    return np.dtype(f"{kind}{field.size}")


def _values(field: Field, raw_type: np.dtype[Any], rows: bytes, where: Block) -> NDArray[Any]:
    """Return the values of a register in rows that were each read from `where`, as `Field.from_bytes` does for one."""
    start, length = where
    raw: NDArray[Any] = np.ndarray(len(rows) // length, raw_type, rows, field.address - start, strides=(length,))
    if field.signed == "offset_2048":  # 2048 stands for 0 (MX current)
        return np.asarray(raw.astype(np.int64) - 2048)
    if bit := field.sign_bit:  # AX speed and load, Feetech
        wide = raw.astype(np.int64)
        magnitude = wide & (bit - 1)
        return np.where(wide & bit, -magnitude, magnitude)
    return raw
