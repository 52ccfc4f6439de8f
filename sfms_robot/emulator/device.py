"""What hangs on an emulated wire: something that hears bytes and answers in packets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol


class Reply(NamedTuple):
    """One packet on the wire: who sends it, and how long the line is quiet before."""

    servos: tuple[int, ...]
    data: bytes
    pause_s: float = 0.0


class Device(Protocol):
    """All that is plugged in of one protocol, or one board. It hears every byte of the wire and keeps its own place.

    It may also have `replies(data, baud, now_s)`, a sequence of `Reply` or of packets, which `receive` joins: with it
    the wire knows who says what, and when.
    """

    def receive(self, data: bytes, baud: int | None, now_s: float) -> bytes: ...

    def servo(self, servo_id: int) -> Any:
        """The servo or channel of that id, or None."""

    def advance(self, now_s: float) -> None:
        """Move everything on to `now_s`."""


def servos_of(device: Device) -> Iterator[Any]:
    """Every servo or channel of a device."""
    for servo_id in range(256):
        servo = device.servo(servo_id)
        if servo is not None:
            yield servo


def replies_of(device: Device, data: bytes, baud: int | None, now_s: float) -> Sequence[Reply]:
    """What a device answers, packet by packet as far as it tells them apart."""
    replies = getattr(device, "replies", None)
    if replies is None:
        answer = device.receive(data, baud, now_s)
        return [Reply((), answer)] if answer else ()
    return [each if isinstance(each, Reply) else _reply(device, each) for each in replies(data, baud, now_s)]


def _reply(device: Device, frame: bytes) -> Reply:
    """A frame `FF FF | id | ...` says itself who sends it."""
    if len(frame) < 3:
        return Reply((), frame)
    return Reply((frame[2],), frame, getattr(device.servo(frame[2]), "return_delay_s", 0.0))
