"""Emulated servos that speak the FF FF frame, Dynamixel 1.0 and Feetech, on one wire: bytes in, bytes out.

An instruction to an id that nobody has stays unanswered, and only servos set to the host's baud rate hear it. On a
bulk or sync read each servo waits for the one before it: behind a silent id all are silent (`chain_break`), or the
chain goes on without it. Frames of Protocol 2.0 on the same wire look like rubbish to these servos.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from sfms_robot.emulator.protocol1_servo import Protocol1Servo
from sfms_robot.servo.codecs import dxl1, feetech, protocol1
from sfms_robot.servo.codecs.protocol1 import BROADCAST, Frame, encode, maybe_frame
from sfms_robot.servo.registers import Table

_GAP_S: Final = 0.05  # an unfinished frame older than this is forgotten


class Protocol1Chain:
    """All servos of one wire that speak this frame."""

    def __init__(self, servos: Sequence[Protocol1Servo], chain_break: bool = True) -> None:
        self.servos = list(servos)
        self.chain_break = chain_break
        self._buffer = bytearray()
        self._received_at_s = 0.0

    @classmethod
    def from_rows(
        cls, rows: Sequence[Mapping[str, Any]], tables: Mapping[str, Table], chain_break: bool = True
    ) -> Protocol1Chain:
        """From plain rows (see `launch.EmulatedServo`) and the models' tables."""
        servos = [
            Protocol1Servo(
                row["id"],
                tables[row["model"]],
                row["baud"],
                row["start_ticks"],
                row["firmware"],
                row.get("registers"),
                row.get("supply_v"),
            )
            for row in rows
        ]
        return cls(servos, chain_break)

    def servo(self, servo_id: int) -> Protocol1Servo | None:
        return next((servo for servo in self.servos if servo.id == servo_id), None)

    def kill(self, servo_id: int) -> None:
        """Its cable is out. Raises KeyError for an id that nobody has."""
        self._named(servo_id).dead = True

    def revive(self, servo_id: int) -> None:
        self._named(servo_id).dead = False

    def advance(self, now_s: float) -> None:
        for servo in self.servos:
            servo.advance(now_s)

    def receive(self, data: bytes, baud: int | None, now_s: float) -> bytes:
        """Take bytes that the host sent at `baud` (None = unknown) and give what the servos answer."""
        return b"".join(self.replies(data, baud, now_s))

    def replies(self, data: bytes, baud: int | None, now_s: float) -> list[bytes]:
        """As `receive`, one item per answer."""
        if now_s - self._received_at_s > _GAP_S:
            self._buffer.clear()
        self._received_at_s = now_s
        listening = [servo for servo in self.servos if servo.hears(baud)]
        if not listening:
            self._buffer.clear()  # at another baud there is nothing but noise
            return []
        self._buffer += data
        out: list[bytes] = []
        while (frame := maybe_frame(self._buffer)) is not None:
            out += self._answers(frame, listening, now_s)
        return out

    def _named(self, servo_id: int) -> Protocol1Servo:
        servo = self.servo(servo_id)
        if servo is None:
            raise KeyError(f"no servo with id {servo_id} on this wire")
        return servo

    def _answers(self, frame: Frame, listening: Sequence[Protocol1Servo], now_s: float) -> Iterator[bytes]:
        code, params = frame.code, frame.params
        try:
            if code == protocol1.SYNC_WRITE:
                address, parts = dxl1.sync_write_parts(params)
                for servo_id, data in parts:
                    for servo in _of(listening, servo_id):
                        servo.write(address, data, now_s)
            elif code == feetech.SYNC_READ:
                address, length, ids = feetech.sync_read_parts(params)
                readers = [servo for servo in listening if servo.is_sync_reader]
                yield from self._group([(servo_id, address, length) for servo_id in ids], readers, now_s)
            elif code == dxl1.BULK_READ:
                readers = [servo for servo in listening if servo.is_bulk_reader]
                yield from self._group(
                    [(servo_id, address, length) for servo_id, address, length in dxl1.bulk_read_parts(params)],
                    readers,
                    now_s,
                )
            elif frame.servo == BROADCAST:
                for servo in sorted(listening, key=lambda servo: servo.id):
                    answer = _single(servo, code, params, now_s)
                    if code == protocol1.PING and servo.table.family == "feetech" and answer is not None:
                        yield answer
            else:
                for servo in list(_of(listening, frame.servo)):
                    answer = _single(servo, code, params, now_s)
                    if answer is not None:
                        yield answer
        except IndexError:
            return  # parameters are missing: no servo knows what was meant

    def _group(
        self, requests: Sequence[tuple[int, int, int]], readers: Sequence[Protocol1Servo], now_s: float
    ) -> Iterator[bytes]:
        for servo_id, address, length in requests:
            servo = next(_of(readers, servo_id), None)
            if servo is not None and servo.answers_reads:
                yield _status(servo, *servo.read(address, length, now_s))
            elif self.chain_break:
                return


def _of(servos: Sequence[Protocol1Servo], servo_id: int) -> Iterator[Protocol1Servo]:
    """All with this id: two that share one both answer."""
    return (servo for servo in servos if servo.id == servo_id)


def _single(servo: Protocol1Servo, code: int, params: bytes, now_s: float) -> bytes | None:
    """What one servo answers to an instruction of its own, or None."""
    is_feetech = servo.table.family == "feetech"
    asked = servo.id  # it answers under this one also when the request changes it
    error, data, answers = 0, b"", servo.answers_writes
    if code == protocol1.PING:
        answers = not servo.mute
        servo.advance(now_s)
    elif code == protocol1.READ:
        (error, data), answers = servo.read(params[0], params[1], now_s), servo.answers_reads
        answers = answers and not (is_feetech and not data)
    elif code == protocol1.WRITE:
        error = servo.write(params[0], params[1:], now_s)
    elif code == protocol1.REG_WRITE:
        error = servo.register(params[0], params[1:])
    elif code == protocol1.ACTION:
        error = servo.action(now_s)
    elif code == protocol1.FACTORY_RESET:
        servo.factory_reset(now_s)
    elif code == feetech.CALIBRATE_OFFSET and servo.is_sync_reader:
        torque = servo.table["torque_enable"]
        error = servo.write(torque.address, torque.to_bytes(feetech.CALIBRATE_HERE), now_s)
    elif code == feetech.RESET_TURNS and servo.is_sync_reader:
        servo.reset_turns(now_s)
    else:
        error, answers = dxl1.INSTRUCTION, not is_feetech and servo.answers_writes
    return encode(asked, error | servo.fault_status, data) if answers else None


def _status(servo: Protocol1Servo, error: int, data: bytes) -> bytes:
    return encode(servo.id, error | servo.fault_status, data)
