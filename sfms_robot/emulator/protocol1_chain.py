"""Emulated servos that speak the FF FF frame, Dynamixel 1.0 and Feetech, on one wire.

On a bulk or sync read each servo waits for the one before it. Frames of Protocol 2.0 on the same wire look like rubbish
to these servos.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sfms_robot.emulator.device import Reply
from sfms_robot.emulator.protocol1_servo import Protocol1Servo
from sfms_robot.emulator.register_servo import ServoChain
from sfms_robot.servo.codecs import protocol1
from sfms_robot.servo.codecs.protocol1 import BROADCAST, Frame, encode, maybe_frame


class Protocol1Chain(ServoChain[Protocol1Servo]):
    """All servos of one wire that speak this frame."""

    _servo_class = Protocol1Servo

    def _obey_all(self, baud: int | None, now_s: float) -> list[Reply]:
        listening = [servo for servo in self.servos if servo.hears(baud)]
        if not listening:
            self._buffer.clear()  # at another baud there is nothing but noise
        out: list[Reply] = []
        while (frame := maybe_frame(self._buffer)) is not None:
            out += self._answers(frame, listening, now_s)
        return out

    def _answers(self, frame: Frame, listening: Sequence[Protocol1Servo], now_s: float) -> Iterator[Reply]:
        code, params = frame.code, frame.params
        try:
            if code == protocol1.SYNC_WRITE:
                address, parts = protocol1.sync_write_parts(params)
                for servo_id, data in parts:
                    for servo in _of(listening, servo_id):
                        servo.write(address, data, now_s)
            elif code == protocol1.SYNC_READ:
                address, length, ids = protocol1.sync_read_parts(params)
                readers = [servo for servo in listening if servo.is_sync_reader]
                yield from self._group([(servo_id, address, length) for servo_id in ids], readers, now_s)
            elif code == protocol1.BULK_READ:
                readers = [servo for servo in listening if servo.is_bulk_reader]
                yield from self._group(protocol1.bulk_read_parts(params), readers, now_s)
            elif frame.servo == BROADCAST:
                for servo in sorted(listening, key=lambda servo: servo.id):
                    answers = list(_single(servo, code, params, now_s))
                    if code == protocol1.PING and servo.table.family == "feetech":
                        yield from answers
            else:
                for servo in list(_of(listening, frame.servo)):
                    yield from _single(servo, code, params, now_s)
        except IndexError:
            return  # parameters are missing: no servo knows what was meant

    def _group(
        self, requests: Sequence[tuple[int, int, int]], readers: Sequence[Protocol1Servo], now_s: float
    ) -> Iterator[Reply]:
        for servo_id, address, length in requests:
            servo = next(_of(readers, servo_id), None)
            if servo is not None and servo.answers_reads:
                yield _reply(servo, servo_id, *servo.read(address, length, now_s))
            elif self.chain_break:
                return


def _of(servos: Sequence[Protocol1Servo], servo_id: int) -> Iterator[Protocol1Servo]:
    """All with this id: two that share one both answer."""
    return (servo for servo in servos if servo.id == servo_id)


def _single(servo: Protocol1Servo, code: int, params: bytes, now_s: float) -> Iterator[Reply]:
    """What one servo answers to an instruction of its own, if it does."""
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
    elif code == protocol1.CALIBRATE_OFFSET and servo.is_sync_reader:
        torque = servo.table["torque_enable"]
        error = servo.write(torque.address, torque.to_bytes(protocol1.CALIBRATE_HERE), now_s)
    elif code == protocol1.RESET_TURNS and servo.is_sync_reader:
        servo.reset_turns(now_s)
    else:
        error, answers = protocol1.INSTRUCTION, not is_feetech and servo.answers_writes
    if answers:
        yield _reply(servo, asked, error, data)


def _reply(servo: Protocol1Servo, servo_id: int, error: int, data: bytes) -> Reply:
    return Reply((servo_id,), encode(servo_id, error | servo.fault_status, data), servo.return_delay_s)
