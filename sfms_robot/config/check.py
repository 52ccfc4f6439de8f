"""All problems of a head's file at once; `load_head` reports only the first one.

Wrong keys and values come first; contradictions between the parts are searched for only if there are none. The
registers that a file may write into a servo, or expect to find stored there, are checked with its firmware map.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from pydantic import ValidationError

from sfms_robot.config.base import Problems, one_line
from sfms_robot.config.firmware import FirmwareMap, load_firmware_map
from sfms_robot.config.head import Head, load_head
from sfms_robot.config.joint import BUS_FAMILIES, Safety
from sfms_robot.config.overlay import load_overlay
from sfms_robot.data import head_file
from sfms_robot.errors import ConfigError

_SMALL_DEG: Final = 6.3  # a smaller range may have been written in radians, where a whole turn is 6.28
_HARMLESS: Final = re.compile(r"(\w+_)?gain|profile_\w+|acceleration|punch|led|c?cw_compliance_(margin|slope)")


def check_head(name: str) -> list[str]:
    """Return the problems of a head, by shipped name or folder, one line each with file, key, value and choices.

    For a head without problems the overlay of this build is checked too. Raises ConfigError if there is no such head.
    """
    file = head_file(name)
    try:
        head = load_head(name)
        if not (found := list(_servos(head))):
            load_overlay(head)
    except ConfigError as error:
        if not isinstance(error.__cause__, ValidationError):
            return [str(error)]
        found = [one_line(problem) for problem in error.__cause__.errors()]
    return [f"{file}: {line}" for line in dict.fromkeys(found)]


def _servos(head: Head) -> Problems:
    """Yield servos without a firmware map or of another family than their bus, and register values that are refused."""
    for name, joint in head.joints.items():
        try:
            table = load_firmware_map(joint.model)
        except ConfigError as error:
            alike = [other for other, one in head.joints.items() if one.model == joint.model]
            if alike[0] == name:  # report a model once, with all of its joints
                yield f"joints.{', '.join(alike)}: {str(error).removeprefix('firmware_maps: ')}"
            continue
        family = f"{table.family}{table.protocol}" if table.family == "dynamixel" else table.family
        if (wanted := head.buses[joint.bus].family) != family and wanted in BUS_FAMILIES:
            problem = f"expected a servo of family {wanted}, as bus {joint.bus}, got {family}"
            yield f"joints.{name}.model = {joint.model!r}: {problem}"
        for key, value, problem, choices in register_problems(head.safety_of(name), table):
            yield f"joints.{name}.safety.{key} = {value} {problem} ({', '.join(choices)})"


def remarks(head: Head) -> list[str]:
    """Return one line for each value of a head that is allowed but probably a mistake."""
    found = []
    for name, joint in head.joints.items():
        low, high, fastest = joint.min_deg, joint.max_deg, load_firmware_map(joint.model).no_load_speed_deg_s
        if high - low < _SMALL_DEG and joint.unit == "rad":
            found.append(f"joints.{name}: {low:g}..{high:g} deg is a small range: is it in radians?")
        speed = head.limit(name).speed_deg_s * joint.ratio
        if fastest is not None and speed > fastest:
            turns = f"{speed:g} deg/s is more than {joint.model} turns without a load ({fastest:g})"
            found.append(f"limits.{joint.limits}.speed_deg_s: {turns}; {name} lags behind it")
    return found


def is_harmless(table: FirmwareMap, name: str) -> bool:
    """Return whether a run may write this register without confirmation: it is in RAM and harmless.

    Every run writes `safety.registers` before torque comes on, without confirmation. The section may therefore hold
    only values that are harmless and are lost when the supply is switched off: gains, profiles, compliance, LED. Id,
    direction and range are stored permanently. A head may list the expected values of these under `safety.stored`; a
    run compares them but never writes them. Goals, torque, modes and limits are set by the run itself.
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
                yield f"{key}.{name}", value, f"is not a register of {table.model}", choices
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
    return f"of {table.model} must not be set by a head's file; it may set"
