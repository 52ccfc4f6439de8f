"""A servo model's control table as data, one YAML file per model.

A file is refused if its registers overlap or do not fit their size, or if a role names a register that does not exist,
so that code after the loader need not check them. A model whose table changed with its firmware has one file per layout
(`xl330-m288.yaml`, `xl330-m288_fw52.yaml`): `variant` chooses the layout by the number read from the servo.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PositiveInt, computed_field

from sfms_robot.config.base import Finite, Model, Name, Positive, Problems, load
from sfms_robot.data import data_dir, user_dir
from sfms_robot.errors import ConfigError

Family = Literal["dynamixel", "feetech", "maestro", "ssc32"]
Unit = Literal[
    "", "V", "address", "baud_code_dxl1", "baud_code_dxl2", "baud_code_feetech", "baud_code_xl320", "bits", "bool",
    "code", "deg", "degC", "deg_per_s", "deg_per_s2", "id", "mA", "mV_per_ms", "ms", "percent", "rev_per_min2", "rpm",
    "us",
]  # fmt: skip
Role = Literal[
    "goal_position", "present_position", "present_speed", "present_load", "present_current", "voltage", "temperature",
    "torque_enable", "id", "baud_rate", "return_delay", "status_level", "error_status", "lock", "moving_speed",
    "torque_limit", "bus_watchdog", "operating_mode",
]  # fmt: skip
_SIGN_RULE = r"^(no|twos_complement|offset_2048|sign_bit_([0-9]|[12][0-9]|3[01]))$"
Bit = Annotated[int, Field(ge=0, le=15)]


class Register(Model):
    """One register, a row of a control table. Its value times `scale` is in `unit`.

    `signed` is the encoding of negative values: `twos_complement`; `sign_bit_N`, where bit N is set for minus and the
    bits below are the magnitude; `offset_2048`, where 2048 stands for zero. `min`, `max` and `initial` are decoded.
    """

    address: int = Field(ge=0, le=65535)
    size: Literal[1, 2, 4]
    access: Literal["R", "RW"]
    area: Literal["EEPROM", "RAM"]
    unit: Unit = ""
    scale: Finite = 1.0
    min: int | None = None
    max: int | None = None
    signed: str = Field(default="no", pattern=_SIGN_RULE)
    initial: int | None = None

    @property
    def held(self) -> tuple[int, int]:
        """Smallest and largest value that the bytes can hold under the sign rule."""
        if self.signed == "twos_complement":
            half = 1 << 8 * self.size - 1
            return -half, half - 1
        if self.signed == "offset_2048":
            return -2048, 2047
        if self.signed.startswith("sign_bit_"):
            magnitude = (1 << int(self.signed.removeprefix("sign_bit_"))) - 1
            return -magnitude, magnitude
        return 0, (1 << 8 * self.size) - 1

    @computed_field  # type: ignore[prop-decorator]  # mypy has no rule for decorated properties
    @property
    def low(self) -> int:
        """Smallest allowed value: `min`, or else the smallest that the bytes can hold."""
        return self.held[0] if self.min is None else self.min

    @computed_field  # type: ignore[prop-decorator]
    @property
    def high(self) -> int:
        """Largest allowed value: `max`, or else the largest that the bytes can hold."""
        return self.held[1] if self.max is None else self.max

    @property
    def end(self) -> int:
        """Address after the last byte."""
        return self.address + self.size

    def problems(self) -> Problems:
        """Yield each impossible value of this row as `key = value problem`."""
        if self.signed.startswith("sign_bit_") and int(self.signed.removeprefix("sign_bit_")) >= 8 * self.size:
            yield f"signed = {self.signed!r} does not fit {self.size} byte(s)"
            return
        if self.signed == "offset_2048" and self.size != 2:
            yield f"signed = {self.signed!r} needs a size of 2"
            return
        low, high = self.held
        for key, value in (("min", self.min), ("max", self.max), ("initial", self.initial)):
            if value is not None and not low <= value <= high:
                yield f"{key} = {value} does not fit {self.size} byte(s) ({low}..{high})"
        if self.low > self.high:
            yield f"min = {self.min} is above max = {self.max}"
        elif self.initial is not None and not self.low <= self.initial <= self.high:
            yield f"initial = {self.initial} is outside min..max ({self.low}..{self.high})"


class FirmwareRange(Model):
    """Firmware versions for which a map is valid; an end that is left out is open."""

    min: int = Field(default=0, ge=0, le=255)
    max: int = Field(default=255, ge=0, le=255)

    def contradictions(self) -> Problems:
        if self.min > self.max:
            yield f"min = {self.min} is above max = {self.max}"

    def overlaps(self, other: FirmwareRange) -> bool:
        return self.min <= other.max and other.min <= self.max


class PulseRange(Model):
    """Pulse widths that a hobby-servo board produces, in microseconds."""

    min: Positive
    max: Positive


class FirmwareMap(Model):
    """A servo model's control table, or a servo board's channels: `firmware_maps/FAMILY/MODEL.yaml`.

    A smart servo has `protocol` and `registers`; a board (maestro, ssc32) has `channels`, `pulse_us` and `tick_us`
    instead, and one tick of position is `tick_us` of pulse.
    """

    model: str
    vendor: str
    model_number: int | None = Field(default=None, ge=0, le=65535)  # None: not known, so it cannot be checked
    family: Family
    protocol: Literal[1, 2] | None = None
    byte_order: Literal["little", "big"] = "little"
    firmware: FirmwareRange = FirmwareRange()
    variant_of: str | None = None  # the model that has this layout under another firmware
    same_number_as: str | None = None  # another model with the same model number
    source: str = Field(min_length=1)
    ticks_per_revolution: Positive
    center_ticks: int
    no_load_speed_deg_s: Positive | None = None  # None: not known
    watchdog: Literal["stops", "flags_only", "none"] = "none"  # reaction of the servo to a silent host
    position_mode: int | None = None  # value of role operating_mode for position control
    baud_codes: dict[int, PositiveInt] = {}  # code in role baud_rate -> bit/s
    faults: dict[Bit, str] = {}  # bit of role error_status, or of a board's error word -> fault
    status_faults: dict[Bit, str] = {}  # bit of the error byte of every status packet -> fault
    channels: int | None = Field(default=None, gt=0, le=255)
    pulse_us: PulseRange | None = None
    tick_us: Positive | None = None
    roles: dict[Role, Name | None] = {}  # role -> register, where the names differ; None: no such register
    registers: dict[Name, Register] = {}

    def contradictions(self) -> Problems:
        if problems := [*self._shape(), *self._layout(), *self._references()]:
            yield "; ".join(problems)

    def _shape(self) -> Problems:
        """Yield a wrong protocol, keys of a board in a servo's map, and the reverse."""
        allowed = {"dynamixel": (1, 2), "feetech": (1,)}.get(self.family, (None,))
        if self.protocol not in allowed:
            yield f"protocol = {self.protocol} is not one of family {self.family} ({', '.join(map(str, allowed))})"
        board = self.family in ("maestro", "ssc32")
        problem = (
            f"is missing: a {self.family} board has it" if board else f"belongs to a board, not to family {self.family}"
        )
        yield from (
            f"{key} {problem}" for key in ("channels", "pulse_us", "tick_us") if bool(getattr(self, key)) != board
        )
        if board and self.pulse_us and self.pulse_us.min >= self.pulse_us.max:
            yield f"pulse_us.min = {self.pulse_us.min} is not below pulse_us.max = {self.pulse_us.max}"
        if bool(self.registers) == board:
            yield f"registers: a {self.family} board has none" if board else "registers is empty"

    def _layout(self) -> Problems:
        """Yield registers that overlap, exceed the address space, or cannot hold their values."""
        end, last = 0, ""
        wide = any(register.size == 4 for register in self.registers.values())
        space = 65536 if self.protocol == 2 else 256  # one address byte in the frame of protocol 1 and Feetech
        for name, register in sorted(self.registers.items(), key=lambda item: item[1].address):
            if register.address < end:
                yield f"registers.{name}.address = {register.address} overlaps {last} (ends at {end})"
            if register.end > space:
                yield f"registers.{name}.address = {register.address} ends past the address space ({space} bytes)"
            if wide and register.size > 1 and register.address % 2:
                # A servo whose table has 4-byte registers reads it in words, so an odd address is a mistake.
                yield f"registers.{name}.address = {register.address} is odd, which {register.size} bytes cannot be"
            yield from (f"registers.{name}.{problem}" for problem in register.problems())
            end, last = max(end, register.end), name

    def _references(self) -> Problems:
        for role, name in self.roles.items():
            if name is not None and name not in self.registers:
                yield f"roles.{role} = {name!r} is not a register of this map"
        rates: dict[int, int] = {}
        for code, rate in self.baud_codes.items():
            if (other := rates.setdefault(rate, code)) != code:
                yield f"baud_codes.{code} = {rate} is also code {other}"


def user_maps() -> Path:
    """Return the folder of the user's own firmware maps."""
    return user_dir() / "firmware_maps"


def map_files() -> list[Path]:
    """Return all shipped firmware maps, sorted, and then those of the user."""
    return [*sorted(data_dir("firmware_maps").glob("*/*.yaml")), *sorted(user_maps().glob("**/*.yaml"))]


def model_name(text: str) -> str:
    """Return the name of a servo model's map: in lower case, without the suffix -T or -R for its connector."""
    name = text.lower()
    return text if name.endswith(".yaml") else name if name.endswith("-1.0") else re.sub("-[tr]$", "", name)


@lru_cache
def load_firmware_map(model: str) -> FirmwareMap:
    """Return a servo's control table by model name, or by the path of a `.yaml` file.

    Raises ConfigError for a model without a map, listing the models with one, and for a model with two maps.
    """
    if model.endswith(".yaml"):
        return load(FirmwareMap, Path(model))
    files, model = map_files(), model_name(model)
    named = [file for file in files if model_name(file.stem) == model]
    if len(named) > 1:
        raise ConfigError(f"{named[1]}: expected another name, as {model} has a map already ({named[0]})")
    if not named:
        raise ConfigError.at("firmware_maps", "model", model, "has no firmware map", [file.stem for file in files])
    return load(FirmwareMap, named[0])


def variant(model: str | FirmwareMap, firmware: int) -> FirmwareMap:
    """Return the layout of `model` for the firmware number read from the servo.

    Raises ConfigError, which lists the available layouts, if there is none.
    """
    named = load_firmware_map(model) if isinstance(model, str) else model
    if named.firmware.min <= firmware <= named.firmware.max:
        return named
    root = named.variant_of or named.model
    shipped = [load_firmware_map(file.stem) for file in map_files() if file.stem.startswith(root)]
    layouts = [each for each in shipped if root in (each.model, each.variant_of)] or [named]
    for layout in layouts:
        if layout.firmware.min <= firmware <= layout.firmware.max:
            return layout
    known = [f"{each.model} {each.firmware.min}..{each.firmware.max}" for each in layouts]
    raise ConfigError.at("firmware_maps", "firmware", firmware, f"of {named.model} has no firmware map", known)
