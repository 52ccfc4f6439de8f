"""All problems of a head's file at once, where `load_head` stops at the first.

Each part of the file is parsed on its own, so that a mistake in one joint does not hide those of another; then the
sound parts are checked against each other, and against the names of the others. The registers that a file may write
into a servo, or expect to find stored there, are judged by its firmware map.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Iterator, Mapping
from types import SimpleNamespace
from typing import Annotated, Any, Final

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from sfms_robot.config.base import UNKNOWN_KEY, Name, one_line, read
from sfms_robot.config.consistency import problems
from sfms_robot.config.firmware import FirmwareMap, load_firmware_map
from sfms_robot.config.head import Head, RobotDescription, expanded, load_head
from sfms_robot.config.joint import BusConfig, Coupling, Expression, Fold, Joint, LimitClass, Region, Safety
from sfms_robot.config.kinematics import Kinematics
from sfms_robot.config.overlay import load_overlay
from sfms_robot.data import find
from sfms_robot.errors import ConfigError

_TABLES: Final[Mapping[str, Any]] = {
    "buses": BusConfig,
    "limits": LimitClass,
    "joints": Joint,
    "expressions": Expression,
    "regions": Region,
}
_LISTS: Final[Mapping[str, Any]] = {"couplings": Coupling, "folds": Fold}
_HARMLESS: Final = re.compile(r"(\w+_)?gain|profile_\w+|acceleration|punch|led|c?cw_compliance_(margin|slope)")


class _Rest(Head):
    """A head without checks of the parts above, of which only the names are used."""

    buses: Annotated[dict[Name, Any], Field(min_length=1)]
    limits: dict[Name, Any]
    joints: Annotated[dict[Name, Any], Field(min_length=1)]
    expressions: dict[Name, Any] = Field(default_factory=dict)
    regions: dict[Name, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> _Rest:
        return self


def check_head(name: str) -> list[str]:
    """Return the problems of a head, by shipped name or folder, one line each with file, key, value and choices.

    For a sound head the overlay of this build is checked too. Raises ConfigError where there is no such head.
    """
    file = find("heads", name, "head.yaml") / "head.yaml"
    try:
        found = [f"{file}: {line}" for line in _problems(read(file))]
        if not found:
            load_overlay(load_head(name))
    except ConfigError as error:
        return [str(error)]
    return list(dict.fromkeys(found))


def _problems(raw: Any) -> list[str]:
    if not isinstance(raw, dict):
        return [f"a head is a table of {', '.join(Head.model_fields)}"]
    try:
        full = expanded(raw)
    except ValueError as error:
        return [str(error)]
    found: list[str] = []
    parts: dict[str, Any] = {}
    names: dict[str, Any] = {}
    for key, model in {**_TABLES, **_LISTS}.items():
        given: Any = full.get(key, [] if key in _LISTS else {})
        parts[key] = {}
        if isinstance(given, list if key in _LISTS else dict):
            entries: Iterable[Any] = given.items() if isinstance(given, dict) else enumerate(given)
            parts[key] = {name: _parsed(model, value, f"{key}.{name}", found) for name, value in entries}
            names |= {key: () if key in _LISTS else dict.fromkeys(raw[key])} if key in raw else {}
    parts |= {key: list(parts[key].values()) for key in _LISTS}
    parts["urdf"] = _parsed(RobotDescription | None, full.get("urdf"), "urdf", found)
    parts["kinematics"] = _parsed(Kinematics | None, full.get("kinematics"), "kinematics", found)
    _parsed(_Rest, {**raw, **names, "kinematics": None, "urdf": None}, "", found)
    return found + [*_servos(parts["joints"], full.get("safety", {})), *problems(SimpleNamespace(**parts))]


def _servos(joints: dict[str, Joint | None], safety: Any) -> Iterator[str]:
    """Yield the servos without a firmware map, and the registers that a run must not write."""
    shared = _parsed(Safety, safety, "safety", [])  # its own problems are reported with the rest of the head
    for name, joint in joints.items():
        if joint is None:
            continue
        try:
            table = load_firmware_map(joint.model)
        except ConfigError as error:
            yield f"joints.{name}.model: {error}"
            continue
        rules = (shared or Safety()).merged(joint.safety)
        for key, value, problem, choices in register_problems(rules, table):
            yield f"joints.{name}.safety.{key} = {value} {problem} ({', '.join(choices)})"


def _parsed(model: Any, value: Any, where: str, found: list[str]) -> Any:
    """Return `value` as `model`, or None with its problems added to `found`.

    An unknown key, or a wrong drive, keeps the part around it from being checked any further. So it is reported and
    removed, and the rest is checked again.
    """
    value, sound = copy.deepcopy(value), True
    while True:
        try:
            parsed = TypeAdapter(model).validate_python(value)
            return parsed if sound else None
        except ValidationError as error:
            unknown = [problem for problem in error.errors() if problem["type"] == UNKNOWN_KEY]
            reported = unknown or error.errors()
            found += [one_line(problem, where) for problem in reported]
            drive = model is Joint and all("drive" in problem["loc"][:1] for problem in reported)
            if not (unknown or drive):
                return None
            sound = False
            for *steps, last in {(*p["loc"], p["ctx"]["key"]) if unknown else ("drive",) for p in reported}:
                place = value
                for step in steps:  # one that only names a choice of models, such as a kind, is passed over
                    if isinstance(place, list) or step in place:
                        place = place[step]
                del place[last]


def is_harmless(table: FirmwareMap, name: str) -> bool:
    """Return whether a run may write this register unasked: one in RAM that cannot hurt.

    `safety.registers` is written before torque comes on, in every run, without a question. So it holds only values
    that are lost with the supply and cannot hurt: gains, profiles, compliance, LED. Id, direction and range are stored
    for good; a head may list under `safety.stored` the values that it expects, and a run compares and never writes
    them. Goals, torque, modes and limits are the run's own.
    """
    register = table.registers[name]
    return register.access == "RW" and register.area == "RAM" and _HARMLESS.fullmatch(name) is not None


def register_problems(safety: Safety, table: FirmwareMap) -> Iterator[tuple[str, int, str, list[str]]]:
    """Yield key, value, problem and the valid choices of each register value that is refused."""
    harmless = [name for name in table.registers if is_harmless(table, name)]
    stored = [name for name, row in table.registers.items() if row.area == "EEPROM"]
    for key, given, choices in (("registers", safety.registers, harmless), ("stored", safety.stored, stored)):
        for name, value in given.items():
            register = table.registers.get(name)
            if register is None:
                yield f"{key}.{name}", value, f"is no register of {table.model}", choices
            elif name not in choices:
                yield f"{key}.{name}", value, _refusal(key, name, table), choices
            elif not register.low <= value <= register.high:
                yield f"{key}.{name}", value, f"does not fit {table.model}", [f"{register.low}..{register.high}"]


def _refusal(key: str, name: str, table: FirmwareMap) -> str:
    if key == "stored":
        return f"is forgotten when {table.model} is switched off, nothing is stored there"
    if table.registers[name].area == "EEPROM":
        return (
            f"would be stored in {table.model} for good: set it once with `sfms-robot servo write`, "
            f"and let stored.{name} compare it; a run writes only"
        )
    return f"of {table.model} is not the file's to set; it may set"


def check_registers(head: str, joints: Mapping[str, tuple[Safety, FirmwareMap]]) -> None:
    """Raise ConfigError for the first value of `joints` that a run must not write, or that cannot be stored."""
    for joint, (safety, table) in joints.items():
        for key, value, problem, choices in register_problems(safety, table):
            raise ConfigError.at(head, f"joints.{joint}.safety.{key}", value, problem, choices)
