"""All registers of servos in a file, and what lasts of them back into a servo: for replacing one by another."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import yaml

from sfms_robot.app.output_paths import checked_file
from sfms_robot.app.servo.register_view import read_all
from sfms_robot.app.servo.serial_line import FoundServo, Wire
from sfms_robot.app.servo.single_servo import Confirm, guard, put, set_baud, set_id
from sfms_robot.config.base import Model, load
from sfms_robot.errors import ConfigError


class DumpedServo(Model):
    """One servo as it was: raw values by register name."""

    id: int
    model: str
    model_number: int | None = None
    firmware: int | None = None
    registers: dict[str, int]


class Dump(Model):
    """The file that `servo dump` writes."""

    version: Literal[1] = 1
    servos: tuple[DumpedServo, ...]


def dump(wire: Wire, servos: list[FoundServo]) -> Dump:
    """Every register of `servos` as it stands. Raises ConfigError for a model without a firmware map, ServoError."""
    found = []
    for seen in servos:
        model = seen.registers().model
        wire.at(seen.baud)
        values = read_all(wire, seen).values()
        found.append(DumpedServo(
            id=seen.id, model=model, model_number=seen.model_number, firmware=seen.firmware, registers=values
        ))  # fmt: skip
    return Dump(servos=tuple(found))


def check_new(file: Path) -> None:
    """Whether a dump can be written there. Raises ConfigError, as `save_dump` does for a file that is there already."""
    if file.exists():
        raise ConfigError(f"{file}: is there already, name another file")
    checked_file(file, "servo dump")


def save_dump(what: Dump, file: Path) -> None:
    """Raises ConfigError for a file that is there already: it may hold the only copy of another servo's settings."""
    text = "# Registers of servos, raw; `sfms-robot servo restore` writes the lasting ones back.\n"
    text += yaml.safe_dump(what.model_dump(mode="json"), sort_keys=False)
    try:
        with file.open("x", encoding="utf-8") as out:
            out.write(text)
    except FileExistsError:
        raise ConfigError(f"{file}: is there already, name another file") from None


def load_dump(file: Path) -> Dump:
    return load(Dump, file)


def differences(wire: Wire, seen: FoundServo, was: DumpedServo) -> list[tuple[str, int, int]]:
    """(register, value now, value then) of what lasts and is another, without id and rate. Raises ConfigError for
    another model, ServoError.
    """
    table = seen.registers()
    if table.model != was.model:
        raise ConfigError.at(f"id {seen.id}", "model", seen.model, "is not the model of the file", [was.model])
    apart = {field.name for role in ("id", "baud_rate") if (field := table.role(role)) is not None}
    now = read_all(wire, seen).values()
    lasting = (f.name for f in table.fields.values() if f.eeprom and f.writable and f.name not in apart)
    return [(n, now[n], was.registers[n]) for n in lasting if n in was.registers and now.get(n) != was.registers[n]]


def restore(
    wire: Wire, seen: FoundServo, was: DumpedServo, confirm: Confirm, identity: bool = False
) -> list[dict[str, Any]]:
    """Write what lasts of a dumped servo into `seen`, each register verified; rows of what was changed.

    The changes are shown in one question. With `identity` the servo gets id and rate of the file as well, last.

    Raises ConfigError for another model or an answer of no, ServoError for a servo that has torque on or refuses.
    """
    table, changes = seen.registers(), differences(wire, seen, was)
    if changes:
        guard(wire, seen, ", ".join(f"{name} {now} -> {then}" for name, now, then in changes), confirm)
    rows: list[dict[str, Any]] = []
    for name, now, then in changes:
        put(wire, seen, table[name], then)
        rows.append({"id": seen.id, "register": name, "before": now, "raw": then})
    if identity:
        if was.id != seen.id:
            rows.append({"id": seen.id, "register": "id", "before": seen.id, "raw": was.id})
            seen = set_id(wire, seen, was.id, confirm)
        code = table.role("baud_rate")
        rate = table.baud_codes.get(was.registers.get(code.name, -1)) if code is not None else None
        if rate is not None and rate != wire.baud:
            rows.append({"id": seen.id, "register": "baud", "before": wire.baud, "raw": rate})
            set_baud(wire, seen, rate, confirm)
    return rows
