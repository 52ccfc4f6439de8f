"""Registers over a wire, whatever the protocol: what tools and handshakes need of a link.

A link asks one servo at a time and says None where nobody answered; the error byte of an answer is the protocol's own.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol

from sfms_robot.servo.port import Port


class Found(NamedTuple):
    """Who answered a ping. None where the protocol's ping does not tell."""

    model_number: int | None
    firmware: int | None


class Answer(NamedTuple):
    """One servo's answer: the error byte as it came, and the data read (empty for a write)."""

    error: int
    data: bytes


class RegisterLink(Protocol):
    """One wire of servos that have registers. Raises BusError when the port is gone, never for a silent servo."""

    @property
    def port(self) -> Port: ...

    def ping(self, servo: int) -> Found | None: ...

    def broadcast_ping(self) -> dict[int, Found]:
        """Everybody who answers at this baud, by id; waits the whole window that 253 answers may take."""

    def read(self, servo: int, address: int, length: int) -> Answer | None: ...

    def write(self, servo: int, address: int, data: bytes) -> Answer | None:
        """The acknowledgement, or None when there was none: the servo may have taken it all the same."""

    def reboot(self, servo: int) -> Answer | None: ...

    def factory_reset(self, servo: int, option: int) -> Answer | None:
        """Protocol 2.0: 0xFF everything, 1 all but the id, 2 all but id and baud. Others ignore `option`."""

    def sync_write(self, address: int, values: Mapping[int, bytes]) -> None:
        """One packet for all; values have one length. Nothing answers."""

    def patient(self, silence_s: float) -> AbstractContextManager[None]:
        """Wait at least `silence_s` for answers inside the block."""
