"""A firmware map made ready for use: registers by name, raw values to bytes and back.

`Table` is plain data, so that an emulated servo in another process needs neither the loader nor its libraries.
Multi-byte registers are little-endian; negative values are two's complement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from sfms_robot.config import FirmwareMap


class Field(NamedTuple):
    """One register. `low`..`high` are the raw values it takes when written."""

    name: str
    address: int
    size: int
    signed: bool
    writable: bool
    eeprom: bool
    scale: float
    low: int
    high: int
    initial: int

    def to_bytes(self, raw: int) -> bytes:
        """Raises OverflowError when `raw` does not fit the register's size."""
        return raw.to_bytes(self.size, "little", signed=self.signed)

    def from_bytes(self, data: bytes | bytearray) -> int:
        return int.from_bytes(data[: self.size], "little", signed=self.signed)

    def to_unit(self, raw: int) -> float:
        """Raw value -> the unit of the firmware map."""
        return raw * self.scale


@dataclass(frozen=True)
class Table:
    """A servo model's control table.

    Attributes:
        fields: registers by name.
        ticks_per_revolution: position ticks of one turn.
        top_speed_ticks_s: no-load speed.
        baud_codes: code in register `baud_rate` -> bits per second.
        faults: bit of `hardware_error_status` -> what it means.
    """

    model: str
    model_number: int
    fields: Mapping[str, Field]
    ticks_per_revolution: float
    center_ticks: int
    top_speed_ticks_s: float
    baud_codes: Mapping[int, int]
    faults: Mapping[int, str]

    @classmethod
    def of(cls, firmware_map: FirmwareMap) -> Table:
        return cls.from_plain(firmware_map.model_dump(mode="json"))

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Table:
        """From a validated firmware map dumped to plain data, also by way of JSON (which makes keys text)."""
        per_degree = plain["ticks_per_revolution"] / 360.0
        return cls(
            model=plain["model"],
            model_number=plain["model_number"],
            fields={name: _field(name, row) for name, row in plain["registers"].items()},
            ticks_per_revolution=plain["ticks_per_revolution"],
            center_ticks=plain["center_ticks"],
            top_speed_ticks_s=plain["no_load_speed_deg_s"] * per_degree,
            baud_codes={int(code): baud for code, baud in plain["baud_codes"].items()},
            faults={int(bit): text for bit, text in plain["faults"].items()},
        )

    def __getitem__(self, name: str) -> Field:
        return self.fields[name]

    @property
    def size(self) -> int:
        """Bytes of the whole table."""
        return max(field.address + field.size for field in self.fields.values())

    def span(self, names: Sequence[str]) -> tuple[int, int]:
        """(address, length) of the block that holds all of `names`."""
        fields = [self.fields[name] for name in names]
        first = min(field.address for field in fields)
        return first, max(field.address + field.size for field in fields) - first

    def fault_names(self, status: int) -> str:
        """`hardware_error_status` in words; empty when it is 0."""
        bits = [bit for bit in range(8) if status >> bit & 1]
        return ", ".join(self.faults.get(bit, f"hardware error bit {bit}") for bit in bits)


def _field(name: str, row: Mapping[str, Any]) -> Field:
    bits, signed = 8 * row["size"], row["signed"]
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    return Field(
        name=name,
        address=row["address"],
        size=row["size"],
        signed=signed,
        writable=row["access"] == "RW",
        eeprom=row["area"] == "EEPROM",
        scale=row["scale"],
        low=low if row["min"] is None else row["min"],
        high=high if row["max"] is None else row["max"],
        initial=row["initial"] or 0,
    )
