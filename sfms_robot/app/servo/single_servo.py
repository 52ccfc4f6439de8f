"""The tools of `sfms-robot servo` for single servos: find, read, write, set id and rate, reset.

EEPROM is written in safe steps: the user confirms first (`confirm`), torque is off, the lock register is opened if
there is one, and afterwards the value is read back.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import yaml

from sfms_robot.app.output_paths import checked_file
from sfms_robot.app.progress import Progress, no_progress, tracked
from sfms_robot.app.servo.serial_line import Confirm, FoundServo, Row, Wire, ask, other_wires, protocol_hint
from sfms_robot.config.base import Model
from sfms_robot.emulator.faults import parse_ids
from sfms_robot.errors import ConfigError, ServoError
from sfms_robot.servo.codecs.dxl2 import ALERT
from sfms_robot.servo.registers import Field, span_of

BACK_S: Final = 2.0  # longest restart of a servo
_STEP_S: Final = 0.1
_RESETS: Final = {"all": 0xFF, "keep-id": 1, "keep-id-and-baud": 2}
_LONGEST: Final = 128  # bytes of one read
_WATCHED: Final = (
    "torque_enable",
    "error_status",
    "present_position",
    "present_speed",
    "present_load",
    "present_current",
    "voltage",
    "temperature",
)


# --- finding ----------------------------------------------------------------------------------------------------


def scan(wire: Wire, ids: Sequence[int] | None = None, progress: Progress = no_progress) -> list[FoundServo]:
    """Return all servos that answer at any of the wire's rates, by rate and id.

    `ids` are pinged one by one. None pings all at once if the family supports it, else every possible id.
    """
    for servo in ids or ():
        wire.check_id(servo)
    one_by_one = range(wire.kind.max_id + 1) if ids is None else ids
    asked = [None] if ids is None and wire.kind.broadcast else [[servo] for servo in one_by_one]
    found: list[FoundServo] = []
    total = len(wire.bauds) * len(asked)
    for baud in wire.reachable():
        for step, some in enumerate(asked):
            progress(wire.bauds.index(baud) * len(asked) + step, total, f"{baud} baud, {len(found)} found")
            found += [replace(seen, twice=wire.has_duplicate(seen.id)) for seen in wire.answering(some)]
    progress(total, total, f"{len(found)} found")
    return found


def scan_all(wire: Wire, ids: Sequence[int] | None, progress: Progress = no_progress) -> tuple[list[FoundServo], str]:
    """Return the servos of `scan` and those of other families on the same wire, and the `--family` of these.

    Families of protocol 1 share their frames: a servo is listed under the family that has a map of its model.
    """
    others = list(other_wires(wire))
    found: list[FoundServo] = []
    for each in (wire, *others):
        wire.at(each.baud)  # all wires share one port
        found += scan(each, ids, progress)
    known = {(seen.id, seen.baud) for seen in found if seen.table is not None}
    listed = [seen for seen in found if seen.table is not None or (seen.id, seen.baud) not in known]
    return listed, protocol_hint(others)


def checked_ids(text: str) -> list[int]:
    """Read `1,5,10-18`; return the ids in order. Raises ConfigError."""
    try:
        return parse_ids(text)
    except ValueError:
        raise ConfigError.at("servo tools", "ids", text, "is not a list of ids", ["5", "1-9", "1,5,10-18"]) from None


# --- looking ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ServoState:
    """A servo and its registers as read.

    Attributes:
        values: Raw values by name of all registers that were read.
        error: Error byte of the answer.
    """

    seen: FoundServo
    values: dict[str, int]
    error: int = 0

    @classmethod
    def of(cls, seen: FoundServo, start: int, data: bytes, error: int) -> ServoState:
        """Return the state of a servo whose table holds `data` from address `start` on."""
        fields = seen.registers().fields.values()
        inside = [each for each in fields if start <= each.address and each.address + each.size <= start + len(data)]
        return cls(seen, {each.name: each.from_bytes(data[each.address - start :]) for each in inside}, error)

    def _field(self, name: str) -> Field | None:
        table = self.seen.table
        return None if table is None else table.role(name) or table.fields.get(name)

    def value(self, name: str) -> int | None:
        """Return the raw value of a role, or of a register by name; None when it was not read."""
        field = self._field(name)
        return None if field is None else self.values.get(field.name)

    def in_unit(self, name: str) -> float | None:
        """Return the value of a role or register in the unit of the firmware map; None when it was not read."""
        field, raw = self._field(name), self.value(name)
        return None if field is None or raw is None else field.to_unit(raw)

    def faults(self) -> str:
        """Return the faults of the servo in words; empty when there are none."""
        table = self.seen.table
        if table is None:
            return ""
        named = table.faults_in(self.error if table.protocol == 1 else self.value("error_status") or 0)
        return ", ".join(named) or ("hardware error" if table.protocol == 2 and self.error & ALERT else "")

    def torque(self) -> bool | None:
        """Return whether torque is on; None when it was not read."""
        value = self.value("torque_enable")
        return None if value is None else bool(value)

    def measured(self, digits: int, **roles: str) -> dict[str, float | None]:
        """Return values in their units, each under the name of its argument; None for values that were not read."""
        return {key: None if (x := self.in_unit(role)) is None else round(x, digits) for key, role in roles.items()}

    def health(self) -> Row:
        return {"torque": self.torque(), "faults": self.faults()}

    def row(self) -> Row:
        """Return the row of `servo monitor`."""
        measured = self.measured(
            2,
            position_deg="present_position",
            current_mA="present_current",
            load_percent="present_load",
            voltage_V="voltage",
            temperature_degC="temperature",
        )
        return {
            "id": self.seen.id,
            "model": self.seen.model,
            "position": self.value("present_position"),
            **measured,
            **self.health(),
        }


def read_all(seen: FoundServo) -> ServoState:
    """Read the whole table of a known model. Raises ServoError for a servo that only answers pings."""
    if seen.table is None:
        return ServoState(seen, {})
    ends = [field.address + field.size for field in seen.table.fields.values() if field.address < 2 * _LONGEST]
    data, error = b"", 0
    while len(data) < max(ends):
        answer = seen.block(len(data), min(_LONGEST, max(ends) - len(data)), "its registers")
        data, error = data + answer.data, answer.error
    return ServoState.of(seen, 0, data, error)


def samples(servos: Sequence[FoundServo], period_s: float, count: int | None = None) -> Iterator[list[Row]]:
    """Yield a row per servo (`watched`) every `period_s`, `count` times or without end."""
    clock = servos[0].wire.port
    due_s = clock.now_s()
    for _ in range(count) if count is not None else itertools.count():
        clock.wait_until(due_s)
        yield [watched(seen) for seen in servos]
        due_s = max(due_s + period_s, clock.now_s())


def watched(seen: FoundServo) -> Row:
    """Return the row of `servo monitor`: position and health; `silent` for a servo that does not answer."""
    fields = [field for role in _WATCHED if seen.table and (field := seen.table.role(role)) is not None]
    if not fields:
        return ServoState(seen, {}).row() | {"faults": "no firmware map"}
    start, length = span_of(fields)
    answer = seen.wire.at(seen.baud).read(seen.id, start, length)
    if answer is None or seen.wire.link.refusal(answer):
        return ServoState(seen, {}).row() | {"faults": "silent"}
    return ServoState.of(seen, start, answer.data, answer.error).row()


# --- registers --------------------------------------------------------------------------------------------------


def register_row(field: Field, raw: int) -> Row:
    """Return the row of `servo read`."""
    return {
        "register": field.name,
        "raw": raw,
        "value": round(field.to_unit(raw), 6),
        "unit": field.unit,
        "address": field.address,
        "size": field.size,
        "access": field.access,
        "area": field.area,
        "min": field.low if field.writable else None,
        "max": field.high if field.writable else None,
    }


def read_registers(seen: FoundServo, names: Sequence[str]) -> list[Row]:
    """Read registers by name, or `all` of them, into rows. Raises ServoError where one cannot be read."""
    fields = [seen.named(name) for name in names if name != "all"]
    if "all" in names:
        fields = sorted(seen.registers().fields.values(), key=lambda each: each.address)
    return [register_row(field, seen.read(field)) for field in fields]


def write_register(seen: FoundServo, name: str, text: str, confirm: Confirm) -> Row:
    """Write one register; return the row of `servo write`.

    `text`: a raw number, or a number with the register's unit, such as 90deg. The status return level is written
    without reading it first: a servo at level 0 answers no read.

    Raises ConfigError for a value that the register does not accept, ServoError when the servo refuses.
    """
    table, field = seen.registers(), seen.named(name)
    if field in (table.role("id"), table.role("baud_rate")):
        raise ConfigError(f"{field.name} is not written like this: sfms-robot servo set-id, sfms-robot servo set-baud")
    if not field.writable:
        writable = [each.name for each in table.fields.values() if each.writable]
        raise ConfigError.at(table.model, "register", name, "is read-only", writable)
    raw = parse_value(table.model, field, text)
    mute = field == table.role("status_level")
    before = None if mute else seen.read(field)
    if field.eeprom:
        seen.guard(f"{field.name} := {raw}" if mute else f"{field.name} {before} -> {raw}", confirm, mute)
    seen.put(field, raw)
    row = register_row(field, raw)
    return {"register": field.name, "before": before, **{key: row[key] for key in ("raw", "value", "unit")}}


def parse_value(model: str, field: Field, text: str) -> int:
    """Return the raw value of a raw number, or of a number with a unit. Raises ConfigError outside its range."""
    number, unit = parse_number(text)
    if not number or (unit and unit != field.unit):
        forms = ["a raw number", *([f"a number with unit {field.unit}"] if field.unit else [])]
        raise ConfigError.at(model, field.name, text, "is not a value of this register", forms)
    raw = round(float(number) / field.scale) if unit else int(number)
    if not field.low <= raw <= field.high:
        raise ConfigError.at(model, field.name, text, "is out of range", [f"raw {field.low}..{field.high}"])
    return raw


def parse_number(text: str) -> tuple[str, str]:
    """Split `12.5deg` into number and unit. Only a whole number may have no unit; two empty texts for all else."""
    match = re.fullmatch(r"\s*([-+]?\d{1,20}(?:\.\d+)?)\s*([A-Za-z_]\w*)?\s*", text)
    return ("", "") if match is None or (not match[2] and "." in match[1]) else (match[1], match[2] or "")


# --- id, rate, reboot, reset ------------------------------------------------------------------------------------


def set_id(seen: FoundServo, new: int, confirm: Confirm, in_chain: bool = False) -> FoundServo:
    """Change the id of a servo. If other servos are on the wire, `in_chain` must be set.

    Two new servos with one id can look like one, and both would be changed. Raises ConfigError for an id that cannot be
    used, ServoError when the servo does not accept it.
    """
    wire = seen.wire
    wire.check_id(new, "new id")
    if new == seen.id:
        raise ConfigError.at("servo", "new id", new, "is the id it has")
    if wire.ping(new) is not None:
        raise ConfigError.at("servo", "new id", new, "is taken: another servo answers to it")
    if wire.has_duplicate(seen.id):
        raise ServoError(f"id {seen.id}: two servos seem to answer: unplug all but the one that you mean")
    others = [] if in_chain else [str(each.id) for each in wire.answering() if each.id != seen.id]
    if others:
        raise ConfigError(f"other servos are on the wire (id {', '.join(others)}): unplug them, or say --in-chain")
    seen.guard(f"id {seen.id} -> {new}", confirm)
    _move_to(seen, "id", new, new_id=new)
    changed = wire.ping(new)
    if changed is None:
        raise ServoError(
            f"servo {seen.id}: wrote id {new}, but no servo answers at id {new} (it may need a power cycle)"
        )
    if wire.ping(seen.id) is not None:
        raise ServoError(f"id {new} answers, and so does {seen.id}: two servos had one id, unplug one and look again")
    return changed


def set_baud(seen: FoundServo, baud: int, confirm: Confirm) -> FoundServo:
    """Change the rate of a servo, and find it at the new rate. Raises ConfigError, PortError, ServoError."""
    wire, codes = seen.wire, {rate: code for code, rate in seen.registers().baud_codes.items()}
    if baud not in codes:
        raise ConfigError.at(seen.model, "baud", baud, "is not a rate of this servo", sorted(codes))
    before = wire.baud
    wire.at(baud)  # an adapter that does not support it fails now, while the servo can still be reached
    wire.at(before)
    seen.guard(f"baud {before} -> {baud}", confirm)
    _move_to(seen, "baud_rate", codes[baud], baud=baud)
    wire.at(baud)
    changed = wire.ping(seen.id)
    if changed is None:
        wire.at(before)
        still = "it still answers" if wire.ping(seen.id) else "it does not answer either"
        raise ServoError(f"id {seen.id} was set to {baud} baud and does not answer there; at {before} {still}")
    return changed


def reboot(seen: FoundServo, confirm: Confirm) -> FoundServo:
    """Reboot a servo: torque goes off, hardware errors are cleared. Return it once it answers again."""
    torque = seen.table.role("torque_enable") if seen.table else None
    if torque is not None and seen.read(torque):
        ask(f"id {seen.id} has torque on; a reboot lets go of what it holds", confirm)
    _accepted(seen, seen.wire.link.reboot(seen.id), "to reboot")
    back = _wait_for(seen.wire, seen.id)
    if back is None:
        raise ServoError(f"id {seen.id} does not answer {BACK_S:g} s after the reboot")
    return back


def factory_reset(seen: FoundServo, keep: str, confirm: Confirm) -> FoundServo:
    """Set a servo to its factory values. `keep`: all (keeps nothing), keep-id, keep-id-and-baud.

    Protocol 1 resets everything; the values to be kept are written back.
    """
    if keep not in _RESETS:
        raise ConfigError.at("servo", "factory reset", keep, "is unknown", _RESETS)
    wire, table, home = seen.wire, seen.registers(), seen.wire.baud
    identity, rate, whole = table.role("id"), table.default_baud, keep == "all" or table.protocol == 1
    new_id = seen.id if not whole or identity is None else identity.initial
    taken = new_id != seen.id and wire.ping(new_id) is not None  # at its rate, which may not be the factory's
    if new_id != seen.id:
        if rate is not None and wire.at(rate).ping(new_id) is not None:
            raise ConfigError(f"id {new_id}, which a new servo has, is taken by another one at {rate} baud: unplug it")
        wire.at(home)
    seen.guard(f"every setting of id {seen.id} to its factory value ({keep})", confirm)
    _accepted(seen, wire.link.factory_reset(seen.id, _RESETS["all" if whole else keep]), "the reset")
    expected = home if rate is None or (keep == "keep-id-and-baud" and not whole) else rate
    for baud in dict.fromkeys((expected, expected if taken else home)):
        wire.at(baud)
        if (back := _wait_for(wire, new_id)) is not None:
            if keep != "all" and back.id != seen.id:
                back = set_id(back, seen.id, lambda question: True, in_chain=True)
            kept_rate = keep == "keep-id-and-baud" and back.baud != home
            return set_baud(back, home, lambda question: True) if kept_rate else back
    raise ServoError(f"id {seen.id} was reset and does not answer as {new_id} at {expected} baud")


def _accepted(seen: FoundServo, answer: Any, what: str) -> None:
    """Raise ServoError for an answer that refuses; silence is not a refusal."""
    if answer is not None and (refusal := seen.wire.link.refusal(answer)):
        raise ServoError(f"id {seen.id} refuses {what}: {refusal}")


def _move_to(seen: FoundServo, role: str, raw: int, new_id: int | None = None, baud: int | None = None) -> None:
    """Write a register that changes the servo's id or rate; then close the lock, at the new id or rate."""
    wire, field, lock = seen.wire, seen.registers().role(role), seen.registers().role("lock")
    if field is None:
        raise ServoError(f"id {seen.id}: {seen.model} has no register for its {role}")
    if lock is not None:
        wire.link.write(seen.id, lock.address, lock.to_bytes(0))
    _accepted(seen, wire.link.write(seen.id, field.address, field.to_bytes(raw)), f"{field.name} := {raw}")
    if lock is not None:
        wire.at(baud or wire.baud).write(seen.id if new_id is None else new_id, lock.address, lock.to_bytes(1))


def _wait_for(wire: Wire, servo: int) -> FoundServo | None:
    """Return the servo once it answers, within `BACK_S`; else None."""
    end_s = wire.port.now_s() + BACK_S
    while True:
        seen = wire.ping(servo, tries=1)
        if seen is not None or wire.port.now_s() >= end_s:
            return seen
        wire.port.wait_until(wire.port.now_s() + _STEP_S)


# --- dump and restore -----------------------------------------------------------------------------------------------


class DumpedServo(Model):
    """The stored state of one servo: raw values by register name."""

    id: int
    model: str
    model_number: int | None = None
    firmware: int | None = None
    registers: dict[str, int]


class Dump(Model):
    """The file that `servo dump` writes."""

    version: Literal[1] = 1
    servos: tuple[DumpedServo, ...]


def dump(servos: Sequence[FoundServo]) -> Dump:
    """Read every register of `servos`. Raises ConfigError for a model without a firmware map, ServoError."""
    found = []
    for seen in tracked(servos, "reading registers"):
        seen.wire.at(seen.baud)
        found.append(
            DumpedServo(
                id=seen.id,
                model=seen.registers().model,
                model_number=seen.model_number,
                firmware=seen.firmware,
                registers=read_all(seen).values,
            )
        )
    return Dump(servos=tuple(found))


def check_new(file: Path) -> None:
    """Raise ConfigError if a dump cannot be written or the file exists, which may be the only copy of settings."""
    if file.exists():
        raise ConfigError(f"{file}: exists already, name another file")
    checked_file(file, "servo dump")


def save_dump(what: Dump, file: Path) -> None:
    """Write a dump. Raises ConfigError as `check_new` does."""
    check_new(file)
    text = "# Registers of servos, raw; `sfms-robot servo restore` writes the lasting ones back.\n"
    with file.open("x", encoding="utf-8") as out:
        out.write(text + yaml.safe_dump(what.model_dump(mode="json"), sort_keys=False))


def differences(seen: FoundServo, was: DumpedServo) -> list[tuple[str, int, int]]:
    """Return (register, value now, value then) of the EEPROM registers that differ, without id and rate.

    Raises ConfigError for another model, ServoError.
    """
    table = seen.registers()
    if table.model != was.model:
        raise ConfigError.at(f"id {seen.id}", "model", seen.model, "is not the model of the file", [was.model])
    apart = (table.role("id"), table.role("baud_rate"))
    now, then = read_all(seen).values, was.registers
    lasting = [f.name for f in table.fields.values() if f.eeprom and f.writable and f not in apart]
    return [(n, now[n], then[n]) for n in lasting if n in then and now.get(n) != then[n]]


def restore(seen: FoundServo, was: DumpedServo, confirm: Confirm, identity: bool = False) -> list[Row]:
    """Write the EEPROM of a dumped servo into `seen`, each register verified; return a row for each change.

    One question shows all changes. With `identity` the servo also gets the id and rate of the file, last.

    Raises ConfigError for another model or if the user declines, ServoError for a servo that has torque on or refuses.
    """
    wire, table, changes = seen.wire, seen.registers(), differences(seen, was)
    if changes:
        seen.guard(", ".join(f"{name} {now} -> {then}" for name, now, then in changes), confirm)
    for name, _, then in changes:
        seen.put(table[name], then)
    rows = [{"id": seen.id, "register": name, "before": now, "raw": then} for name, now, then in changes]
    if identity:
        if was.id != seen.id:
            rows.append({"id": seen.id, "register": "id", "before": seen.id, "raw": was.id})
            seen = set_id(seen, was.id, confirm)
        code = table.role("baud_rate")
        rate = table.baud_codes.get(was.registers.get(code.name, -1)) if code is not None else None
        if rate is not None and rate != wire.baud:
            rows.append({"id": seen.id, "register": "baud", "before": wire.baud, "raw": rate})
            set_baud(seen, rate, confirm)
    return rows
