"""Requests to Dynamixel Protocol 2.0 servos and their answers, over a `Port`.

The vendor's SDK builds what is sent on every tick (`sdk_packets`). A request that is sent again is not built again:
reads go out as they were, and of a sync write only the data and the crc are new. Single writes are built by our own
codec, because the SDK (4.1.0) stuffs a copy of a packet and then sends the original.

Answers are read from the byte stream: by id and length, so that a late or foreign reply can never be taken for another
one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.servo.chain.link import CHUNK, Answer, Found, RegisterLink
from sfms_robot.servo.chain.sdk_packets import SdkPackets2
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import STATUS, maybe_packet
from sfms_robot.servo.port import Port

_REQUESTS_KEPT: Final = 512
_WRITES_KEPT: Final = 16
_PING_S: Final = 0.0035  # what each of 253 ids may take to answer a broadcast ping, as the SDK reckons
_LENGTHS: Final = 4  # of a read of several servos, one byte apart
_HEADER: Final = b"\xff\xff\xfd"
_BODY: Final = 7  # where the instruction of a packet stands
_SYNC_DATA: Final = 12  # where the first id of a sync write stands


class Dynamixel2Link(RegisterLink):
    """One wire of Protocol 2.0 servos."""

    framing = FRAMINGS["dynamixel2"]

    def __init__(self, port: Port, baud: int, silence_s: float) -> None:
        super().__init__(port, baud, silence_s)
        self._sdk = SdkPackets2()
        self._requests: dict[tuple[object, ...], bytes] = {}
        self._writes: dict[tuple[int, int, tuple[int, ...]], _SyncWrite] = {}
        self._sent = 0
        self._extra = 0  # bytes that reads of several servos ask for beside what is wanted

    # --- one servo ----------------------------------------------------------------------------------------------

    def ping(self, servo: int) -> Found | None:
        self._send(dxl2.encode_instruction(servo, dxl2.PING))
        answer = self._answers([servo], 3).get(servo)
        return _found(answer) if answer is not None and len(answer.data) == 3 else None

    def broadcast_ping(self) -> dict[int, Found]:
        """Everybody who answers at this baud, by id; takes 253 answering times, and no more than it needs to."""
        self._send(dxl2.encode_instruction(dxl2.BROADCAST, dxl2.PING))
        everybody = range(dxl2.MAX_ID + 1)
        with self.patient(len(everybody) * _PING_S):
            answers = self._answers(everybody, 3)
        return {servo: _found(answer) for servo, answer in answers.items() if len(answer.data) == 3}

    def reboot(self, servo: int) -> Answer | None:
        self._send(dxl2.encode_instruction(servo, dxl2.REBOOT))
        return self._answer(servo, 0)

    def factory_reset(self, servo: int, option: int) -> Answer | None:
        """0xFF everything, 1 all but the id, 2 all but id and baud."""
        self._send(dxl2.encode_instruction(servo, dxl2.FACTORY_RESET, bytes([option])))
        return self._answer(servo, 0)

    def clear_turns(self, servo: int) -> Answer | None:
        """Forget whole turns: present position back into one revolution. Only at rest."""
        self._send(dxl2.encode_instruction(servo, dxl2.CLEAR, b"\x01\x44\x58\x4c\x22"))
        return self._answer(servo, 0)

    def read(self, servo: int, address: int, length: int) -> Answer | None:
        self._send(self._request(("read", servo, address, length), lambda: self._sdk.read(servo, address, length)))
        return self._answer(servo, length)

    def write(self, servo: int, address: int, data: bytes) -> Answer | None:
        """The servo's acknowledgement, or None when it did not answer."""
        self._send(dxl2.encode_instruction(servo, dxl2.WRITE, address.to_bytes(2, "little") + data))
        return self._answer(servo, 0)

    def refusal(self, answer: Answer) -> str:
        """Bits 0..6 of the error byte are an error number; bit 7 only says that register 70 is worth a look."""
        if not answer.error & ~dxl2.ALERT:
            return ""
        return dxl2.error_text(answer.error) + (", and reports a hardware error" if answer.error & dxl2.ALERT else "")

    # --- many servos --------------------------------------------------------------------------------------------

    def sync_write(self, address: int, values: Mapping[int, bytes]) -> None:
        """One packet for all servos; all values have one length. Nothing answers."""
        length = len(next(iter(values.values())))
        self.sync_write_block(address, tuple(values), length, b"".join(values.values()))

    def sync_write_block(self, address: int, servos: tuple[int, ...], length: int, data: bytes) -> None:
        """As `sync_write`, the values one behind the other."""
        key = (address, length, servos)
        write = self._writes.get(key)
        if write is None:
            if len(self._writes) >= _WRITES_KEPT:
                self._writes.clear()
            write = self._writes[key] = _SyncWrite(self._sdk.sync_write(address, length, servos), length)
        self._send(write.packet(data))

    def sync_read(self, address: int, length: int, servos: Sequence[int]) -> dict[int, Answer]:
        """Answers by id, of those that answered."""
        longer = length + self._extra
        self._send(self._read_request(address, longer, servos, fast=False))
        return self._trimmed(self._answers(servos, longer), length, len(servos))

    def fast_sync_read(self, address: int, length: int, servos: Sequence[int]) -> dict[int, Answer]:
        """As `sync_read`, but all answer in one packet, which stops where somebody is silent."""
        wanted, length = length, length + self._extra
        self._send(self._read_request(address, length, servos, fast=True))
        size = self.framing.answers(len(servos), length, fast=True)
        buffer, start = bytearray(), -1
        allowance_s = self._allowance_s()
        asked_s = self.port.now_s()
        deadline_s = asked_s + (self._sent + size) * self._byte_s + allowance_s
        last_s = deadline_s + self._rubbish_s()
        while len(buffer) < max(start, 0) + size and self.port.now_s() < last_s:
            data = self.port.read(CHUNK, min(deadline_s, last_s))
            if not data:
                break
            buffer += data
            if start < 0:
                start = buffer.find(_HEADER + b"\x00\xfe")
            if len(buffer) > dxl2.MAX_PACKET + CHUNK:
                break
            deadline_s = self.port.now_s() + allowance_s
        answers: dict[int, Answer] = {}
        for servo, error, data in dxl2.split_fast_status(buffer[max(start, 0) :], length):
            if servo in servos:
                answers[servo] = Answer(error, data)
        if len(answers) < len(servos):
            self._waited(min(allowance_s, self.port.now_s() - asked_s))
        return self._trimmed(answers, wanted, len(servos))

    # --- inside -------------------------------------------------------------------------------------------------

    def _trimmed(self, answers: dict[int, Answer], length: int, asked: int) -> dict[int, Answer]:
        """Data of `length` bytes. After a silence the next request asks for another length, so that what comes late
        is told from its answer: a status packet does not say what it answers."""
        if self._extra:
            answers = {servo: Answer(error, data[:length]) for servo, (error, data) in answers.items()}
        if len(answers) < asked:
            self._extra = (self._extra + 1) % _LENGTHS
        return answers

    def _read_request(self, address: int, length: int, servos: Sequence[int], fast: bool) -> bytes:
        return self._request(
            (address, length, fast, *servos),
            lambda: self._sdk.sync_read(address, length, servos, fast),
        )

    def _request(self, key: tuple[object, ...], build: Callable[[], bytes]) -> bytes:
        packet = self._requests.get(key)
        if packet is None:
            if len(self._requests) >= _REQUESTS_KEPT:
                self._requests.clear()
            packet = self._requests[key] = build()
        return packet

    def _send(self, packet: bytes) -> None:
        self.port.discard_input()
        self.port.write(packet)
        self._sent = len(packet)

    def _answer(self, servo: int, length: int) -> Answer | None:
        return self._answers([servo], length).get(servo)

    def _answers(self, servos: Sequence[int], length: int) -> dict[int, Answer]:
        """Status packets of `servos` with `length` bytes of data, or with an error and none.

        Waits until all are there, or nothing came for `silence_s` beyond the time that the bytes take.
        """
        port, buffer, answers = self.port, bytearray(), dict[int, Answer]()
        pending = set(servos)
        size = self.framing.answer + length
        allowance_s = self._allowance_s()
        asked_s = port.now_s()
        deadline_s = asked_s + (self._sent + size) * self._byte_s + allowance_s
        last_s = deadline_s + (len(servos) - 1) * size * self._byte_s + self._rubbish_s()
        while pending and port.now_s() < last_s:
            data = port.read(CHUNK, min(deadline_s, last_s))
            if not data:
                break
            buffer += data
            while (packet := maybe_packet(buffer)) is not None:
                servo, instruction, params, error = packet
                expected = len(params) == length or (error & 0x7F and not params)
                if instruction == STATUS and servo in pending and expected:
                    answers[servo] = Answer(error, params)
                    pending.remove(servo)
            deadline_s = port.now_s() + allowance_s
        if pending:
            self._waited(min(allowance_s, port.now_s() - asked_s))
        return answers


class _SyncWrite:
    """A sync write as the SDK built it, with data and crc to be filled in."""

    def __init__(self, blank: bytes, length: int) -> None:
        self._packet = np.frombuffer(blank, np.uint8).copy()
        self._data = self._packet[_SYNC_DATA:-2].reshape(-1, length + 1)[:, 1:]  # behind each id

    def packet(self, data: bytes) -> bytes:
        """With the values `data`, one behind the other."""
        self._data[:] = np.frombuffer(data, np.uint8).reshape(self._data.shape)
        body = self._packet[:-2].tobytes()
        if body.find(_HEADER, _BODY) < 0:
            return body + dxl2.crc16(body).to_bytes(2, "little")
        # Data that look like a header have to be stuffed: the SDK's own stuffing (4.1.0) works on a copy it drops.
        return dxl2.encode_instruction(dxl2.BROADCAST, dxl2.SYNC_WRITE, body[_BODY + 1 :])


def _found(answer: Answer) -> Found:
    """Parameters of a ping's status: model number (2 bytes, low first), firmware version."""
    return Found(int.from_bytes(answer.data[:2], "little"), answer.data[2])
