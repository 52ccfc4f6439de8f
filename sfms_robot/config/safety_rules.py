"""How gentle a joint is, and what happens when its servo reports a fault: `safety` and `faults` of a head's file.

And what a file may write into a servo, or expect to find stored there, judged from the firmware map.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Final, Literal

from pydantic import Field, StrictInt, model_validator

from sfms_robot.config.base import Finite, Model, Name, Positive
from sfms_robot.errors import ConfigError

if TYPE_CHECKING:  # tables of registers, which a head's model does not need
    from sfms_robot.config.firmware import FirmwareMap

FaultPolicy = Literal["hold", "limp", "reduce", "reboot_and_ease_in"]
MEASURED_FAULTS = ("input voltage", "overheating")  # those a threshold may be given for
_HARMLESS: Final = re.compile(r"(\w+_)?gain|profile_\w+|acceleration|punch|led|c?cw_compliance_(margin|slope)")


class LoadRule(Model):
    """A present current above `current_mA` for `for_s` without a break, and what then happens to the joint."""

    current_mA: Positive
    for_s: Positive
    then: Literal["hold", "limp", "reduce"] = "limp"


class Safety(Model):
    """How gentle a joint is, and what happens when its servo reports a fault.

    Attributes:
        current_limit_mA: the servo never pushes harder; needs a servo with a current sensor.
        torque_limit_percent: of the servo's full torque (its voltage, to be exact); for those without such a sensor.
        on_fault: hold where it is, limp (torque off), reduce (half the force), or reboot and ease in again.
        pinch: something is in the way. By default 60 % of the servo's own current limit for half a second: limp.
        strain: a pose that takes force for long heats the servo and makes it sing. Off by default.
        stop: at the end of a run, once at rest: torque off, or kept.
        halt: in an emergency stop, once the joint stands: torque off, or kept. By default joints of the neck, which
            bear its weight, keep it.
        warm_C, hot_C: temperature from which the joint moves half as far, and from which it stays at rest.
        registers: raw values written before torque comes on: gains, profiles and the like (`is_harmless`).
        stored: raw values that have to be stored in the servo; compared before torque comes on, never written.
    """

    current_limit_mA: Positive | None = None
    torque_limit_percent: Annotated[float, Field(gt=0, le=100)] | None = None
    on_fault: FaultPolicy = "limp"
    pinch: LoadRule | None = None
    strain: LoadRule | None = None
    stop: Literal["release", "hold"] = "release"
    halt: Literal["release", "hold"] | None = None
    warm_C: Positive = 60.0
    hot_C: Positive = 67.0
    registers: dict[Name, StrictInt] = Field(default_factory=dict)
    stored: dict[Name, StrictInt] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _hot_is_warmer(self) -> Safety:
        if self.hot_C <= self.warm_C:
            raise ValueError(f"hot_C: {self.hot_C:g} is not above warm_C ({self.warm_C:g})")
        return self

    def merged(self, other: Safety | None) -> Safety:
        """This, and over it what `other` gives explicitly."""
        return self if other is None else self.model_copy(update={k: getattr(other, k) for k in other.model_fields_set})


class Threshold(Model):
    """A fault counts only when what it is about lies outside min..max (V for voltage, degC for heat)."""

    min: Finite | None = None
    max: Finite | None = None


class Faults(Model):
    """Which of the servos' faults are acted upon, by the names in the firmware map."""

    mask: tuple[str, ...] = ()
    thresholds: dict[str, Threshold] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _measurable(self) -> Faults:
        for name in self.thresholds:
            if name not in MEASURED_FAULTS:
                raise ValueError(f"thresholds.{name} is about nothing that is measured ({', '.join(MEASURED_FAULTS)})")
        return self


def is_harmless(table: FirmwareMap, name: str) -> bool:
    """Return whether a run may write this register unasked: one in RAM that cannot hurt.

    `safety.registers` is written before torque comes on, in every run, without a question. So it holds only values
    that are lost with the supply and cannot hurt: gains, profiles, compliance, LED. Id, direction and range are stored
    for good; a head may say under `safety.stored` which values it expects, and a run compares and never writes them.
    Goals, torque, modes and limits are the run's own.
    """
    register = table.registers[name]
    return register.access == "RW" and register.area == "RAM" and _HARMLESS.fullmatch(name) is not None


def register_problems(safety: Safety, table: FirmwareMap) -> Iterator[tuple[str, int, str, list[str]]]:
    """Yield key, value, what is wrong with it, and the valid choices."""
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
