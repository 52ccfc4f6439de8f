"""All emulated servos of one wire that speak one protocol: bytes from the host in, packets of the servos out.

Opens nothing. An instruction to an id that nobody has stays unanswered, and only servos set to the host's baud rate
hear it. Where several are asked at once each waits for the one before it: behind a silent id all are silent
(`chain_break`), or the chain goes on without it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, Generic, Self, TypeVar

from sfms_robot.emulator.device import EmulatedServo, Reply
from sfms_robot.emulator.register_servo import RegisterServo
from sfms_robot.servo.registers import Table

_GAP_S: Final = 0.05  # an unfinished packet older than this is forgotten
_BAUD_TOLERANCE: Final = 0.03  # what a UART forgives

S = TypeVar("S", bound=RegisterServo)


class ServoChain(ABC, Generic[S]):
    """Implements `device.Device`. What a packet means is the subclass's business."""

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
