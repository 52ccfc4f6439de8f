"""What the servos of a bus of the FF FF family last said of themselves.

Position, speed, load, voltage and temperature lie in one block, read at once; the current, where there is one, lies
elsewhere and is read now and then. Every register has its own sign rule, and the series differ in byte order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Reading
from sfms_robot.ports import TickConversion
from sfms_robot.servo.policy import Measured
from sfms_robot.servo.registers import Field, Table

POLLED: Final = ("present_position", "present_speed", "present_load", "voltage", "temperature")
_ONE_PLACE: Final = (*POLLED, "goal_position", "torque_enable", "status_level")
_PLAIN: Final = {"present_load": "load_percent", "voltage": "voltage_V", "temperature": "temperature_C"}


class Frame1Telemetry:
    """Last known state of every servo, by index in bus order.

    Attributes:
        fields: registers of every tick by role, alike for all servos of the bus.
        block: (address, length) of what is read in every poll.
        currents: of each servo the register of its present current; None where it has none that tells milliamperes.
        position: the same block: the position comes with the rest.
        torque: the register of torque enable.
        ticks: (J,) last position.
        seen_s: (J,) when it came, -inf before the first.
        current_mA: (J,) NaN where it is not known.

    Raises ConfigError for servos of another family, or whose registers lie at different places.
    """

    def __init__(self, bus: str, family: str, tables: Sequence[Table], conversion: TickConversion) -> None:
        self.fields = common_fields(bus, family, tables)
        polled = [self.fields[role] for role in POLLED]
        first = min(each.address for each in polled)
        self.block = first, max(each.address + each.size for each in polled) - first
        self.position = self.block
        self.torque = self.fields["torque_enable"]
        currents = [table.role("present_current") for table in tables]
        self.currents = [each if each is not None and each.unit == "mA" else None for each in currents]
        self._at = {role: self.fields[role].address - first for role in POLLED}
        self._turns = [table.ticks_per_revolution for table in tables]
        self._conversion = conversion
        self._rad_per_tick = conversion.to_rad(np.ones(len(tables), np.int64)) - conversion.to_rad(
            np.zeros(len(tables), np.int64)
        )
        self.ticks = np.zeros(len(tables), np.int64)
        self.seen_s = np.full(len(tables), -np.inf)
        self.current_mA = np.full(len(tables), np.nan)
        self._extra: list[dict[str, float]] = [{} for _ in tables]

    def capabilities(self, index: int) -> frozenset[str]:
        known = {"position", "velocity", "voltage", "temperature", "torque"}
        return frozenset(known | ({"current"} if self.currents[index] is not None else set()))

    def take(self, index: int, data: bytes, now_s: float) -> None:
        """The block, whole."""
        fields, extra = self.fields, self._extra[index]
        value = {role: fields[role].from_bytes(data[at : at + fields[role].size]) for role, at in self._at.items()}
        self.ticks[index] = value["present_position"]
        self.seen_s[index] = now_s
        speed = fields["present_speed"]
        per_turn = 60.0 if speed.unit == "rpm" else 360.0
        ticks_s = speed.to_unit(value["present_speed"]) * self._turns[index] / per_turn
        extra["velocity_rad_s"] = ticks_s * float(self._rad_per_tick[index])
        for role, key in _PLAIN.items():
            extra[key] = fields[role].to_unit(value[role])

    def take_current(self, index: int, field: Field, data: bytes) -> None:
        self.current_mA[index] = self._extra[index]["current_mA"] = field.to_unit(field.from_bytes(data))

    def measured(self, index: int) -> Measured:
        return Measured(self._extra[index].get("voltage_V"), self._extra[index].get("temperature_C"))

    def supply_mA(self) -> float:
        """Sum of the motor currents that are known."""
        return float(np.nansum(np.abs(self.current_mA)))

    def readings(
        self, joints: Sequence[str], faults: Sequence[str | None], rejoined: set[int], now_s: float
    ) -> Mapping[str, Reading]:
        angles = self._conversion.to_rad(self.ticks).tolist()
        out: dict[str, Reading] = {}
        for index, (joint, fault) in enumerate(zip(joints, faults, strict=True)):
            age_s = now_s - float(self.seen_s[index])
            if age_s == math.inf:
                out[joint] = Reading(None, math.inf, fault)
            else:
                out[joint] = Reading(angles[index], age_s, fault, dict(self._extra[index]), index in rejoined)
        return out


def common_fields(bus: str, family: str, tables: Sequence[Table]) -> dict[str, Field]:
    """Registers of every tick by role: one request has one address, so servos of a bus agree where they lie."""
    fields: dict[str, Field] = {}
    for table in tables:
        if table.family != family or table.protocol != 1:
            raise ConfigError(f"bus {bus!r}: {table.model} does not speak {family} protocol 1 and cannot be on it")
        for role in _ONE_PLACE:
            here = table.role(role)
            if here is None:
                raise ConfigError(f"bus {bus!r}: {table.model} has no register for {role}, which every tick needs")
            if role in fields and _form(here) != _form(fields[role]):
                raise ConfigError(
                    f"bus {bus!r}: {table.model} and {tables[0].model} have {role} at different places "
                    "or in different forms and cannot share a bus"
                )
            fields.setdefault(role, here)
    return fields


def _form(here: Field) -> tuple[object, ...]:
    return here.address, here.size, here.sign, here.byte_order, here.scale, here.unit
