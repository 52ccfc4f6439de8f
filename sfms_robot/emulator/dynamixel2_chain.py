"""Emulated Protocol 2.0 servos on one wire: bytes from the host in, packets of the servos out. Opens nothing.

The rules of the wire: an instruction to an id that nobody has stays unanswered; only servos set to the host's baud
hear it; on a sync or bulk read each servo waits for the one before it, so behind a silent id all are silent
(`chain_break`; without it those behind it answer all the same). Two servos with one id talk over
one another.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, Self

from sfms_robot.emulator.device import Reply
from sfms_robot.emulator.dynamixel2_servo import Dynamixel2Servo
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import Packet, encode_status
from sfms_robot.servo.registers import Table

FAST_BULK_READ: Final = 0x9A
_GAP_S: Final = 0.05  # an unfinished packet older than this is forgotten
_SLOT_S: Final = 0.003  # a broadcast ping is answered in the order of ids, each in its own slot
_BAUD_TOLERANCE: Final = 0.03  # what a UART forgives
_FAST_FIRMWARE: Final = 45  # from here on a servo knows fast reads
Request = tuple[int, int, int]  # id, address, length


class Listening(NamedTuple):
    """Who hears the host: by their own id, and by the second one that some have."""

    own: dict[int, list[Dynamixel2Servo]]
    second: dict[int, list[Dynamixel2Servo]]

    def addressed(self, servo_id: int) -> list[Dynamixel2Servo]:
        """All that obey `servo_id`."""
        there = self.own.get(servo_id, [])
        return there + self.second[servo_id] if servo_id in self.second else there


class Dynamixel2Chain:
    """All Protocol 2.0 servos of one wire."""

    def __init__(self, servos: Sequence[Dynamixel2Servo], chain_break: bool = True) -> None:
        self._servos = list(servos)
        self._chain_break = chain_break
        self._buffer = bytearray()
        self._received_at_s = 0.0

    @classmethod
    def from_rows(
        cls, rows: Sequence[Mapping[str, Any]], tables: Mapping[str, Table], chain_break: bool = True
    ) -> Self:
        """From the plain rows of a description; `tables` by model."""
        return cls(
            [
                Dynamixel2Servo(
                    row["id"],
                    tables[row["model"]],
                    row["baud"],
                    row["start_ticks"],
                    row["firmware"],
                    row["registers"],
                    row["supply_v"],
                )
                for row in rows
            ],
            chain_break,
        )

    def servo(self, servo_id: int) -> Dynamixel2Servo | None:
        return next((servo for servo in self._servos if servo.id == servo_id), None)

    @property
    def servos(self) -> Sequence[Dynamixel2Servo]:
        return self._servos

    def advance(self, now_s: float) -> None:
        for servo in self._servos:
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
        out: list[Reply] = []
        while (packet := dxl2.maybe_packet(self._buffer)) is not None:
            if packet.instruction == dxl2.STATUS:
                continue
            listening = self._listening(baud, now_s)
            if listening.own:
                out += self._answers(packet, listening, now_s)
            else:
                self._buffer.clear()  # at another baud there is nothing but noise
        return out

    def _listening(self, baud: int | None, now_s: float) -> Listening:
        """Those who hear a packet; hearing one feeds their watchdog."""
        own: dict[int, list[Dynamixel2Servo]] = {}
        second: dict[int, list[Dynamixel2Servo]] = {}
        for servo in self._servos:
            if _same(servo.baud, baud) and servo.hears(now_s):
                servo.feed_watchdog(now_s)
                own.setdefault(servo.id, []).append(servo)
                if servo.second_id is not None and servo.second_id != servo.id:
                    second.setdefault(servo.second_id, []).append(servo)
        return Listening(own, second)

    def _answers(self, packet: Packet, listening: Listening, now_s: float) -> Iterator[Reply]:
        code, params = packet.instruction, packet.params
        try:
            if code == dxl2.SYNC_WRITE:
                _sync_write(params, listening, now_s)
            elif code == dxl2.BULK_WRITE:
                _bulk_write(params, listening, now_s)
            elif code in (dxl2.SYNC_READ, dxl2.FAST_SYNC_READ):
                address, length = _word(params), _word(params, 2)
                requests = [(servo_id, address, length) for servo_id in params[4:]]
                yield from self._reads(requests, code == dxl2.FAST_SYNC_READ, listening, now_s)
            elif code in (dxl2.BULK_READ, FAST_BULK_READ):
                requests = [(params[i], _word(params, i + 1), _word(params, i + 3)) for i in range(0, len(params), 5)]
                yield from self._reads(requests, code == FAST_BULK_READ, listening, now_s)
            elif packet.servo == dxl2.BROADCAST:
                yield from _broadcast(code, params, listening, now_s)
            else:
                yield from _addressed(packet, listening, now_s)
        except IndexError:
            return  # parameters are missing: no servo knows what was meant

    def _reads(self, requests: Sequence[Request], fast: bool, listening: Listening, now_s: float) -> Iterator[Reply]:
        """Status packets in list order, up to the first id that is silent (unless the chain skips it)."""
        parts: list[tuple[Dynamixel2Servo, int, bytes]] = []
        for servo_id, address, length in requests:
            there = [s for s in listening.own.get(servo_id, ()) if s.return_level >= 1 and not (fast and _is_old(s))]
            if not there:
                if not self._chain_break and not fast:
                    continue
                break
            answers = [(servo, *servo.read(address, length, now_s)) for servo in there]
            if fast:
                parts.append(answers[0])
            else:
                packets = [_status(servo, error, data, servo_id) for servo, error, data in answers]
                yield Reply((servo_id,), _collided(packets), there[0].return_delay_s)
        lengths = [length for _, _, length in requests]
        if fast and parts and sum(lengths) + 4 * len(lengths) < dxl2.MAX_PACKET:
            servos = [servo for servo, _, _ in parts]
            pause_s = sum(servo.return_delay_s for servo in servos)
            yield Reply(tuple(servo.id for servo in servos), _fast(parts, lengths), pause_s)


def _word(data: bytes, offset: int = 0) -> int:
    return data[offset] | data[offset + 1] << 8


def _same(baud: int | None, host: int | None) -> bool:
    return baud is not None and host is not None and abs(baud - host) <= _BAUD_TOLERANCE * baud


def _is_old(servo: Dynamixel2Servo) -> bool:
    return servo.firmware < _FAST_FIRMWARE or "operating_mode" not in servo.table.fields


def _broadcast(code: int, params: bytes, listening: Listening, now_s: float) -> Iterator[Reply]:
    last = 0
    for servo_id in sorted(listening.own):
        there = listening.own[servo_id]
        answers = [_single(servo, code, params, now_s, broadcast=True) for servo in there]
        packets = [answer for answer in answers if answer is not None]
        if packets:
            pause_s = there[0].return_delay_s + _SLOT_S * (servo_id - last)
            last = servo_id
            yield Reply((servo_id,), _collided(packets), pause_s)


def _addressed(packet: Packet, listening: Listening, now_s: float) -> Iterator[Reply]:
    """One id: those whose own it is answer, those whose second id it is obey in silence."""
    servo_id, code, params = packet.servo, packet.instruction, packet.params
    for servo in listening.second.get(servo_id, ()):
        _single(servo, code, params, now_s, broadcast=False)
    there = listening.own.get(servo_id, [])
    pause_s = max((servo.return_delay_s for servo in there), default=0.0)
    answers = [_single(servo, code, params, now_s, broadcast=False) for servo in there]
    packets = [answer for answer in answers if answer is not None]
    if packets:
        yield Reply((servo_id,), _collided(packets), pause_s)


def _collided(packets: Sequence[bytes]) -> bytes:
    """What a wire carries when several talk at once: low wins."""
    if len(packets) == 1:
        return packets[0]
    length = max(len(packet) for packet in packets)
    out = bytearray(b"\xff" * length)
    for packet in packets:
        for at, byte in enumerate(packet):
            out[at] &= byte
    return bytes(out)


def _single(servo: Dynamixel2Servo, code: int, params: bytes, now_s: float, broadcast: bool) -> bytes | None:
    """What one servo answers to an instruction of its own, or None."""
    error, data, level, servo_id = 0, b"", 2, servo.id  # it still answers by the id it is just losing
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
        reply = _status(servo, 0, b"", servo_id)
        answers = servo.return_level >= 2 and not broadcast
        servo.reboot(now_s)
        return reply if answers else None
    elif code == dxl2.FACTORY_RESET:
        if broadcast and params[0] == 0xFF:  # ignored since firmware 42: all would have one id
            return None
        reply = _status(servo, 0, b"", servo_id)
        answers = servo.return_level >= 2 and not broadcast
        servo.factory_reset(params[0], now_s)
        return reply if answers else None
    elif code == dxl2.CLEAR:
        error = servo.clear(params, now_s)
    else:
        error = dxl2.INSTRUCTION_ERROR
    if servo.return_level < level or (broadcast and code != dxl2.PING):
        return None
    return _status(servo, error, data, servo_id)


def _status(servo: Dynamixel2Servo, error: int, data: bytes, servo_id: int) -> bytes:
    return encode_status(servo_id, error | (dxl2.ALERT if servo.fault_status else 0), data)


def _sync_write(params: bytes, listening: Listening, now_s: float) -> None:
    address, length = _word(params), _word(params, 2)
    for start in range(4, len(params) - length, length + 1):
        for servo in listening.addressed(params[start]):
            servo.write(address, params[start + 1 : start + 1 + length], now_s)


def _bulk_write(params: bytes, listening: Listening, now_s: float) -> None:
    start = 0
    while start < len(params):
        length = _word(params, start + 3)
        for servo in listening.addressed(params[start]):
            servo.write(_word(params, start + 1), params[start + 5 : start + 5 + length], now_s)
        start += 5 + length


def _fast(parts: Sequence[tuple[Dynamixel2Servo, int, bytes]], lengths: Sequence[int]) -> bytes:
    """The one packet of a fast read. It is announced whole, and stops short at the first servo that is silent."""
    out = bytearray(b"\xff\xff\xfd\x00\xfe" + (1 + sum(lengths) + 4 * len(lengths)).to_bytes(2, "little"))
    out.append(dxl2.STATUS)
    for (servo, error, data), length in zip(parts, lengths, strict=False):
        out += bytes([error | (dxl2.ALERT if servo.fault_status else 0), servo.id]) + (data or bytes(length))
        out += dxl2.crc16(out).to_bytes(2, "little")
    return bytes(out)
