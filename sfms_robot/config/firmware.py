"""A servo model's control table as data: adding a servo touches no Python."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sfms_robot.config.base import Finite, Model, Name, Positive, load
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError


class Register(Model):
    """One row of a control table. `scale` turns the raw value into `unit`."""

    address: Annotated[int, Field(ge=0, le=65535)]
    size: Literal[1, 2, 4]
    access: Literal["R", "RW"]
    area: Literal["EEPROM", "RAM"]
    unit: str = ""
    scale: Finite = 1.0
    min: int | None = None
    max: int | None = None
    signed: bool = False
    initial: int | None = None


class FirmwareMap(Model):
    """A servo model's control table: `firmware_maps/FAMILY/MODEL.yaml`."""

    model: str
    vendor: str
    model_number: int
    family: Literal["dynamixel"]
    protocol: Literal[2]
    source: str
    ticks_per_revolution: Positive
    center_ticks: int
    no_load_speed_deg_s: Positive
    baud_codes: dict[int, int]  # code in register baud_rate -> bits per second
    faults: dict[int, str] = Field(default_factory=dict)  # bit of hardware_error_status -> what it means
    registers: Annotated[dict[Name, Register], Field(min_length=1)]

    @model_validator(mode="after")
    def _no_overlap(self) -> FirmwareMap:
        end, last = -1, ""
        for name, register in sorted(self.registers.items(), key=lambda item: item[1].address):
            if register.address < end:
                raise ValueError(f"registers.{name}.address = {register.address} overlaps {last} (ends at {end})")
            end, last = register.address + register.size, name
        return self


@lru_cache
def load_firmware_map(model: str) -> FirmwareMap:
    """A servo's control table by model name. Raises ConfigError listing the shipped models."""
    root = data_dir("firmware_maps")
    for file in sorted(root.glob(f"*/{model}.yaml")):
        return load(FirmwareMap, file)
    shipped = sorted(file.stem for file in root.glob("*/*.yaml"))
    raise ConfigError.at("firmware_maps", "model", model, "has no firmware map", shipped)
