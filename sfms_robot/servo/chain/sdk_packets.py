"""Packets as the vendor's SDK (dynamixel_sdk) builds them. The only file of the servo layer that imports it.

The SDK builds a packet while it sends it, so it is given a port that keeps the bytes. It is not used for answers: it
would wait at least 34 ms for each, spin meanwhile and stop at the first failure.
"""

from __future__ import annotations

from collections.abc import Sequence

from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler, Protocol2PacketHandler

from sfms_robot.errors import PacketError


class _Draft:
    """A port, as the SDK's packet builders use one, that keeps what they send."""

    def __init__(self) -> None:
        self.is_using = False
        self.packet = b""

    def clearPort(self) -> None:
        """Do nothing; sending discards input."""

    def writePort(self, packet: Sequence[int]) -> int:
        self.packet = bytes(packet)
        return len(packet)

    def setPacketTimeout(self, packet_length: int) -> None:
        """Do nothing; the SDK calls it after each request, and links have their own deadlines."""


class SdkPackets1:
    """Packets of Protocol 1.0. Raises PacketError for what the SDK refuses to send."""

    def __init__(self) -> None:
        self._sdk = Protocol1PacketHandler()

    def instruction(self, servo: int, code: int, params: bytes) -> bytes:
        """Return a request to one servo, or to all."""
        draft = _Draft()
        result = self._sdk.txPacket(draft, [0, 0, servo, len(params) + 2, code, *params, 0])
        return _built(self._sdk, draft, result)


class SdkPackets2:
    """Packets of Protocol 2.0. Raises PacketError for what the SDK refuses to send."""

    def __init__(self) -> None:
        self._sdk = Protocol2PacketHandler()

    def read(self, servo: int, address: int, length: int) -> bytes:
        """Return a read of one servo."""
        draft = _Draft()
        return _built(self._sdk, draft, self._sdk.readTx(draft, servo, address, length))

    def sync_read(self, address: int, length: int, servos: Sequence[int], fast: bool) -> bytes:
        """Return a read of several servos."""
        draft = _Draft()
        return _built(self._sdk, draft, self._sdk.syncReadTx(draft, address, length, servos, len(servos), fast))

    def sync_write(self, address: int, length: int, servos: Sequence[int]) -> bytes:
        """Return a write to several servos, with zeros for the data of each."""
        draft, blank = _Draft(), [byte for servo in servos for byte in (servo, *[0] * length)]
        return _built(self._sdk, draft, self._sdk.syncWriteTxOnly(draft, address, length, blank, len(blank)))


def _built(sdk: Protocol1PacketHandler | Protocol2PacketHandler, draft: _Draft, result: int) -> bytes:
    if result != COMM_SUCCESS:
        raise PacketError(f"the request cannot be built: {sdk.getTxRxResult(result)}")
    return draft.packet
