"""A firmware map ready for use: registers by name or by role, values to bytes and back.

`Table` is plain data, so that an emulated servo in another process needs neither the loader nor its libraries.

The *value* of a register is the number that the control loop uses; its *raw* form is sent. There are four rules to
convert them: unsigned, two's complement, a sign bit above the magnitude, and an offset (2048 stands for zero).
Registers of two and four bytes are sent in the byte order of the model: low byte first, but high byte first in the
Feetech SCS.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

if TYPE_CHECKING:
    from sfms_robot.config import FirmwareMap

ASSUMED_SPEED_DEG_S = 300.0  # no-load speed if the manufacturer states none; only emulated motors need it
ByteOrder = Literal["little", "big"]

Values = Mapping[str, int]  # values of registers, by name

_PER_TURN: Final = {"rpm": 60.0, "rev_per_min2": 3600.0}  # s, s^2; all other units are in degrees
_ACCELERATIONS: Final = ("profile_acceleration", "goal_acceleration", "acceleration")
_FROM_ROW: Final = {"address", "size", "access", "area", "unit", "scale", "low", "high", "signed"}


class Field(NamedTuple):
    """A register, from its row of the map. `low`..`high`: values that may be written; `signed`: its sign rule."""

    name: str
    address: int
    size: int
    access: str  # R or RW
    area: str  # EEPROM or RAM
    unit: str
    scale: float
    low: int
    high: int
    signed: str
    initial: int
    byte_order: ByteOrder

    @property
    def writable(self) -> bool:
        return self.access == "RW"

    @property
    def eeprom(self) -> bool:
        return self.area == "EEPROM"

    @property
    def sign_bit(self) -> int:
        """Return the weight of the sign bit above the magnitude; 0 for a register with another rule."""
        return 1 << int(self.signed[9:]) if self.signed.startswith("sign_bit_") else 0

    def to_bytes(self, value: int) -> bytes:
        """Return the raw form. Raises OverflowError if `value` does not fit the size and sign rule of the register."""
        raw = value
        if self.signed == "offset_2048":
            raw = value + 2048
        elif bit := self.sign_bit:
            if abs(value) >= bit:
                raise OverflowError(f"{self.name} = {value} does not fit below its sign bit ({1 - bit}..{bit - 1})")
            raw = bit - value if value < 0 else value
        return raw.to_bytes(self.size, self.byte_order, signed=self.signed == "twos_complement")

    def from_bytes(self, data: bytes | bytearray) -> int:
        """Return the value of the first `size` bytes."""
        raw = int.from_bytes(data[: self.size], self.byte_order, signed=self.signed == "twos_complement")
        if self.signed == "offset_2048":
            return raw - 2048
        if bit := self.sign_bit:
            return -(raw & bit - 1) if raw & bit else raw & bit - 1
        return raw

    def to_unit(self, value: int) -> float:
        """Return a value in the unit of the firmware map."""
        return value * self.scale


@dataclass(frozen=True, kw_only=True)
class Table:
    """The control table of a servo model, or the channels of a servo board (which has no fields).

    Attributes:
        model_number: None if it is not known.
        fields: registers by name.
        ticks_per_revolution: position ticks of one turn.
        top_speed_ticks_s: no-load speed; from `ASSUMED_SPEED_DEG_S` if the manufacturer states none.
        baud_codes: code in role `baud_rate` -> bits per second; empty if the rate is not a register.
        faults: bit of role `error_status` (on a board: of the error word) -> its meaning.
        family: dynamixel, feetech, maestro or ssc32.
        protocol: 1, 2, or None for a board.
        status_faults: bit of the error byte of a status packet -> fault of the servo (protocol 1, Feetech).
        roles: role -> register name, if they differ; None if the model has no such register.
        watchdog: reaction of the servo when its host falls silent: stops, flags_only or none.
        position_mode: value of role `operating_mode` for position control.
        firmware: first and last firmware number for which the table is valid.
        channels, pulse_us, tick_us: for a board: number of outputs, (shortest, longest) pulse, pulse width of one tick.
    """

    model: str
    model_number: int | None
    fields: Mapping[str, Field]
    ticks_per_revolution: float
    center_ticks: int
    top_speed_ticks_s: float
    baud_codes: Mapping[int, int]
    faults: Mapping[int, str]
    family: str
    protocol: int | None
    byte_order: ByteOrder
    status_faults: Mapping[int, str]
    roles: Mapping[str, str | None]
    watchdog: str
    position_mode: int | None
    firmware: tuple[int, int]
    channels: int | None
    pulse_us: tuple[float, float] | None
    tick_us: float | None

    @classmethod
    def of(cls, firmware_map: FirmwareMap) -> Table:
        """Return the table of a firmware map."""
        speed, pulse = firmware_map.no_load_speed_deg_s or ASSUMED_SPEED_DEG_S, firmware_map.pulse_us
        unchanged = firmware_map.model_dump(include=set(cls.__dataclass_fields__))
        converted = {
            "fields": {
                name: Field(
                    name=name,
                    byte_order=firmware_map.byte_order,
                    initial=row.initial or 0,
                    **row.model_dump(include=_FROM_ROW),
                )
                for name, row in firmware_map.registers.items()
            },
            "top_speed_ticks_s": speed * (firmware_map.ticks_per_revolution / 360.0),
            "firmware": (firmware_map.firmware.min, firmware_map.firmware.max),
            "pulse_us": (pulse.min, pulse.max) if pulse else None,
        }
        return cls(**unchanged | converted)

    def __getitem__(self, name: str) -> Field:
        return self.fields[name]

    def role(self, role: str) -> Field | None:
        """Return the register that plays `role` in this family; None if the model has none."""
        name = self.roles.get(role, role)
        return self.fields.get(name) if name is not None else None

    @property
    def acceleration(self) -> Field | None:
        """Return the register that limits the acceleration on the way to a goal; None if the model has none."""
        return next((self.fields[name] for name in _ACCELERATIONS if name in self.fields), None)

    def in_ticks(self, field: Field, value: int = 1) -> float:
        """Return the value of a speed or acceleration register in units of ticks and seconds."""
        return field.to_unit(value) * self.ticks_per_revolution / _PER_TURN.get(field.unit, 360.0)

    @property
    def size(self) -> int:
        """Return the number of bytes of the whole table."""
        return max((each.address + each.size for each in self.fields.values()), default=0)

    @property
    def default_baud(self) -> int | None:
        """Return the factory rate in bits per second; None if it is not known."""
        code = self.role("baud_rate")
        return self.baud_codes.get(code.initial) if code else None

    @property
    def servo_faults(self) -> Mapping[int, str]:
        """Return bit -> fault, for status packets (protocol 1), else for role `error_status` or the error word."""
        return self.status_faults if self.protocol == 1 else self.faults

    def faults_in(self, status: int) -> list[str]:
        """Return the faults in a value whose bits are those of `servo_faults`, in words.

        Other bits of a status packet concern the request and are left out.
        """
        names, bits = self.servo_faults, [bit for bit in range(16) if status >> bit & 1]
        return [names.get(bit, f"hardware error bit {bit}") for bit in bits if bit in names or self.protocol != 1]


def consecutive(numbers: Iterable[int]) -> list[list[int]]:
    """Return the runs of neighbouring numbers, in order."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return runs


def span_of(fields: Sequence[Field]) -> tuple[int, int]:
    """Return (address, length) of the block that holds all of `fields`."""
    first = min(each.address for each in fields)
    return first, max(each.address + each.size for each in fields) - first
