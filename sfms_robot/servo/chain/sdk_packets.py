"""Packets as the vendor's SDK (dynamixel_sdk) builds them. The only file of the servo layer that knows it.

The SDK builds a packet while it sends it, so it is given a port that keeps what it is sent. It reads no answers: it
would wait at least 34 ms for each, spin meanwhile and stop at the first failure.
"""

from __future__ import annotations

from collections.abc import Sequence

from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler, Protocol2PacketHandler

from sfms_robot.errors import PacketError


class _Draft:
    """A port as the SDK's packet builders see one: what they send is kept instead."""

    def __init__(self) -> None:
        self.is_using = False
        self.packet = b""

    def clearPort(self) -> None:
        """Sending does that."""

    def writePort(self, packet: Sequence[int]) -> int:
        self.packet = bytes(packet)
        return len(packet)

    def setPacketTimeout(self, packet_length: int) -> None:
        """The SDK sets it after each request; links have their own deadlines."""


class SdkPackets1:
    """Protocol 1.0. Raises PacketError for what the SDK refuses to send."""

    def __init__(self) -> None:
        self._sdk = Protocol1PacketHandler()

    def instruction(self, servo: int, code: int, params: bytes) -> bytes:
        draft = _Draft()
        result = self._sdk.txPacket(draft, [0, 0, servo, len(params) + 2, code, *params, 0])
        return _built(self._sdk, draft, result)


class SdkPackets2:
    """Protocol 2.0. Raises PacketError for what the SDK refuses to send."""

    def __init__(self) -> None:
        self._sdk = Protocol2PacketHandler()

    def read(self, servo: int, address: int, length: int) -> bytes:
        draft = _Draft()
        return _built(self._sdk, draft, self._sdk.readTx(draft, servo, address, length))

    def sync_read(self, address: int, length: int, servos: Sequence[int], fast: bool) -> bytes:
        draft = _Draft()
        return _built(self._sdk, draft, self._sdk.syncReadTx(draft, address, length, servos, len(servos), fast))

    def sync_write(self, address: int, length: int, servos: Sequence[int]) -> bytes:
        """With zeros for the data of every servo."""
        draft, blank = _Draft(), [byte for servo in servos for byte in (servo, *[0] * length)]
        return _built(self._sdk, draft, self._sdk.syncWriteTxOnly(draft, address, length, blank, len(blank)))


def _built(sdk: Protocol1PacketHandler | Protocol2PacketHandler, draft: _Draft, result: int) -> bytes:
    if result != COMM_SUCCESS:
        raise PacketError(f"the request cannot be built: {sdk.getTxRxResult(result)}")
    return draft.packet
