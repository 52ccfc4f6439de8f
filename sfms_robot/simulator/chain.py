"""Emulated servos on one wire: bytes from the host in, bytes of the servos out. Opens nothing.

The rules of the wire: an instruction to an id that nobody has stays unanswered; only servos set to the host's baud
hear it; on a sync or bulk read each servo waits for the one before it, so behind a silent id all are silent.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from typing import Final

from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import Packet, encode_status
from sfms_robot.simulator.servo import Servo

_GAP_S: Final = 0.05  # an unfinished packet older than this is forgotten


def _word(data: bytes, offset: int = 0) -> int:
    return data[offset] | data[offset + 1] << 8


class ServoChain:
    """All servos of one wire, and what travelled on it."""

    def __init__(self, servos: Sequence[Servo]) -> None:
        self._servos = list(servos)
        self._buffer = bytearray()
        self._received_at_s = 0.0
        self._seen = hashlib.sha256()
        self.bytes_seen = 0

    def servo(self, servo_id: int) -> Servo | None:
        return next((servo for servo in self._servos if servo.id == servo_id), None)

    def digest(self) -> str:
        """SHA-256 of every byte the host ever sent, at whatever baud."""
        return self._seen.hexdigest()

    def receive(self, data: bytes, baud: int | None, now_s: float) -> bytes:
        """Take bytes that the host sent at `baud` (None = unknown) and give what the servos answer."""
        self._seen.update(data)
        self.bytes_seen += len(data)
        if now_s - self._received_at_s > _GAP_S:
            self._buffer.clear()
        self._received_at_s = now_s
        listening = {servo.id: servo for servo in self._servos if servo.baud == baud and not servo.dead}
        if not listening:
            self._buffer.clear()  # at another baud there is nothing but noise
            return b""
        self._buffer += data
        out = b""
        while (packet := dxl2.maybe_packet(self._buffer)) is not None:
            if packet.instruction != dxl2.STATUS:
                for servo in listening.values():
                    servo.feed_watchdog(now_s)
                out += b"".join(self._answers(packet, listening, now_s))
        return out

    def _answers(self, packet: Packet, listening: dict[int, Servo], now_s: float) -> Iterator[bytes]:
        code, params = packet.instruction, packet.params
        try:
            if code == dxl2.SYNC_WRITE:
                _sync_write(params, listening, now_s)
            elif code in (dxl2.SYNC_READ, dxl2.FAST_SYNC_READ):
                yield from _sync_read(code, params, listening, now_s)
            elif code == dxl2.BULK_READ:
                requests = [(params[i], _word(params, i + 1), _word(params, i + 3)) for i in range(0, len(params), 5)]
                yield from _status_each(_reads(requests, listening, now_s))
            elif code == dxl2.BULK_WRITE:
                _bulk_write(params, listening, now_s)
            elif packet.servo == dxl2.BROADCAST:
                for servo_id in sorted(listening):
                    reply = _single(listening[servo_id], code, params, now_s, broadcast=True)
                    if reply is not None:
                        yield reply
            elif (servo := listening.get(packet.servo)) is not None:
                reply = _single(servo, code, params, now_s, broadcast=False)
                if reply is not None:
                    yield reply
        except IndexError:
            return  # parameters are missing: no servo knows what was meant


def _single(servo: Servo, code: int, params: bytes, now_s: float, broadcast: bool) -> bytes | None:
    """What one servo answers to an instruction of its own, or None."""
    error, data, level = 0, b"", 2
    if code == dxl2.PING:
        (error, found), level = servo.read(0, 7, now_s), 0
        data = found[:2] + found[6:7]  # model number, firmware version
    elif code == dxl2.READ:
        if broadcast:
            return None
        (error, data), level = servo.read(_word(params), _word(params, 2), now_s), 1
    elif code == dxl2.WRITE:
        error = servo.write(_word(params), params[2:], now_s)
    elif code == dxl2.REG_WRITE:
        error = servo.register(_word(params), params[2:])
    elif code == dxl2.ACTION:
        error = servo.action(now_s)
    elif code == dxl2.REBOOT:
        reply = _status(servo, 0, b"")
        answers = servo.return_level >= 2 and not broadcast
        servo.reboot(now_s)
        return reply if answers else None
    elif code == dxl2.FACTORY_RESET:
        if broadcast and params[0] == 0xFF:  # ignored since firmware 42: all would have one id
            return None
        reply = _status(servo, 0, b"")
        answers = servo.return_level >= 2 and not broadcast
        servo.factory_reset(params[0], now_s)
        return reply if answers else None
    elif code != dxl2.CLEAR:
        error = dxl2.INSTRUCTION_ERROR
    if servo.return_level < level or (broadcast and code != dxl2.PING):
        return None
    return _status(servo, error, data)


def _status(servo: Servo, error: int, data: bytes) -> bytes:
    return encode_status(servo.id, error | (dxl2.ALERT if servo.fault_status else 0), data)


def _sync_write(params: bytes, listening: dict[int, Servo], now_s: float) -> None:
    address, length = _word(params), _word(params, 2)
    for start in range(4, len(params) - length, length + 1):
        servo = listening.get(params[start])
        if servo is not None:
            servo.write(address, params[start + 1 : start + 1 + length], now_s)


def _bulk_write(params: bytes, listening: dict[int, Servo], now_s: float) -> None:
    start = 0
    while start < len(params):
        length = _word(params, start + 3)
        servo = listening.get(params[start])
        if servo is not None:
            servo.write(_word(params, start + 1), params[start + 5 : start + 5 + length], now_s)
        start += 5 + length


def _sync_read(code: int, params: bytes, listening: dict[int, Servo], now_s: float) -> Iterator[bytes]:
    address, length = _word(params), _word(params, 2)
    answers = _reads([(servo_id, address, length) for servo_id in params[4:]], listening, now_s)
    if code == dxl2.SYNC_READ:
        yield from _status_each(answers)
        return
    alerts = [(s.id, error | (dxl2.ALERT if s.fault_status else 0), data) for s, error, data in answers]
    if alerts and len(alerts) == len(params) - 4:
        yield dxl2.encode_fast_status(alerts)


def _reads(
    requests: Sequence[tuple[int, int, int]], listening: dict[int, Servo], now_s: float
) -> Iterator[tuple[Servo, int, bytes]]:
    """(servo, error, data) in list order, up to the first id that is silent."""
    for servo_id, address, length in requests:
        servo = listening.get(servo_id)
        if servo is None or servo.return_level < 1:
            return
        error, data = servo.read(address, length, now_s)
        yield servo, error, data


def _status_each(answers: Iterator[tuple[Servo, int, bytes]]) -> Iterator[bytes]:
    for servo, error, data in answers:
        yield _status(servo, error, data)
