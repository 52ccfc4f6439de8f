"""Two servos with one id: they answer together, so a ping brings two answers, or bytes that are none.

A link drops what is no packet and takes the first that fits, as it should. Here the bytes of one ping are looked at
instead. Two servos of one model that answer in the very same instant look like one: only a wire with a single servo
on it tells for certain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from sfms_robot.servo.codecs import dxl2, protocol1
from sfms_robot.servo.port import Port

_CHUNK: Final = 4096
_LONGEST: Final = 64  # reads after which a wire that never falls silent is left alone


@dataclass(frozen=True)
class PingReplies:
    """What one ping brought: whole answers of that id, and bytes that belong to no answer."""

    answers: int
    stray: int

    @property
    def duplicate(self) -> bool:
        """Whether this looks like two servos."""
        return self.answers > 1 or self.stray > 0


def ping_replies(port: Port, protocol: int, servo: int, silence_s: float) -> PingReplies:
    """Ping one id and listen until nothing came for `silence_s`. `protocol` is 2, or 1 (Feetech too)."""
    request, count = _PINGS[protocol]
    port.discard_input()
    sent = request(servo)
    port.write(sent)
    data = bytearray()
    for _ in range(_LONGEST):
        part = port.read(_CHUNK, port.now_s() + silence_s)
        if not part:
            break
        data += part
    if data.startswith(sent):  # an adapter that hears itself
        del data[: len(sent)]
    return count(servo, data)


def _dynamixel2_replies(servo: int, data: bytearray) -> PingReplies:
    total, answers, known = len(data), 0, 0
    while (packet := dxl2.maybe_packet(data)) is not None:
        if packet.instruction == dxl2.STATUS:
            known += dxl2.STATUS_OVERHEAD + len(packet.params)
            answers += packet.servo == servo
    return PingReplies(answers, total - known)


def _protocol1_replies(servo: int, data: bytearray) -> PingReplies:
    total, answers, known = len(data), 0, 0
    for frame in protocol1.salvage(data):
        known += protocol1.OVERHEAD + len(frame.params)
        answers += frame.servo == servo
    return PingReplies(answers, total - known)


_PINGS: Final[Mapping[int, tuple[Callable[[int], bytes], Callable[[int, bytearray], PingReplies]]]] = {
    2: (lambda servo: dxl2.encode_instruction(servo, dxl2.PING), _dynamixel2_replies),
    1: (lambda servo: protocol1.encode(servo, protocol1.PING), _protocol1_replies),
}
