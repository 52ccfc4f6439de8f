"""Emulated Protocol 2.0 servos on one wire.

The rules of the wire, beside those of `ServoChain`: on a sync or bulk read each servo waits for the one before it, and
two servos with one id talk over one another.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from sfms_robot.emulator.device import Reply
from sfms_robot.emulator.dynamixel2_servo import Dynamixel2Servo
from sfms_robot.emulator.register_servo import ServoChain, same_baud
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import Packet, encode_status

FAST_BULK_READ: Final = 0x9A
_SLOT_S: Final = 0.003  # a broadcast ping is answered in the order of ids, each in its own slot
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


class Dynamixel2Chain(ServoChain[Dynamixel2Servo]):
    """All Protocol 2.0 servos of one wire."""

    _servo_class = Dynamixel2Servo

    def _obey_all(self, baud: int | None, now_s: float) -> list[Reply]:
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
        for servo in self.servos:
            if same_baud(servo.baud, baud) and servo.hears(now_s):
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
                if not self.chain_break and not fast:
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


def _is_old(servo: Dynamixel2Servo) -> bool:
    return servo.firmware < _FAST_FIRMWARE or "operating_mode" not in servo.table.fields


def _broadcast(code: int, params: bytes, listening: Listening, now_s: float) -> Iterator[Reply]:
    last = 0
    for servo_id, there in sorted(listening.own.items()):
        if packets := _packets(there, code, params, now_s, broadcast=True):
            pause_s = there[0].return_delay_s + _SLOT_S * (servo_id - last)
            last = servo_id
            yield Reply((servo_id,), _collided(packets), pause_s)


def _addressed(packet: Packet, listening: Listening, now_s: float) -> Iterator[Reply]:
    """One id: those whose own it is answer, those whose second id it is obey in silence."""
    servo_id, code, params = packet.servo, packet.instruction, packet.params
    for servo in listening.second.get(servo_id, ()):
        _single(servo, code, params, now_s)
    there = listening.own.get(servo_id, [])
    pause_s = max((servo.return_delay_s for servo in there), default=0.0)
    if packets := _packets(there, code, params, now_s):
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


def _packets(
    servos: Sequence[Dynamixel2Servo], code: int, params: bytes, now_s: float, broadcast: bool = False
) -> list[bytes]:
    """Return the answers of servos of one id, in their order; every one of them obeys."""
    answers = [_single(servo, code, params, now_s, broadcast) for servo in servos]
    return [answer for answer in answers if answer is not None]


def _single(servo: Dynamixel2Servo, code: int, params: bytes, now_s: float, broadcast: bool = False) -> bytes | None:
    """Return the answer of one servo to an instruction of its own, or None."""
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
    elif code in (dxl2.REBOOT, dxl2.FACTORY_RESET):  # answered first, as it still is
        if broadcast and code == dxl2.FACTORY_RESET and params[0] == 0xFF:
            return None  # ignored since firmware 42: all would have one id
        reply = _status(servo, 0, b"", servo_id)
        answers = servo.return_level >= 2 and not broadcast
        if code == dxl2.REBOOT:
            servo.reboot(now_s)
        else:
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
    replies = [
        (servo.id, error | (dxl2.ALERT if servo.fault_status else 0), data or bytes(length))
        for (servo, error, data), length in zip(parts, lengths, strict=False)
    ]
    return dxl2.encode_fast_status(replies, 1 + sum(lengths) + 4 * len(lengths))
