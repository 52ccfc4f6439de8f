"""What a head's file may write into a servo, and what it may expect to find stored there, judged from the firmware map.

`safety.registers` is written before torque comes on, in every run, without a question. So it holds what is forgotten
with the supply and cannot hurt: gains, profiles, compliance, LED. Who a servo is, how it turns and how far is stored
for good; a head may say under `safety.stored` what has to be found, and a run compares it and never writes it. Goals,
torque, modes and limits are the run's own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Final

from sfms_robot.config.firmware import FirmwareMap
from sfms_robot.config.safety_rules import Safety
from sfms_robot.errors import ConfigError

_HARMLESS: Final = re.compile(r"(\w+_)?gain|profile_\w+|acceleration|punch|led|c?cw_compliance_(margin|slope)")


def is_harmless(table: FirmwareMap, name: str) -> bool:
    """May a run write this register unasked? In RAM, and none that says who the servo is or what it does."""
    register = table.registers[name]
    return register.access == "RW" and register.area == "RAM" and _HARMLESS.fullmatch(name) is not None


def register_problems(safety: Safety, table: FirmwareMap) -> Iterator[tuple[str, int, str, list[str]]]:
    """Key, value, what is wrong with it, valid choices."""
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
    """Raises ConfigError for the first value of `joints` that a run must not write, or that cannot be stored."""
    for joint, (safety, table) in joints.items():
        for key, value, problem, choices in register_problems(safety, table):
            raise ConfigError.at(head, f"joints.{joint}.safety.{key}", value, problem, choices)
