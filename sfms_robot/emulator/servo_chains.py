"""Emulated servos of one wire that share a protocol: packets in, packets out. Opens nothing.

An instruction to an id without a servo is not answered, and only servos set to the host's baud rate receive it. In a
sync or bulk read each servo waits for the previous servo: after a silent id all servos are silent, or, with
`chain_break` False, the others answer. Two servos with one id both obey; Dynamixels of Protocol 2.0 then answer at the
same time.
"""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from typing import Any, Final, Generic, TypeVar

from sfms_robot.emulator.control_table import Mode
from sfms_robot.emulator.emulated_wire import EmulatedDevice, EmulatedServo, Reply
from sfms_robot.emulator.register_servo import RegisterServo
from sfms_robot.servo.codecs import dxl2, protocol1
from sfms_robot.servo.registers import Field, Table, Values

FAST_BULK_READ: Final = 0x9A
_FAST_READS: Final = {dxl2.FAST_SYNC_READ, FAST_BULK_READ}
_GAP_S: Final = 0.05  # age at which an incomplete packet is dropped
_FAST_FIRMWARE: Final = 45  # first firmware that supports fast reads
_CENTER_ON_STS: Final = 2048
_LIMITED: Final = {"goal_pwm": "pwm_limit", "goal_current": "current_limit", "goal_velocity": "velocity_limit"}
_RESET_BY_MODE: Final = ("profile_velocity", "profile_acceleration", "goal_velocity", "goal_pwm", "goal_current")
_CLEAR_TURNS: Final = b"\x01\x44\x58\x4c\x22"  # parameters of CLEAR
_RESULT_FAIL: Final = 1
_REBOOT_S: Final = 0.3  # time after a reboot in which a Dynamixel 2.0 neither receives nor answers
S = TypeVar("S", bound=RegisterServo)
T = TypeVar("T")
Request = tuple[int, int, T]  # id, address, and length or data


class ServoChain(EmulatedDevice, Generic[S]):
    """The servos of one protocol. `tables` by model.

    While a packet is executed, `_now_s` is the time, and `_listening` the servos that receive the packet, by id.
    """

    _servo_class: type[S]
    _width: int  # bytes of an address and of a length in the parameters of an instruction
    _decode: Callable[[bytearray], Any]  # takes a whole packet off the front of a buffer, or returns None
    _encode: Callable[[int, int, bytes], bytes]  # returns a status packet: id, error, data
    _bulk_write: int | None = None  # an instruction of Protocol 2.0
    _slot_s = 0.0  # time slot per id: answers to a broadcast come in the order of ids, each in its own slot

    def __init__(self, servos: Sequence[EmulatedServo], tables: Mapping[str, Table], chain_break: bool) -> None:
        self.servos: list[S] = [self._servo_class(servo, tables[servo.model]) for servo in servos]
        self.chain_break = chain_break
        self._buffer = bytearray()
        self._now_s = 0.0
        self._listening: dict[int, list[S]] = {}

    def replies(self, data: bytes, baud: int | None, now_s: float) -> list[Reply]:
        if now_s - self._now_s > _GAP_S:
            self._buffer.clear()
        self._now_s = now_s
        self._buffer += data
        return list(self._obey_all(baud))

    def _obey_all(self, baud: int | None) -> Iterator[Reply]:
        """Remove the whole packets from the buffer; yield the answers to them."""
        while (packet := self._decode(self._buffer)) is not None:
            self._listening = {}
            for servo in self.servos:
                if servo.hears(baud, self._now_s):
                    servo.feed_watchdog(self._now_s)
                    self._listening.setdefault(servo.id, []).append(servo)
            if not self._listening:
                self._buffer.clear()  # noise from another baud rate
            try:
                yield from self._answers(*packet[:3])
            except IndexError:
                continue  # parameters are missing: no servo can execute the packet

    def _answers(self, target: int, code: int, params: bytes) -> Iterator[Reply]:
        """Yield the answers to a packet: id, instruction, parameters."""
        listening = self._listening
        followers: dict[int, list[S]] = {}  # a servo obeys its second id, but never answers to it
        for servo in itertools.chain(*listening.values()):
            if servo.second_id is not None:
                followers.setdefault(servo.second_id, []).append(servo)
        if code in (dxl2.SYNC_WRITE, self._bulk_write):  # no servo answers
            parts = self._sync_writes(params) if code == dxl2.SYNC_WRITE else self._bulk_writes(params)
            for servo_id, address, data in parts:
                for servo in (*listening.get(servo_id, ()), *followers.get(servo_id, ())):
                    servo.write(address, data, self._now_s)
        elif code in (dxl2.SYNC_READ, dxl2.FAST_SYNC_READ):
            address, length, ids = self._number(params, 0), self._number(params, 1), params[2 * self._width :]
            yield from self._reads([(servo_id, address, length) for servo_id in ids], code)
        elif code in (dxl2.BULK_READ, FAST_BULK_READ):
            yield from self._reads(self._bulk_reads(params), code)
        elif target == dxl2.BROADCAST:
            last = 0
            for servo_id in sorted(listening):
                for reply in self._together([self._single(each, code, params, True) for each in listening[servo_id]]):
                    yield reply._replace(pause_s=reply.pause_s + self._slot_s * (servo_id - last))
                    last = servo_id
        else:
            for servo in followers.get(target, ()):
                self._single(servo, code, params)
            yield from self._together([self._single(each, code, params) for each in listening.get(target, ())])

    @abstractmethod
    def _bulk_reads(self, params: bytes) -> list[Request[int]]:
        """Return (id, address, length) of a bulk read."""

    def _reads(self, requests: Sequence[Request[int]], code: int) -> Iterator[Reply]:
        """Yield status packets in list order, up to the first id that is silent (unless the chain skips it).

        The length in the single packet of a fast read is for all servos; the packet ends before the first silent servo.
        """
        fast, pause_s = code in _FAST_READS, 0.0
        parts: list[tuple[int, int, bytes]] = []
        for servo_id, address, length in requests:
            asked = self._listening.get(servo_id, ())
            there = [servo for servo in asked if servo.answers(1) and code in servo.group_reads]
            if not there and (self.chain_break or fast):
                break
            answers = [(servo, *servo.read(address, length, self._now_s)) for servo in there]
            if fast:
                servo, error, data = answers[0]
                parts.append((servo_id, error | servo.alert, data or bytes(length)))
                pause_s += servo.return_delay_s
            else:
                replies = [self._status(servo, servo_id, error, data) for servo, error, data in answers]
                yield from self._together(replies)
        announced = 1 + sum(length + 4 for *_, length in requests)  # LEN: up to the last servo of the list
        if parts and announced < dxl2.MAX_PACKET + 1:
            yield Reply(tuple(part[0] for part in parts), dxl2.encode_fast_status(parts, announced), pause_s)

    @abstractmethod
    def _single(self, servo: S, code: int, params: bytes, broadcast: bool = False) -> Reply | None:
        """Let one servo execute an instruction; return its answer, if any, with the id that it had before."""

    def _status(self, servo: S, servo_id: int, error: int, data: bytes = b"") -> Reply:
        return Reply((servo_id,), self._encode(servo_id, error | servo.alert, data), servo.return_delay_s)

    def _together(self, answers: Sequence[Reply | None]) -> Iterator[Reply]:
        """Yield the packets that appear on the wire when all servos with one id answer."""
        yield from filter(None, answers)

    def _number(self, params: bytes, index: int) -> int:
        """Return an address or a length. Raises IndexError if it is missing."""
        return sum(params[index * self._width + i] << 8 * i for i in range(self._width))

    def _sync_writes(self, params: bytes) -> Iterator[Request[bytes]]:
        """Yield (id, address, data) of a sync write: address, length, then id and data of each."""
        address, length = self._number(params, 0), self._number(params, 1)
        for start in range(2 * self._width, len(params) - length, length + 1):
            yield params[start], address, params[start + 1 : start + 1 + length]

    def _bulk_writes(self, params: bytes) -> Iterator[Request[bytes]]:
        """Yield (id, address, data) of a bulk write of Protocol 2.0."""
        while params:  # id, address (2), length (2), data
            length = self._number(params[1:], 1)
            yield params[0], self._number(params[1:], 0), params[5 : 5 + length]
            params = params[5 + length :]

    def _common(self, servo: S, code: int, params: bytes) -> tuple[int, bytes, int] | None:
        """Execute an instruction of every family, else return None; return (error, data, status level of answer)."""
        if code == protocol1.READ:
            return *servo.read(self._number(params, 0), self._number(params, 1), self._now_s), 1
        if code == protocol1.WRITE:
            return servo.write(self._number(params, 0), params[self._width :], self._now_s), b"", 2
        if code == protocol1.REG_WRITE:
            return servo.register(self._number(params, 0), params[self._width :]), b"", 2
        return (servo.action(self._now_s), b"", 2) if code == protocol1.ACTION else None


# --- Protocol 2.0 ---------------------------------------------------------------------------------------------------


class Dynamixel2Servo(RegisterServo):
    """A Dynamixel of Protocol 2.0: numbered errors, no EEPROM writes under torque, no goals beyond limits."""

    _beyond, _unknown = dxl2.DATA_RANGE_ERROR, dxl2.ACCESS_ERROR
    _start_s = _REBOOT_S

    def __init__(self, what: EmulatedServo, table: Table) -> None:
        self.group_reads = {dxl2.SYNC_READ, dxl2.BULK_READ}
        if what.firmware >= _FAST_FIRMWARE and "operating_mode" in table.fields:
            self.group_reads |= _FAST_READS
        super().__init__(what, table)

    @property
    def alert(self) -> int:
        return dxl2.ALERT if self.fault_status else 0

    def clear(self, params: bytes, now_s: float) -> int:
        """Clear the count of turns, only at rest; return the error."""
        self.advance(now_s)
        if params != _CLEAR_TURNS:
            return dxl2.DATA_RANGE_ERROR
        if self.plant.speed != 0.0:
            return _RESULT_FAIL
        self.forget_turns(now_s)
        return 0

    def _refusal(self, field: Field, value: int | None) -> int:
        name = field.name
        if not field.writable or (field.eeprom and self.torque):  # "EEPROM Area": only while Torque Enable (64) is 0
            return dxl2.ACCESS_ERROR
        if value is None:
            return dxl2.DATA_LENGTH_ERROR
        if not field.low <= value <= field.high or (name == "bus_watchdog" and value < 0):  # -1 only reports a trip
            return dxl2.DATA_RANGE_ERROR
        # "Bus Watchdog (98)": after a trip all goals are refused until it is set to 0.
        if self._tripped and (name == "goal_position" or name in _LIMITED):
            return dxl2.DATA_RANGE_ERROR
        if name == "goal_position" and self._mode is Mode.JOINT:  # Min and Max Position Limit (52, 48)
            return 0 if self._lowest <= value <= self._highest else dxl2.DATA_LIMIT_ERROR
        if (limit := _LIMITED.get(name, "")) in self.table.fields and abs(value) > self._get(limit):
            return dxl2.DATA_LIMIT_ERROR
        # "Shutdown (63)": torque stays off until a reboot.
        return dxl2.ACCESS_ERROR if name == "torque_enable" and value and self._shut_down() else 0

    def _apply(self, wanted: Values) -> None:
        if "bus_watchdog" in wanted:
            self._tripped = False
        super()._apply(wanted)
        if "operating_mode" in wanted:  # "Operating Mode (11)": a change resets gains, profile and goals
            for name in _RESET_BY_MODE:
                self._put(name, 0)
            self._stay()
            self._settings()


class Dynamixel2Chain(ServoChain[Dynamixel2Servo]):
    """Servos that speak Protocol 2.0."""

    _servo_class, _width = Dynamixel2Servo, 2
    _decode, _encode = staticmethod(dxl2.maybe_packet), staticmethod(dxl2.encode_status)
    _bulk_write, _slot_s = dxl2.BULK_WRITE, 0.003

    def _bulk_reads(self, params: bytes) -> list[Request[int]]:
        # id, address (2), length (2) of each
        rows = [params[i:] for i in range(0, len(params), 5)]
        return [(row[0], self._number(row[1:], 0), self._number(row[1:], 1)) for row in rows]

    def _together(self, answers: Sequence[Reply | None]) -> Iterator[Reply]:
        """Yield the single packet that results when all servos answer at the same time."""
        if packets := list(filter(None, answers)):
            yield packets[0]._replace(data=_collided([packet.data for packet in packets]))

    def _single(self, servo: Dynamixel2Servo, code: int, params: bytes, broadcast: bool = False) -> Reply | None:
        servo_id, now_s, result = servo.id, self._now_s, (dxl2.INSTRUCTION_ERROR, b"", 2)
        if code == dxl2.PING:  # answered at any status return level: model number (2), firmware (1)
            servo.advance(now_s)
            number = servo.table.model_number or 0
            result = 0, number.to_bytes(2, "little") + bytes([servo.firmware]), 0
        elif code == dxl2.STATUS or (code == dxl2.READ and broadcast):
            return None
        elif code in (dxl2.REBOOT, dxl2.FACTORY_RESET):  # answered before they are executed
            reply = self._status(servo, servo_id, 0) if servo.answers(2) and not broadcast else None
            if code == dxl2.REBOOT:
                servo.power_cycle(now_s)
            elif not (broadcast and params[0] == 0xFF):  # ignored since firmware 42: all would get the same id
                servo.factory_reset(now_s, {1: ("id",), 2: ("id", "baud_rate")}.get(params[0], ()))
            return reply
        elif code == dxl2.CLEAR:
            result = servo.clear(params, now_s), b"", 2
        else:
            result = self._common(servo, code, params) or result
        error, data, level = result
        if not servo.answers(level) or (broadcast and code != dxl2.PING):
            return None
        return self._status(servo, servo_id, error, data)


def _collided(packets: Sequence[bytes]) -> bytes:
    """Return the bytes on the wire when several servos send at the same time: of each bit, low wins."""
    length = max(map(len, packets))
    wide = (int.from_bytes(packet.ljust(length, b"\xff"), "big") for packet in packets)
    return reduce(int.__and__, wide).to_bytes(length, "big")


# --- Protocol 1.0 and Feetech ---------------------------------------------------------------------------------------


class Protocol1Servo(RegisterServo):
    """A Dynamixel of Protocol 1.0, or a Feetech. Errors and `fault_status` are bits of every answer."""

    _beyond = _unknown = protocol1.RANGE

    def __init__(self, what: EmulatedServo, table: Table) -> None:
        is_feetech = table.family == "feetech"
        self._nothing_registered = 0 if is_feetech else protocol1.INSTRUCTION
        # MX supports bulk read, AX does not; their tables differ in the multi-turn registers. STS supports sync read,
        # the turn counter and the calibration of its middle, SCS does not.
        self.is_sts = is_feetech and table.byte_order == "little"
        self.group_reads = {protocol1.SYNC_READ} if self.is_sts else set()
        if not is_feetech and "multi_turn_offset" in table.fields:
            self.group_reads = {protocol1.BULK_READ}
        super().__init__(what, table)

    def _refusal(self, field: Field, value: int | None) -> int:
        if value is None or not field.writable:
            return protocol1.RANGE
        # Register 44 of a Feetech is a time, and in PWM mode a duty cycle with a sign bit.
        signed_duty = field.name == "goal_time" and self._mode is Mode.PWM
        if not (-field.high if signed_duty else field.low) <= value <= field.high:
            return protocol1.RANGE
        # A Feetech moves to the nearer limit instead; equal limits are wheel or multi-turn mode.
        if field.name == "goal_position" and not self._is_feetech:
            lowest, highest = self._lowest, self._highest
            return 0 if lowest == highest or lowest <= value <= highest else protocol1.ANGLE_LIMIT
        return 0

    def _torque_written(self, value: int, locked: bool) -> None:
        """Make the present position the middle if 128 is written (Feetech); clear an overload when torque comes on."""
        if value == protocol1.CALIBRATE_HERE and "homing_offset" in self.table.fields:
            self._put("homing_offset", round(self.plant.position % self.table.ticks_per_revolution) - _CENTER_ON_STS)
            if not locked:
                self._keep(self.table["homing_offset"])
            self._put("torque_enable", 0)
        elif value == 1 and self._get("torque_limit", 1):  # "Shutdown (18)": first a torque limit, then torque
            self.fault_status &= ~self.fault_bits["overload"]
            if self._shut_down():
                self._put("torque_enable", 0)

    def _fail(self, bits: int) -> None:
        super()._fail(bits)
        if self._shut_down() and not self._is_feetech:
            self._put("torque_limit", 0)  # "Torque Limit (34)" is 0 after a shutdown, until a host sets it


class Protocol1Chain(ServoChain[Protocol1Servo]):
    """Servos that speak the FF FF frame. Frames of Protocol 2.0 on the same wire look like noise to them."""

    _servo_class, _width = Protocol1Servo, 1
    _decode, _encode = staticmethod(protocol1.maybe_frame), staticmethod(protocol1.encode)

    def _bulk_reads(self, params: bytes) -> list[Request[int]]:
        # after the 00: length, id, address of each
        return [(params[i + 1], params[i + 2], params[i]) for i in range(1, len(params) - 2, 3)]

    def _single(self, servo: Protocol1Servo, code: int, params: bytes, broadcast: bool = False) -> Reply | None:
        servo_id, now_s, is_feetech = servo.id, self._now_s, servo.table.family == "feetech"
        answers = [servo.answers(level) for level in range(3)]  # before the request changes the level
        error, data, level = 0, b"", 2
        if (result := self._common(servo, code, params)) is not None:
            error, data, level = result
            if is_feetech and code == protocol1.READ and not data:
                return None
        elif code == protocol1.PING:
            servo.advance(now_s)
            level = 0
        elif code == protocol1.FACTORY_RESET:
            servo.factory_reset(now_s)
        elif code == protocol1.CALIBRATE_OFFSET and servo.is_sts:
            torque = servo.table["torque_enable"]
            error = servo.write(torque.address, torque.to_bytes(protocol1.CALIBRATE_HERE), now_s)
        elif code == protocol1.RESET_TURNS and servo.is_sts:
            servo.forget_turns(now_s)
        elif is_feetech:
            return None
        else:
            error = protocol1.INSTRUCTION
        if not answers[level] or (broadcast and not (is_feetech and code == protocol1.PING)):
            return None
        return self._status(servo, servo_id, error, data)
