"""What `sfms-robot servo` does to single servos: find, look, write, set id and rate, start over.

Nothing is written to EEPROM unasked, unchecked or unread: a question first (`confirm`), torque off, the lock register
opened where there is one, and afterwards the servo is asked whether it took it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from sfms_robot.app.servo.serial_line import PATIENCE_S, TRIES, FoundServo, Wire
from sfms_robot.errors import ConfigError, ServoError
from sfms_robot.ports import Clock
from sfms_robot.servo.chain.link import finish, ping_replies, verified_write
from sfms_robot.servo.registers import Field, Table

Confirm = Callable[[str], bool]
Progress = Callable[[int, int, str], None]  # steps done, steps in all, what is looked at

BACK_S: Final = 2.0  # a servo that restarts is back by then
_STEP_S: Final = 0.1
_RESETS: Final = {"all": 0xFF, "keep-id": 1, "keep-id-and-baud": 2}


@dataclass(frozen=True)
class Value:
    """One register of one servo, as read."""

    field: Field
    raw: int

    def row(self) -> dict[str, Any]:
        field = self.field
        return {
            "register": field.name,
            "raw": self.raw,
            "value": round(field.to_unit(self.raw), 6),
            "unit": field.unit,
            "address": field.address,
            "size": field.size,
            "access": "RW" if field.writable else "R",
            "area": "EEPROM" if field.eeprom else "RAM",
            "min": field.low if field.writable else None,
            "max": field.high if field.writable else None,
        }


# --- finding ----------------------------------------------------------------------------------------------------


def scan(wire: Wire, ids: Sequence[int] | None = None, progress: Progress | None = None) -> list[FoundServo]:
    """Everybody who answers at any of the wire's rates, by rate and id.

    `ids` are asked one by one; None asks all at once where the family can, else every id there is.
    """
    for servo in ids or ():
        wire.check_id(servo)
    asked = ids if ids is not None else None if wire.kind.broadcast else range(wire.kind.max_id + 1)
    found: list[FoundServo] = []
    total = len(wire.bauds) * (len(asked) if asked is not None else 1)
    for baud in wire.reachable():
        done = wire.bauds.index(baud) * (total // len(wire.bauds))
        if asked is None:
            if progress:
                progress(done, total, f"{baud} baud, {len(found)} found")
            here = [wire.identified(servo, each) for servo, each in sorted(wire.link.broadcast_ping().items())]
            found += [replace(seen, twice=has_duplicate(wire, seen.id)) for seen in here]
            continue
        for step, servo in enumerate(asked):
            if progress:
                progress(done + step, total, f"{baud} baud, id {servo}, {len(found)} found")
            seen = wire.ping(servo, tries=1)
            found += [replace(seen, twice=has_duplicate(wire, servo))] if seen is not None else []
    if progress:
        progress(total, total, f"{len(found)} found")
    return found


def parse_ids(text: str) -> list[int]:
    """`1,5,10-18` -> ids in order. Raises ConfigError."""
    ids: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,3})\s*(?:-\s*(\d{1,3})\s*)?", part)
        if match is None or (match[2] and int(match[2]) < int(match[1])):
            raise ConfigError.at("servo tools", "ids", text, "is not a list of ids", ["5", "1-9", "1,5,10-18"])
        ids += range(int(match[1]), int(match[2] or match[1]) + 1)
    return ids


# --- registers --------------------------------------------------------------------------------------------------


def field_named(table: Table, name: str) -> Field:
    """A register by name, or by the role it plays. Raises ConfigError with the names there are."""
    field = table.fields.get(name) or table.role(name)
    if field is None:
        raise ConfigError.at(table.model, "register", name, "is unknown", table.fields)
    return field


def read_registers(wire: Wire, seen: FoundServo, names: Sequence[str]) -> list[Value]:
    """Registers by name, or `all` of them. Raises ServoError when the servo does not tell one."""
    table = seen.registers()
    if "all" in names:
        fields = sorted(table.fields.values(), key=lambda each: each.address)
    else:
        fields = [field_named(table, name) for name in names]
    return [Value(field, read(wire, seen, field)) for field in fields]


def write_register(wire: Wire, seen: FoundServo, name: str, text: str, confirm: Confirm) -> tuple[Value | None, Value]:
    """Write one register; (before, after). `text` is a raw number, or one with the register's unit: 90deg.

    The status return level is written without a look at what was there: a servo at level 0 does not tell.

    Raises ConfigError for what the register does not take, ServoError when the servo refuses.
    """
    table = seen.registers()
    field = field_named(table, name)
    if field in (table.role("id"), table.role("baud_rate")):
        raise ConfigError(f"{field.name} is not written like this: sfms-robot servo set-id, sfms-robot servo set-baud")
    if not field.writable:
        writable = [each.name for each in table.fields.values() if each.writable]
        raise ConfigError.at(table.model, "register", name, "is read-only", writable)
    raw = parse_value(table.model, field, text)
    mute = field == table.role("status_level")
    before = None if mute else Value(field, read(wire, seen, field))
    if field.eeprom:
        change = f"{field.name} := {raw}" if before is None else f"{field.name} {before.raw} -> {raw}"
        guard(wire, seen, change, confirm, mute)
    put(wire, seen, field, raw)
    return before, Value(field, raw)


def parse_value(model: str, field: Field, text: str) -> int:
    """A raw value, or a number with the register's unit. Raises ConfigError outside the register's range."""
    match = re.fullmatch(r"\s*([-+]?\d{1,20}(?:\.\d+)?)\s*([A-Za-z_]\w*)?\s*", text)
    if match is None or (match[2] is None and "." in match[1]) or match[2] not in (None, field.unit):
        forms = ["a raw number", *([f"a number with unit {field.unit}"] if field.unit else [])]
        raise ConfigError.at(model, field.name, text, "is not a value of this register", forms)
    raw = int(match[1]) if match[2] is None else round(float(match[1]) / field.scale)
    if not field.low <= raw <= field.high:
        raise ConfigError.at(model, field.name, text, "is out of range", [f"raw {field.low}..{field.high}"])
    return raw


def read(wire: Wire, seen: FoundServo, field: Field) -> int:
    """One register. Raises ServoError when the servo refuses or stays silent."""
    return field.from_bytes(read_block(wire, seen, field.address, field.size, field.name))


def read_block(wire: Wire, seen: FoundServo, address: int, length: int, what: str) -> bytes:
    """Bytes of the control table. Raises ServoError."""
    for _ in range(TRIES):
        answer = wire.link.read(seen.id, address, length)
        if answer is not None:
            if refusal := wire.link.refusal(answer):
                raise ServoError(f"id {seen.id} does not tell {what}: {refusal}")
            return answer.data
    raise ServoError(f"id {seen.id} does not answer when asked for {what} (status return level 0?)")


def put(wire: Wire, seen: FoundServo, field: Field, raw: int) -> None:
    """A verified write, through the lock of the EEPROM where there is one. Raises ServoError."""
    finish(verified_write(wire.link, seen.id, field, raw, lock=_lock(seen), tries=TRIES))


# --- id, rate, start over ---------------------------------------------------------------------------------------


def set_id(wire: Wire, seen: FoundServo, new: int, confirm: Confirm, in_chain: bool = False) -> FoundServo:
    """Give a servo another id. With other servos on the wire only when `in_chain` says that this is meant:
    two new servos with one id can look like one, and both would be changed.

    Raises ConfigError for an id that cannot be used, ServoError when the servo does not take it.
    """
    wire.check_id(new, "new id")
    if new == seen.id:
        raise ConfigError.at("servo", "new id", new, "is the id it has")
    if wire.ping(new) is not None:
        raise ConfigError.at("servo", "new id", new, "is taken: another servo answers to it")
    if has_duplicate(wire, seen.id):
        raise ServoError(f"id {seen.id}: two servos seem to answer: unplug all but the one that you mean")
    if not in_chain:
        others = [each.id for each in _neighbours(wire) if each.id != seen.id]
        if others:
            raise ConfigError(
                f"other servos are on the wire (id {', '.join(map(str, others))}): unplug them, or say --in-chain"
            )
    guard(wire, seen, f"id {seen.id} -> {new}", confirm)
    _put_in_eeprom_and_go(wire, seen, _register(seen, "id"), new, new)
    changed = wire.ping(new)
    if changed is None:
        raise ServoError(f"id {seen.id} was told to be {new}, and nobody answers as {new}")
    if wire.ping(seen.id) is not None:
        raise ServoError(f"id {new} answers, and so does {seen.id}: two servos had one id, unplug one and look again")
    return changed


def set_baud(wire: Wire, seen: FoundServo, baud: int, confirm: Confirm) -> FoundServo:
    """Give a servo another rate, and meet it there. Raises ConfigError, PortError, ServoError."""
    codes = {rate: code for code, rate in seen.registers().baud_codes.items()}
    if baud not in codes:
        raise ConfigError.at(seen.model, "baud", baud, "is no rate of this servo", sorted(codes))
    before = wire.baud
    wire.at(baud)  # an adapter that cannot do it says so while the servo can still be reached
    wire.at(before)
    guard(wire, seen, f"baud {before} -> {baud}", confirm)
    _put_in_eeprom_and_go(wire, seen, _register(seen, "baud_rate"), codes[baud], seen.id, baud)
    wire.at(baud)
    changed = wire.ping(seen.id)
    if changed is None:
        wire.at(before)
        still = "it is still" if wire.ping(seen.id) else "nor is it"
        raise ServoError(f"id {seen.id} was told {baud} baud and does not answer there; {still} at {before}")
    return changed


def reboot(wire: Wire, seen: FoundServo, confirm: Confirm) -> FoundServo:
    """Start a servo over: torque goes off, hardware errors are forgotten. Back once it answers again."""
    torque = seen.table.role("torque_enable") if seen.table else None
    if torque is not None and read(wire, seen, torque):
        _ask(f"id {seen.id} has torque on; a reboot lets go of what it holds", confirm)
    answer = wire.link.reboot(seen.id)
    if answer is not None and (refusal := wire.link.refusal(answer)):
        raise ServoError(f"id {seen.id} refuses to reboot: {refusal}")
    back = _wait_for(wire, seen.id)
    if back is None:
        raise ServoError(f"id {seen.id} was told to reboot and does not answer after {BACK_S:g} s")
    return back


def factory_reset(wire: Wire, seen: FoundServo, keep: str, confirm: Confirm) -> FoundServo:
    """Back to what it was when new. `keep`: all (keeps nothing), keep-id, keep-id-and-baud."""
    if keep not in _RESETS:
        raise ConfigError.at("servo", "factory reset", keep, "is unknown", _RESETS)
    table = seen.registers()
    identity, rate = table.role("id"), table.default_baud
    new_id = seen.id if keep != "all" or identity is None else identity.initial
    if new_id != seen.id:
        home = wire.baud
        if rate is not None and wire.at(rate).ping(new_id) is not None:
            raise ConfigError(f"id {new_id}, which a new servo has, is taken by another one at {rate} baud: unplug it")
        wire.at(home)
    guard(wire, seen, f"every setting of id {seen.id} to its factory value ({keep})", confirm)
    answer = wire.link.factory_reset(seen.id, _RESETS[keep])
    if answer is not None and (refusal := wire.link.refusal(answer)):
        raise ServoError(f"id {seen.id} refuses the reset: {refusal}")
    expected = wire.baud if keep == "keep-id-and-baud" or rate is None else rate
    for baud in dict.fromkeys((expected, wire.baud)):
        wire.at(baud)
        back = _wait_for(wire, new_id)
        if back is not None:
            return back
    raise ServoError(f"id {seen.id} was reset and does not answer as {new_id} at {expected} baud")


# --- inside -----------------------------------------------------------------------------------------------------


def has_duplicate(wire: Wire, servo: int) -> bool:
    """Whether two servos seem to answer to one id: a ping brings more than one clean answer, again and again."""
    return all(ping_replies(wire.port, wire.kind.protocol, servo, PATIENCE_S).duplicate for _ in range(TRIES))


def _neighbours(wire: Wire) -> list[FoundServo]:
    """Everybody at the rate of now, without the patience of a scan where all have to be asked one by one."""
    if wire.kind.broadcast:
        return [wire.identified(servo, found) for servo, found in wire.link.broadcast_ping().items()]
    asked = (wire.ping(servo, tries=1) for servo in range(wire.kind.max_id + 1))
    return [seen for seen in asked if seen is not None]


def _register(seen: FoundServo, role: str) -> Field:
    field = seen.registers().role(role)
    if field is None:
        raise ServoError(f"id {seen.id}: {seen.model} has no register for its {role}")
    return field


def _lock(seen: FoundServo) -> Field | None:
    """The register that opens EEPROM. Not that of Dynamixel 1.0: closed once, it stays closed until power is off."""
    return seen.registers().role("lock")


def guard(wire: Wire, seen: FoundServo, what: str, confirm: Confirm, mute: bool = False) -> None:
    """Before EEPROM: torque off (which a `mute` servo cannot say), and somebody wants it.

    Raises ServoError, ConfigError.
    """
    torque = None if mute else seen.registers().role("torque_enable")
    if torque is not None and read(wire, seen, torque):
        raise ServoError(
            f"id {seen.id} has torque on, its EEPROM is closed: sfms-robot servo write {seen.id} {torque.name} 0"
        )
    _ask(f"id {seen.id} ({seen.model}): {what}", confirm)


def _ask(question: str, confirm: Confirm) -> None:
    if not confirm(question):
        raise ConfigError(f"nothing was written: {question} (not confirmed)")


def _put_in_eeprom_and_go(
    wire: Wire, seen: FoundServo, field: Field, raw: int, new_id: int, baud: int | None = None
) -> None:
    """As `put`, for a register after which the servo is elsewhere: the lock has to be closed there."""
    lock = _lock(seen)
    if lock is not None:
        wire.link.write(seen.id, lock.address, lock.to_bytes(0))
    answer = wire.link.write(seen.id, field.address, field.to_bytes(raw))
    if answer is not None and (refusal := wire.link.refusal(answer)):
        raise ServoError(f"id {seen.id} refuses {field.name} := {raw}: {refusal}")
    if lock is not None:
        wire.at(baud or wire.baud).write(new_id, lock.address, lock.to_bytes(1))


def _wait_for(wire: Wire, servo: int) -> FoundServo | None:
    """The servo once it answers, within `BACK_S`."""
    end_s = wire.clock.now_s() + BACK_S
    while True:
        seen = wire.ping(servo, tries=1)
        if seen is not None or wire.clock.now_s() >= end_s:
            return seen
        _pause(wire.clock)


def _pause(clock: Clock) -> None:
    clock.wait_until(clock.now_s() + _STEP_S)
