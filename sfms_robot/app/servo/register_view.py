"""What a servo says of itself: its registers in one piece, read by role or name. Nothing is written."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sfms_robot.app.servo.serial_line import TRIES, FoundServo, Wire
from sfms_robot.app.servo.single_servo import read_block
from sfms_robot.errors import ServoError
from sfms_robot.servo.codecs.dxl2 import ALERT

_WATCHED: Final = (
    "torque_enable", "error_status", "present_position", "present_speed", "present_load", "present_current", "voltage",
    "temperature",
)  # fmt: skip
_LONGEST: Final = 128  # bytes of one read


@dataclass(frozen=True)
class State:
    """A servo and its control table as read.

    Attributes:
        table: bytes of the control table from `start` on; empty when it was not read.
        error: error byte of the last answer.
    """

    seen: FoundServo
    start: int
    table: bytes
    error: int

    def value(self, name: str) -> int | None:
        """Raw value of a role, or of a register by name; None when the model has none or it was not read."""
        known = self.seen.table
        field = (known.role(name) or known.fields.get(name)) if known is not None else None
        if field is None or field.address < self.start or field.address + field.size > self.start + len(self.table):
            return None
        return field.from_bytes(self.table[field.address - self.start :])

    def values(self) -> dict[str, int]:
        """Raw values of all registers that were read, by name."""
        fields = self.seen.table.fields if self.seen.table is not None else {}
        return {name: value for name in fields if (value := self.value(name)) is not None}

    def in_unit(self, name: str) -> float | None:
        """As `value`, in the unit of the firmware map."""
        known, raw = self.seen.table, self.value(name)
        field = (known.role(name) or known.fields.get(name)) if known is not None else None
        return None if field is None or raw is None else field.to_unit(raw)

    def faults(self) -> str:
        """What is wrong with the servo, in words; empty when nothing is."""
        table = self.seen.table
        if table is None:
            return ""
        named = table.fault_names(self.value("error_status") or 0) or table.status_fault_names(self.error)
        if not named and table.protocol == 2 and self.error & ALERT:
            return "hardware error"
        return named

    def row(self) -> dict[str, Any]:
        """What `monitor` shows."""
        return {
            "id": self.seen.id,
            "model": self.seen.model,
            "position": self.value("present_position"),
            "position_deg": _round(self.in_unit("present_position")),
            "current_mA": _round(self.in_unit("present_current")),
            "load_percent": _round(self.in_unit("present_load")),
            "voltage_V": _round(self.in_unit("voltage")),
            "temperature_degC": _round(self.in_unit("temperature")),
            "torque": None if (torque := self.value("torque_enable")) is None else bool(torque),
            "faults": self.faults(),
        }


def read_all(wire: Wire, seen: FoundServo) -> State:
    """The whole table of a known model. Raises ServoError for a servo that pings and tells nothing."""
    if seen.table is None:
        return State(seen, 0, b"", 0)
    fields = seen.table.fields.values()
    end = max(field.address + field.size for field in fields if field.address < 2 * _LONGEST)
    data = b""
    while len(data) < end:
        data += read_block(wire, seen, len(data), min(_LONGEST, end - len(data)), "its registers")
    return State(seen, 0, data, _error_byte(wire, seen))


def watch(wire: Wire, servos: Sequence[FoundServo]) -> list[dict[str, Any]]:
    """One row per servo: where it is, how it is; `silent` for one that does not answer."""
    return [_watched(wire, seen) for seen in servos]


def samples(
    wire: Wire, servos: Sequence[FoundServo], period_s: float, count: int | None = None
) -> Iterator[list[dict[str, Any]]]:
    """`watch`, every `period_s`, `count` times or for ever."""
    due_s = wire.clock.now_s()
    for _ in range(count) if count is not None else itertools.count():
        wire.clock.wait_until(due_s)
        yield watch(wire, servos)
        due_s = max(due_s + period_s, wire.clock.now_s())


def _watched(wire: Wire, seen: FoundServo) -> dict[str, Any]:
    fields = [] if seen.table is None else [f for role in _WATCHED if (f := seen.table.role(role)) is not None]
    if not fields:
        return {**State(seen, 0, b"", 0).row(), "faults": "no firmware map"}
    start = min(field.address for field in fields)
    length = max(field.address + field.size for field in fields) - start
    answer = wire.at(seen.baud).read(seen.id, start, length)
    if answer is None or wire.link.refusal(answer):
        return {**State(seen, 0, b"", 0).row(), "faults": "silent"}
    return State(seen, start, answer.data, answer.error).row()


def _error_byte(wire: Wire, seen: FoundServo) -> int:
    """Of an answer that asked for nothing special: what it says then is about the servo."""
    for _ in range(TRIES):
        answer = wire.link.read(seen.id, 0, 2)
        if answer is not None:
            return answer.error
    raise ServoError(f"id {seen.id} does not answer any more")


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 2)
