"""Requests to Dynamixel Protocol 2.0 servos and their answers, over a `Port`.

The vendor SDK builds the instruction packets, and this is the only file that knows it. Answers are not read by the
SDK, which waits at least 34 ms, spins meanwhile and stops at the first failure, but from the byte stream by our own
codec: by id and length, so that a late or foreign reply can never be taken for another one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from dynamixel_sdk import COMM_SUCCESS, GroupSyncWrite, Protocol2PacketHandler

from sfms_robot.errors import PacketError
from sfms_robot.servo.codecs.dxl2 import PING, REBOOT, STATUS, STATUS_OVERHEAD, Packet, maybe_packet
from sfms_robot.servo.port import Port

_CHUNK = 4096
_NO_PATIENCE = 10  # read deadlines that rubbish on the wire may cost before a request is given up


class _SdkPort:
    """Our port as the SDK's packet builders see one: they clear, then write."""

    def __init__(self, port: Port) -> None:
        self.is_using = False
        self.sent = 0
        self._port = port

    def clearPort(self) -> None:
        self._port.discard_input()

    def writePort(self, packet: Sequence[int]) -> int:
        data = bytes(packet)
        if data.find(b"\xff\xff\xfd", 7, len(data) - 2) >= 0:  # SDK 4.1.0 stuffs a copy and sends the original
            raise PacketError(f"{self._port.name}: the SDK cannot send data that look like a header: {data.hex(' ')}")
        self._port.write(data)
        self.sent = len(packet)
        return len(packet)

    def setPacketTimeout(self, packet_length: int) -> None:
        """The SDK sets it after each request; we have our own deadlines."""


class Dxl2Link:
    """One wire of Protocol 2.0 servos.

    Args:
        port: owned by the link from now on.
        baud: bits per second, to tell how long bytes take.
        silence_s: how long to wait for the next byte before the servo counts as silent.
    """

    def __init__(self, port: Port, baud: int, silence_s: float) -> None:
        self.port = port
        self.silence_s = silence_s
        self._byte_s = 10.0 / baud
        self._sdk_port = _SdkPort(port)
        self._sdk = Protocol2PacketHandler()
        self._writers: dict[tuple[int, int, tuple[int, ...]], GroupSyncWrite] = {}

    @contextmanager
    def patient(self, silence_s: float) -> Iterator[None]:
        """Wait at least `silence_s` for answers inside the block."""
        usual, self.silence_s = self.silence_s, max(self.silence_s, silence_s)
        try:
            yield
        finally:
            self.silence_s = usual

    def ping(self, servo: int) -> Packet | None:
        """Its answer holds model number (2) and firmware version (1)."""
        self._bare(servo, PING)
        return self._answers([servo], 3).get(servo)

    def reboot(self, servo: int) -> Packet | None:
        self._bare(servo, REBOOT)
        return self._answers([servo], 0).get(servo)

    def read(self, servo: int, address: int, length: int) -> Packet | None:
        self._sent(self._sdk.readTx(self._sdk_port, servo, address, length))
        return self._answers([servo], length).get(servo)

    def write(self, servo: int, address: int, data: bytes) -> Packet | None:
        """The servo's acknowledgement, or None when it did not answer."""
        self._sent(self._sdk.writeTxOnly(self._sdk_port, servo, address, len(data), list(data)))
        return self._answers([servo], 0).get(servo)

    def sync_write(self, address: int, values: Mapping[int, bytes]) -> None:
        """One packet for all servos; all values have one length. Nothing answers."""
        length = len(next(iter(values.values())))
        key = (address, length, tuple(values))
        group = self._writers.get(key)
        if group is None:
            group = self._writers[key] = GroupSyncWrite(self._sdk_port, self._sdk, address, length)
            for servo, data in values.items():
                group.addParam(servo, data)
        else:
            for servo, data in values.items():
                group.changeParam(servo, data)
        self._sent(group.txPacket())

    def sync_read(self, address: int, length: int, servos: Sequence[int]) -> dict[int, Packet]:
        """Answers by id, of those that answered."""
        self._sent(self._sdk.syncReadTx(self._sdk_port, address, length, servos, len(servos), False))
        return self._answers(servos, length)

    def _bare(self, servo: int, instruction: int) -> None:
        packet = [0] * 10
        packet[4], packet[5], packet[7] = servo, 3, instruction
        self._sent(self._sdk.txPacket(self._sdk_port, packet))

    def _sent(self, result: int) -> None:
        self._sdk_port.is_using = False
        if result != COMM_SUCCESS:
            raise PacketError(f"{self.port.name}: the request was not sent: {self._sdk.getTxRxResult(result)}")

    def _answers(self, servos: Sequence[int], length: int) -> dict[int, Packet]:
        """Status packets of `servos` with `length` bytes of data, or with an error and none.

        Waits until all are there, or nothing came for `silence_s` beyond the time that the bytes take.
        """
        port, buffer, answers = self.port, bytearray(), dict[int, Packet]()
        pending = set(servos)
        size = STATUS_OVERHEAD + length
        deadline_s = port.now_s() + self._sdk_port.sent * self._byte_s + self.silence_s
        last_s = deadline_s + 2 * len(servos) * size * self._byte_s + _NO_PATIENCE * self.silence_s
        while pending and port.now_s() < last_s:
            data = port.read(_CHUNK, deadline_s)
            if not data:
                break
            buffer += data
            while (packet := maybe_packet(buffer)) is not None:
                servo, instruction, params, error = packet
                expected = len(params) == length or (error & 0x7F and not params)
                if instruction == STATUS and servo in pending and expected:
                    answers[servo] = packet
                    pending.remove(servo)
            deadline_s = port.now_s() + self.silence_s
        return answers
