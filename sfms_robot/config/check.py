"""Every problem of a head's file at once, where `load_head` stops at the first.

Each part of the file is parsed on its own, so that a mistake in one joint does not hide those of another; then the
parts that are sound are checked against each other, and against the names of those that are not.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from sfms_robot.config.base import UNKNOWN_KEY, Name, one_line
from sfms_robot.config.consistency import problems, rates, wiring
from sfms_robot.config.firmware import load_firmware_map
from sfms_robot.config.head import Head, RobotDescription, description_problems, expanded, load_head
from sfms_robot.config.joint import Joint, LimitClass
from sfms_robot.config.kinematics import Kinematics
from sfms_robot.config.kinematics import problems as neck_problems
from sfms_robot.config.mapping import Coupling, Expression, Fold, Region
from sfms_robot.config.named_bus import Bus
from sfms_robot.config.overlay import load_overlay
from sfms_robot.config.safety_rules import Safety, register_problems
from sfms_robot.config.yaml_file import read
from sfms_robot.data import find
from sfms_robot.errors import ConfigError

_TABLES: dict[str, Any] = {
    "buses": Bus,
    "limits": LimitClass,
    "joints": Joint,
    "expressions": Expression,
    "regions": Region,
}
_LISTS: dict[str, Any] = {"couplings": Coupling, "folds": Fold}


class _Rest(Head):
    """A head of which only the names of the parts above are looked at."""

    buses: Annotated[dict[Name, Any], Field(min_length=1)]
    limits: dict[Name, Any]
    joints: Annotated[dict[Name, Any], Field(min_length=1)]
    expressions: dict[Name, Any] = Field(default_factory=dict)
    regions: dict[Name, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> _Rest:
        return self


def check_head(name: str) -> list[str]:
    """Problems of a head, by shipped name or folder, one line each with file, key, value and choices; none if sound.

    Of a sound head the overlay of this build is looked at too. Raises ConfigError where there is no such head.
    """
    file = find("heads", name, "head.yaml") / "head.yaml"
    try:
        raw = read(file)
    except ConfigError as error:
        return [str(error)]
    found = [f"{file}: {line}" for line in _problems(raw)]
    if not found:
        try:
            load_overlay(load_head(name))
        except ConfigError as error:
            found = [str(error)]
    return list(dict.fromkeys(found))


def _problems(raw: Any) -> list[str]:
    if not isinstance(raw, dict):
        return [f"a head is a table of {', '.join(Head.model_fields)}"]
    try:
        full = expanded(raw)
    except ValueError as error:
        return [str(error)]
    found: list[str] = []
    parts: dict[str, dict[Any, Any]] = {}
    for key, model in (_TABLES | _LISTS).items():
        given: Any = full.get(key, [] if key in _LISTS else {})
        if isinstance(given, list if key in _LISTS else dict):
            entries: Iterable[Any] = given.items() if isinstance(given, dict) else enumerate(given)
            parts[key] = {name: _parsed(model, value, f"{key}.{name}", found) for name, value in entries}
    description = _parsed(RobotDescription | None, full.get("urdf"), "urdf", found)
    neck = _parsed(Kinematics | None, full.get("kinematics"), "kinematics", found)
    rest = {key: value if key not in parts else _names_only(key, value) for key, value in raw.items()}
    _parsed(_Rest, rest | {"kinematics": None, "urdf": None}, "", found)
    table = {key: parts.get(key, {}) for key in (*_TABLES, *_LISTS)}
    found += wiring(table["joints"], table["buses"], table["limits"]) + rates(table["joints"], table["buses"])
    found += _servos(table["joints"], full.get("safety", {}))
    found += description_problems(description, table["joints"])
    couplings, folds = list(table["couplings"].values()), list(table["folds"].values())
    if neck is not None:
        found += neck_problems(neck, table["joints"], folds)
    return found + problems(table["joints"], table["expressions"], couplings, folds, table["regions"])


def _servos(joints: dict[str, Joint | None], safety: Any) -> list[str]:
    """Servos without a firmware map, and registers that a run must not write."""
    found: list[str] = []
    shared = _parsed(Safety, safety, "safety", [])  # its own problems are told with the rest of the head
    for name, joint in joints.items():
        if joint is None:
            continue
        try:
            table = load_firmware_map(joint.model)
        except ConfigError as error:
            found.append(f"joints.{name}.model: {error}")
            continue
        rules = (shared or Safety()).merged(joint.safety)
        for key, value, problem, choices in register_problems(rules, table):
            found.append(f"joints.{name}.safety.{key} = {value} {problem} ({', '.join(choices)})")
    return found


def _names_only(key: str, value: Any) -> Any:
    return () if key in _LISTS else dict.fromkeys(value)


def _parsed(model: Any, value: Any, where: str, found: list[str]) -> Any:
    """`value` as `model`, or None with its problems added to `found`.

    An unknown key, or a wrong drive, keeps the part it is in from being looked at any further; so it is told, taken
    out, and the rest looked at again.
    """
    value, sound = copy.deepcopy(value), True
    while True:
        try:
            parsed = TypeAdapter(model).validate_python(value)
            return parsed if sound else None
        except ValidationError as error:
            unknown = [problem for problem in error.errors() if problem["type"] == UNKNOWN_KEY]
            told = unknown or error.errors()
            found += [one_line(problem, where) for problem in told]
            removable = unknown or (model is Joint and all("drive" in problem["loc"][:1] for problem in told))
            if not removable:
                return None
            sound = False
            for path in {(*p["loc"], p["ctx"]["key"]) if unknown else ("drive",) for p in told}:
                _remove(value, path)


def _remove(value: Any, path: tuple[Any, ...]) -> None:
    """Take out what lies at `path`; steps that only name a choice of models, such as a kind, are passed over."""
    for step in path[:-1]:
        if isinstance(value, list) or step in value:
            value = value[step]
    del value[path[-1]]
