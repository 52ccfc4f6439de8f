"""Packets as the vendor's SDK (dynamixel_sdk) builds them. The only file of the servo layer that imports it.

The SDK builds a packet while it sends it, so it gets a port that stores the bytes. It is not used for answers: it
would wait at least 34 ms for each answer in a busy loop, and stop at the first failure. All functions raise PacketError
for packets that the SDK refuses to send.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Final

from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler, Protocol2PacketHandler

from sfms_robot.errors import PacketError

_SDK1: Final = Protocol1PacketHandler()
_SDK2: Final = Protocol2PacketHandler()
_KEPT: Final = 512  # cached requests, which are sent again unchanged


class _Draft:
    """Port for the SDK's packet builders that stores the packet they send."""

    is_using = False
    packet = b""

    def clearPort(self) -> None:
        """Do nothing; sending discards input."""

    def writePort(self, packet: Sequence[int]) -> int:
        self.packet = bytes(packet)
        return len(packet)

    def setPacketTimeout(self, packet_length: int) -> None:
        """Do nothing; the SDK calls it after each request, and links have their own deadlines."""


def instruction1(servo: int, code: int, params: bytes) -> bytes:
    """Return the packet of a request of Protocol 1.0 to one servo, or to all."""
    return _built(_SDK1.txPacket, [0, 0, servo, len(params) + 2, code, *params, 0])


@lru_cache(_KEPT)
def read2(servo: int, address: int, length: int) -> bytes:
    """Return the packet of a read of one servo of Protocol 2.0."""
    return _built(_SDK2.readTx, servo, address, length)


@lru_cache(_KEPT)
def sync_read2(address: int, length: int, servos: tuple[int, ...], fast: bool) -> bytes:
    """Return the packet of a read of several servos of Protocol 2.0."""
    return _built(_SDK2.syncReadTx, address, length, servos, len(servos), fast)


def _built(send: Callable[..., int], *arguments: Any) -> bytes:
    draft = _Draft()
    if (result := send(draft, *arguments)) != COMM_SUCCESS:
        raise PacketError(f"the request cannot be built: {_SDK2.getTxRxResult(result)}")
    return draft.packet
