"""Dynamixel servos of Protocol 2.0: requests and answers over a port, their startup, and their bus.

The vendor's SDK builds reads (`sdk_packets`), each only once; they are sent again unchanged. Our own codec builds
writes, because the SDK (4.1.0) stuffs a copy of a packet and then sends the original.

Answers are found in the byte stream by id and length, so that a late or foreign answer is never mistaken for another.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Final, cast

from sfms_robot.config import variant
from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.errors import NOTE, ConfigError
from sfms_robot.servo.chain.bus import ChainBus
from sfms_robot.servo.chain.link import Answer, Answers, Found, RegisterLink, Silent, Steps
from sfms_robot.servo.chain.sdk_packets import read2, sync_read2
from sfms_robot.servo.chain.startup import Startup
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.registers import Table, Values
from sfms_robot.servo.stored_settings import contradictions

log = logging.getLogger(__name__)

_PING_S: Final = 0.0035  # time of each of 253 ids to answer a broadcast ping, as in the SDK
_LENGTHS: Final = 4  # different lengths of reads of several servos, one byte apart
_HEADER: Final = b"\xff\xff\xfd"
_LONGEST_FAST: Final = dxl2.MAX_PACKET + 4096  # bytes after which a fast answer is given up

_TORQUE_ON_BY_GOAL: Final = 0x08  # drive mode bit 3
_REBOOT_S: Final = 0.5  # time until a rebooted servo is sure to answer


class Dynamixel2Link(RegisterLink):
    """A wire of Protocol 2.0 servos."""

    framing = FRAMINGS["dynamixel2"]
    has_fast_read = True
    _extra = 0  # bytes that reads of several servos request in addition to the wanted bytes

    # --- one servo ----------------------------------------------------------------------------------------------

    def ping(self, servo: int) -> Found | None:
        # The status of a ping holds 3 bytes: model number (2), firmware (1).
        self.send(dxl2.encode_instruction(servo, dxl2.PING))
        return _found(self._answers([servo], 3)).get(servo)

    def broadcast_ping(self) -> dict[int, Found]:
        self.send(dxl2.encode_instruction(dxl2.BROADCAST, dxl2.PING))
        ids = range(dxl2.MAX_ID + 1)
        with self.patient(len(ids) * _PING_S):
            return _found(self._answers(ids, 3))

    def reboot(self, servo: int) -> Answer | None:
        return self._instruct(servo, dxl2.REBOOT)

    def factory_reset(self, servo: int, option: int) -> Answer | None:
        return self._instruct(servo, dxl2.FACTORY_RESET, bytes([option]))

    def clear_turns(self, servo: int) -> Answer | None:
        """Bring the present position back into one revolution (CLEAR 01, with its key). Only at rest."""
        return self._instruct(servo, dxl2.CLEAR, b"\x01\x44\x58\x4c\x22")

    def read(self, servo: int, address: int, length: int) -> Answer | None:
        self.send(read2(servo, address, length))
        return self._answers([servo], length).get(servo)

    def write(self, servo: int, address: int, data: bytes) -> Answer | None:
        return self._instruct(servo, dxl2.WRITE, address.to_bytes(2, "little") + data)

    def refusal(self, answer: Answer) -> str:
        """Return the error number in bits 0..6 in words; bit 7 only reports that register 70 holds a fault."""
        if not (number := answer.error & ~dxl2.ALERT):
            return ""
        text = dxl2.ERRORS.get(number, f"error {number}")
        return text + ", and reports a hardware error" * bool(answer.error & dxl2.ALERT)

    def _instruct(self, servo: int, instruction: int, params: bytes = b"") -> Answer | None:
        self.send(dxl2.encode_instruction(servo, instruction, params))
        return self._answers([servo], 0).get(servo)

    # --- many servos --------------------------------------------------------------------------------------------

    sync_packet = staticmethod(dxl2.encode_sync_write)

    def read_many(self, address: int, length: int, servos: Sequence[int], fast: bool = False) -> Answers:
        longer = length + self._extra
        self.send(sync_read2(address, longer, tuple(servos), fast))
        answers = self._fast_answers(servos, longer) if fast else self._answers(servos, longer)
        if self._extra:
            answers = {servo: Answer(error, data[:length]) for servo, (error, data) in answers.items()}
        if len(answers) < len(servos):
            # A status packet does not identify its request. After a silence the next request has another length, so
            # that a late answer cannot be mistaken for its answer.
            self._extra = (self._extra + 1) % _LENGTHS
        return answers

    # --- inside -------------------------------------------------------------------------------------------------

    def _answers(self, servos: Sequence[int], length: int) -> Answers:
        """Return status packets of `servos` with `length` bytes of data, or with an error and no data.

        Waits until all are there, or no byte came for the silence beyond the time that the bytes take.
        """
        buffer, answers, pending = bytearray(), Answers(), set(servos)
        size = self.framing.answer + length
        for data in self._incoming(len(self._sent) + size, (len(servos) - 1) * size):
            buffer += data
            while (packet := dxl2.maybe_packet(buffer)) is not None:
                servo, instruction, params, error = packet
                expected = len(params) == length or (error & 0x7F and not params)
                if instruction == dxl2.STATUS and servo in pending and expected:
                    answers[servo] = Answer(error, params)
                    pending.remove(servo)
            if not pending:
                break
        return answers

    def _fast_answers(self, servos: Sequence[int], length: int) -> Answers:
        """Return the answers in one packet of all: FF FF FD 00 FE ... ERROR ID data CRC, ERROR ID data CRC, ..."""
        size = self.framing.answers(len(servos), length, fast=True)
        buffer, start = bytearray(), -1
        for data in self._incoming(len(self._sent) + size):
            buffer += data
            if start < 0:  # noise may come before the header; FE is the id of the shared packet
                start = buffer.find(_HEADER + b"\x00\xfe")
            if len(buffer) >= max(start, 0) + size or len(buffer) > _LONGEST_FAST:
                break
        found = dxl2.split_fast_status(buffer[max(start, 0) :], length)
        return {servo: Answer(error, data) for servo, error, data in found if servo in servos}


def _found(answers: Mapping[int, Answer]) -> dict[int, Found]:
    """Return the servos in answers to a ping, whose data are model number (2 bytes, low first) and firmware."""
    return {
        servo: Found(int.from_bytes(answer.data[:2], "little"), answer.data[2])
        for servo, answer in answers.items()
        if len(answer.data) == 3
    }


class Dynamixel2Startup(Startup):
    """Startup of servos that report their firmware, which decides the addresses of their registers."""

    can_reboot = True  # instruction 08
    unlimited = ("profile_acceleration", "profile_velocity", "moving_speed")  # the last one is for the XL-320

    def recognise(self, found: Found) -> None:
        """Raise ServoError for another model; use the table of the firmware that the servo reports."""
        super().recognise(found)
        low, high = self.table.firmware
        if found.firmware is not None and not low <= found.firmware <= high:
            try:
                self.table = Table.of(variant(self.servo.table.model, found.firmware))
            except ConfigError as error:
                raise self._error(f"has firmware {found.firmware}: {error}") from error

    def _read_state(self) -> Steps[dict[str, int]]:
        if (level := self.table.role("status_level")) is not None:
            # Status return level 2, not confirmed: at level 0 a servo answers only pings.
            self.link.sync_write(level.address, {self.servo.id: level.to_bytes(2)})
        return (yield from self._clear_turns((yield from self._snapshot())))

    def _find_again(self, reboot: bool) -> Steps[None]:
        if reboot:
            answer = self.link.reboot(self.servo.id)
            if answer is None:
                raise Silent(self._about("does not answer to a reboot"))
            if refusal := self.link.refusal(answer):
                raise self._error(f"refuses to reboot: {refusal}")
            yield _REBOOT_S
        found = self.ping()
        if found is None:
            raise Silent(self._about("does not answer to a ping"))
        self.recognise(found)

    def _defaults(self, now: Values) -> Values:
        drive_mode = now.get("drive_mode", 0) & ~_TORQUE_ON_BY_GOAL
        defaults = {"drive_mode": drive_mode, self._name("return_delay"): 0, "bus_watchdog": 0}
        if "pwm_limit" in now:  # an earlier run may have left less
            defaults["goal_pwm"] = now["pwm_limit"]
        return defaults

    def _clear_turns(self, now: dict[str, int]) -> Steps[dict[str, int]]:
        """Clear the whole turns (CLEAR) of a servo that was turned by hand past one turn, at rest without torque.

        The shaft does not move; only the position that it reports comes back into the turn of position mode.
        """
        present = self._field("present_position")
        found = contradictions(now, self.table, self._needs)
        turned = any(each.register == present.name and each.fixable for each in found)
        if not turned or now[self._name("torque_enable")] or now.get("moving"):
            return now
        answer = cast(Dynamixel2Link, self.link).clear_turns(self.servo.id)
        yield 0.0
        if answer is not None and (refusal := self.link.refusal(answer)):
            raise self._error(f"stands at {now[present.name]}, beyond one turn, and refuses CLEAR: {refusal}")
        cleared = self.value(present)
        yield 0.0
        log.log(NOTE, "%s", self._about(f"was turned past one turn: {now[present.name]} now reads {cleared}"))
        return {**now, present.name: cleared}


class Dynamixel2Bus(ChainBus):
    """A bus of Dynamixel servos of Protocol 2.0, in position mode.

    They are read by one fast sync read (all answer in one packet) while that works, else by a plain sync read. A
    watchdog that stops the servo is armed after the first goal, fed by all later goals, and switched off at the end,
    after the torque.
    """

    maps = "dynamixel", 2
    link = Dynamixel2Link
    startup = Dynamixel2Startup
