"""Parts of every emulated servo with a control table: a register file, a plant, a supply, and what an onlooker sees.

What its firmware makes of an instruction is the subclass's business. An indirect data register is a window: byte k of
the block shows the byte whose address stands in `indirect_address_k`. Where the block lies is the firmware map's
business (X330 servos up to firmware 52 have it elsewhere than later ones).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Final, Generic, Protocol, Self, TypeVar

from sfms_robot.emulator.device import EmulatedServo, Reply
from sfms_robot.emulator.plant import MotorCommand, Plant
from sfms_robot.servo.registers import Field, Table

_BROWN_OUT: Final = 0.7  # of the lowest supply it allows: below that the controller itself stops
_GAP_S: Final = 0.05  # an unfinished packet older than this is forgotten
_BAUD_TOLERANCE: Final = 0.03  # what a UART forgives


class RegisterFile:
    """Values by register name; raw bytes by address. Reading an absent register gives its default.

    `size`: bytes that can be read; default: the whole table and no more.
    """

    def __init__(self, table: Table, size: int | None = None) -> None:
        self.table = table
        self.raw = bytearray(table.size if size is None else size)
        self._covers: dict[tuple[int, int], tuple[Field, ...]] = {}
        fields = table.fields
        self._windows = {  # address of an indirect data byte -> address of the word that says what it shows
            field.address: fields[f"indirect_address_{name.removeprefix('indirect_data_')}"].address
            for name, field in fields.items()
            if name.startswith("indirect_data_") and f"indirect_address_{name.removeprefix('indirect_data_')}" in fields
        }
        self._first_window = min(self._windows, default=table.size)
        self._last_window = max(self._windows, default=-1)

    def get(self, name: str, default: int = 0) -> int:
        field = self.table.fields.get(name)
        return default if field is None else field.from_bytes(self.raw[field.address : field.address + field.size])

    def put(self, name: str, value: int) -> None:
        """At most what the register can show; does nothing where the model has no such register."""
        field = self.table.fields.get(name)
        if field is not None:
            self.raw[field.address : field.address + field.size] = field.to_bytes(_shown(field, value))

    def covered(self, address: int, length: int) -> tuple[Field, ...]:
        """The registers that lie, wholly or in part, in a block."""
        found = self._covers.get((address, length))
        if found is None:
            end = address + length
            found = tuple(f for f in self.table.fields.values() if f.address < end and f.address + f.size > address)
            if len(self._covers) < 1024:  # rubbish from a host must not fill the memory
                self._covers[address, length] = found
        return found

    def has_windows(self, address: int, length: int) -> bool:
        return address <= self._last_window and address + length > self._first_window

    def seen_through(self, address: int, length: int) -> Iterator[int]:
        """The addresses that the bytes of a block really are."""
        for at in range(address, address + length):
            word = self._windows.get(at)
            if word is None:
                yield at
                continue
            target = self.raw[word] | self.raw[word + 1] << 8
            yield target if target < len(self.raw) and target not in self._windows else at


def _shown(field: Field, value: int) -> int:
    """The nearest value that fits the register's size and sign rule."""
    if field.sign == "twos_complement":
        half = 1 << 8 * field.size - 1
        return min(max(value, -half), half - 1)
    if field.sign == "offset_2048":
        return min(max(value, -2048), 2047)
    bits = int(field.sign.removeprefix("sign_bit_")) if field.signed else 8 * field.size
    most = (1 << bits) - 1
    return min(max(value, -most if field.signed else 0), most)


class Frame(Protocol):
    """Position registers <-> ticks of the shaft, as the registers stand. `sign`: -1 where they count the other way."""

    sign: float

    def reported(self, shaft: float) -> float: ...

    def shaft(self, told: float) -> float: ...


class RegisterServo(ABC):
    """A servo that answers instructions. All times are seconds of the wire's clock.

    Attributes:
        dead: silent, as with its cable out; its motor keeps doing what it was told.
        mute: it obeys, and never answers.
        fault_status: bits of what is wrong with it.
        plant: what turns; its ticks are those of the shaft.
    """

    id: int
    baud: int | None
    supply_v: float
    _frame: Frame
    _bits: dict[str, int]  # of `fault_status`, by the name of the fault

    def __init__(self, table: Table, size: int | None = None) -> None:
        self.table = table
        self.dead = self.mute = False
        self.fault_status = 0
        self.plant = Plant(0.0)
        self._file = RegisterFile(table, size)
        self._get, self._put = self._file.get, self._file.put
        self._drive: MotorCommand | None = None
        self._powered = True

    def _take_stored(self, what: EmulatedServo) -> None:
        """What somebody has stored in it before."""
        self._put_role("id", what.id)
        self._put_role("baud_rate", next(code for code, rate in self.table.baud_codes.items() if rate == what.baud))
        for name, value in what.registers.items():
            self._put(name, value)

    # --- what happens to it -------------------------------------------------------------------------------------

    @abstractmethod
    def advance(self, now_s: float) -> None:
        """Move the plant on, and see what that did to it."""

    @abstractmethod
    def fail(self, status: int, now_s: float) -> None:
        """Faults, as bits of `fault_status`; those it is told to give way to take the torque away."""

    def fail_named(self, fault: str, now_s: float) -> None:
        """The same by name: overheating, overload."""
        self.fail(self._bits[fault], now_s)

    def set_supply(self, volts: float, now_s: float) -> None:
        """Too low stops the controller; when it comes back the servo starts anew."""
        self.advance(now_s)
        self.supply_v = volts
        was_powered, self._powered = self._powered, volts >= _BROWN_OUT * self._volts("min_voltage_limit")
        if not self._powered:
            self._lose_power()
        elif not was_powered:
            self._start_anew(now_s)
        self._watch_supply()

    @abstractmethod
    def _lose_power(self) -> None:
        """The controller stops."""

    @abstractmethod
    def _start_anew(self, now_s: float) -> None:
        """The supply is back."""

    @abstractmethod
    def _watch_supply(self) -> None:
        """See whether the supply is within the servo's limits."""

    def turn(self, ticks: float, now_s: float) -> None:
        """Somebody turns the shaft by hand, to where its position reads `ticks`."""
        self.advance(now_s)
        self.plant.position = self._frame.shaft(ticks)

    def state(self, now_s: float) -> dict[str, Any]:
        """What an onlooker sees, whatever the wire says."""
        self.advance(now_s)
        return {
            "position": self._frame.reported(self.plant.position),
            "speed": self._frame.sign * self.plant.speed,
            "goal": self._get("goal_position"),
            "torque": self._powered and self._role("torque_enable") == 1,
            "faults": self._fault_names(),
            "temperature_C": self.plant.temperature_C,
        }

    @abstractmethod
    def _fault_names(self) -> str:
        """`fault_status` in words."""

    # --- registers ----------------------------------------------------------------------------------------------

    def _volts(self, name: str) -> float:
        return self.table[name].to_unit(self._get(name))

    def _role(self, role: str) -> int:
        """Value of a role's register; a role that the model does not have reads as 1: it limits nothing."""
        field = self.table.role(role)
        return 1 if field is None else self._get(field.name)

    def _put_role(self, role: str, value: int) -> None:
        field = self.table.role(role)
        if field is not None:
            self._put(field.name, value)


# --- all servos of one wire that speak one protocol -----------------------------------------------------------------


S = TypeVar("S", bound=RegisterServo)


class ServoChain(ABC, Generic[S]):
    """Implements `device.Device`: all emulated servos of one wire that speak one protocol.

    Opens nothing. An instruction to an id that no servo has stays unanswered, and only servos set to the host's baud
    rate hear it. Where several are asked at once each waits for the one before it: behind a silent id all are silent
    (`chain_break`), or the chain goes on without it. What a packet means is the subclass's business.
    """

    _servo_class: ClassVar[Any]

    def __init__(self, servos: Sequence[S], chain_break: bool = True) -> None:
        self.servos = list(servos)
        self.chain_break = chain_break
        self._buffer = bytearray()
        self._received_at_s = 0.0

    @classmethod
    def of(cls, servos: Sequence[EmulatedServo], tables: Mapping[str, Table], chain_break: bool = True) -> Self:
        """Of what is plugged in; `tables` by model."""
        return cls([cls._servo_class(servo, tables[servo.model]) for servo in servos], chain_break)

    def servo(self, servo_id: int) -> S | None:
        return next((servo for servo in self.servos if servo.id == servo_id), None)

    def advance(self, now_s: float) -> None:
        for servo in self.servos:
            servo.advance(now_s)

    def receive(self, data: bytes, baud: int | None, now_s: float) -> bytes:
        """Take bytes that the host sent at `baud` (None = unknown) and give what the servos answer."""
        return b"".join(reply.data for reply in self.replies(data, baud, now_s))

    def replies(self, data: bytes, baud: int | None, now_s: float) -> list[Reply]:
        """The same, packet by packet."""
        if now_s - self._received_at_s > _GAP_S:
            self._buffer.clear()
        self._received_at_s = now_s
        self._buffer += data
        return self._obey_all(baud, now_s)

    @abstractmethod
    def _obey_all(self, baud: int | None, now_s: float) -> list[Reply]:
        """What is answered to the whole packets in the buffer, which are taken out of it."""


def same_baud(servo: int | None, host: int | None) -> bool:
    """Whether a servo understands a host."""
    return servo is not None and host is not None and abs(servo - host) <= _BAUD_TOLERANCE * servo
