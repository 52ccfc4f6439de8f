"""Servos with the FF FF frame, Dynamixel 1.0 and Feetech: requests, answers, startup, and buses.

The vendor's SDK builds requests to Dynamixel servos (`sdk_packets`). Our codec builds sync writes, and all requests to
Feetech servos, which have other instructions.

An answer does not identify its request, so a late answer could be mistaken for the next one. Three rules prevent that.
An answer counts only if its id and its number of bytes were requested. Bytes that came before a request are dropped. No
request is made whose answer would be as long as one that the servo still owes; in that case the servo is first asked
for data of another length (a fence). A servo answers in order, so after the answer to a fence no older answer can come.

These servos switch their torque on when a goal is written, so the first goal written is always the present position,
and a limp servo stays limp because its goals are withheld. They have no reboot, and report faults in every answer.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, Final

from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.errors import PacketError, ServoError
from sfms_robot.servo.chain.bus import ChainBus
from sfms_robot.servo.chain.link import Answer, Answers, Found, RegisterLink, Silent, Steps
from sfms_robot.servo.chain.sdk_packets import instruction1
from sfms_robot.servo.chain.startup import Startup
from sfms_robot.servo.codecs import protocol1
from sfms_robot.servo.codecs.protocol1 import BROADCAST, MAX_FRAME, Frame, encode, maybe_frame, salvage
from sfms_robot.servo.policy import torque_limit
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Field, Values

_OWED_S: Final = 1.0  # an answer that has not come by then is not expected any more
_FENCES: Final = 2  # fences of a group, at most: answers share one wire, so later ones cannot overtake
_STAGGER_S: Final = 0.003  # time of a broadcast ping per id (lerobot @7427f31, motors/feetech/feetech.py)


class Protocol1Link(RegisterLink):
    """A wire of servos of one of the two families."""

    family: ClassVar[str]
    who_length: ClassVar[int]  # bytes from address 0 on that hold model number and firmware
    refusal_bits = 0  # bits of the error byte about the request
    _packet: Callable[[int, int, bytes], bytes]  # returns a request: servo, instruction, parameters

    def __init__(self, port: Port, baud: int, silence_s: float) -> None:
        super().__init__(port, baud, silence_s)
        self._owed: dict[int, dict[int, float]] = {}  # servo -> length of an owed answer -> time of its request
        self._echoed = False

    @abstractmethod
    def _group_request(self, address: int, length: int, servos: Sequence[int]) -> tuple[int, bytes]:
        """Return (instruction, parameters) of a read of several servos."""

    @abstractmethod
    def _identity(self, data: bytes) -> Found:
        """Return the identity in the first `who_length` bytes of the table."""

    # --- one servo ----------------------------------------------------------------------------------------------

    def ping(self, servo: int) -> Found | None:
        """Ping a servo and read its identity, which this protocol's ping does not report."""
        if self._ask(servo, protocol1.PING, b"", 0) is not None:
            return self._who(servo)
        # An answer to a ping with only the voltage bit set has the same bytes as the ping, so it looks like an echo.
        if self._echoed and (who := self._who(servo)).model_number is not None:
            return who
        return None

    def read(self, servo: int, address: int, length: int) -> Answer | None:
        return self._ask(servo, protocol1.READ, bytes([address, length]), length)

    def write(self, servo: int, address: int, data: bytes) -> Answer | None:
        return self._ask(servo, protocol1.WRITE, bytes([address]) + data, 0)

    def refusal(self, answer: Answer) -> str:
        return protocol1.refusal_text(answer.error & self.refusal_bits)

    def reboot(self, servo: int) -> Answer | None:
        """Raise PacketError: these protocols have no reboot instruction."""
        raise PacketError(
            f"{self.port.name}: servo {servo} speaks {self.family} and has no reboot instruction: "
            "switch its supply off and on"
        )

    def factory_reset(self, servo: int, option: int) -> Answer | None:
        """Reset everything, id and baud included. Raises PacketError for an `option` that keeps something."""
        if option != 0xFF:
            raise PacketError(f"{self.port.name}: a {self.family} servo resets everything (255), not option {option}")
        return self._ask(servo, protocol1.FACTORY_RESET, b"", 0)

    def _who(self, servo: int) -> Found:
        answer = self.read(servo, 0, self.who_length)
        return Found(None, None) if answer is None or not answer.data else self._identity(answer.data)

    def _ask(self, servo: int, code: int, params: bytes, length: int) -> Answer | None:
        if self._owes(servo, length) and not self._fence(servo):
            return None
        self.send(self._packet(servo, code, params))
        return self._answers([servo], length).get(servo)

    # --- several servos -----------------------------------------------------------------------------------------

    sync_packet = staticmethod(protocol1.encode_sync_write)

    def read_many(self, address: int, length: int, servos: Sequence[int], fast: bool = False) -> Answers:
        late = [servo for servo in servos if self._owes(servo, length)]
        closed: list[int] = []
        judged = False
        for servo in late[:_FENCES]:
            answered = self._fence(servo)
            judged |= self.judged
            if answered:
                for each in servos:  # no older answer can come, from any of them
                    self._owed.pop(each, None)
                break
            closed.append(servo)
        else:
            closed = late  # the answers that they owe may still come
        asked = [servo for servo in servos if servo not in closed]
        if not asked:
            self.judged = judged  # true for any of the fences: the last one may have had no time left
            return {}
        self.send(self._packet(BROADCAST, *self._group_request(address, length, asked)))
        return self._answers(asked, length)

    # --- the wire -----------------------------------------------------------------------------------------------

    def _owes(self, servo: int, length: int) -> bool:
        owed = self._owed.get(servo)
        if owed is None:
            return False
        now_s = self.port.now_s()
        for size in [size for size, asked_s in owed.items() if now_s - asked_s > _OWED_S]:
            del owed[size]
        return length in owed

    def _fence(self, servo: int) -> bool:
        """Request data of a length that no owed answer has; return whether the servo answered."""
        size = next(size for size in range(MAX_FRAME) if size not in self._owed[servo])
        request = (protocol1.READ, bytes([0, size])) if size else (protocol1.PING, b"")
        self.send(self._packet(servo, *request))
        return servo in self._answers([servo], size)

    def _answers(self, servos: Sequence[int], length: int) -> Answers:
        """Return answers of `servos` with `length` bytes of data, or with a refusal and no data.

        Waits until all are there, or no byte came for the silence beyond the time that the bytes take.
        """
        buffer, answers, pending, echo = bytearray(), Answers(), set(servos), self._sent
        self._echoed = False
        size = self.framing.answer + length
        for data in self._incoming(len(echo) + size, (len(servos) - 1) * size):
            buffer += data
            if len(buffer) < len(echo) and echo.startswith(buffer):
                continue  # this may be an adapter that receives its own bytes
            if echo and buffer.startswith(echo):
                self._echoed = True
                del buffer[: len(echo)]
            echo = b""
            while (frame := maybe_frame(buffer)) is not None:
                self._take(frame, length, pending, answers)
            if not pending:
                break
        for frame in salvage(buffer):
            self._take(frame, length, pending, answers)
        for servo in pending:
            self._owed.setdefault(servo, {})[length] = self.port.now_s()
        return answers

    def _take(self, frame: Frame, length: int, pending: set[int], answers: Answers) -> None:
        refused = frame.code & self.refusal_bits and not frame.params
        if frame.servo in pending and (len(frame.params) == length or refused):
            answers[frame.servo] = Answer(frame.code, frame.params)
            pending.remove(frame.servo)
            self._owed.pop(frame.servo, None)


class Dynamixel1Link(Protocol1Link):
    """A wire of Dynamixel 1.0 servos. MX servos answer a bulk read, AX servos do not."""

    family = "dynamixel"
    framing = FRAMINGS["dynamixel1"]
    who_length = 3
    refusal_bits = protocol1.REFUSAL_BITS
    _packet = staticmethod(instruction1)

    def _group_request(self, address: int, length: int, servos: Sequence[int]) -> tuple[int, bytes]:
        return protocol1.BULK_READ, protocol1.bulk_read_params((servo, address, length) for servo in servos)

    def _identity(self, data: bytes) -> Found:
        return Found(int.from_bytes(data[:2], "little"), data[2])

    def broadcast_ping(self) -> dict[int, Found]:
        """Ping all 254 ids, at one silence each: this protocol has no broadcast ping."""
        return {servo: found for servo in range(protocol1.MAX_ID + 1) if (found := self.ping(servo)) is not None}


class FeetechLink(Protocol1Link):
    """A wire of Feetech servos. STS and SMS answer a sync read, SCS not reliably.

    Their error byte describes only the servo; no bit reports a refused request. Bytes 0 to 4 of the table are firmware
    (major, minor), byte order (0: low byte first) and model number.
    """

    family = "feetech"
    framing = FRAMINGS["feetech"]
    who_length = 5
    _packet = staticmethod(encode)

    def _group_request(self, address: int, length: int, servos: Sequence[int]) -> tuple[int, bytes]:
        return protocol1.SYNC_READ, protocol1.sync_read_params(address, length, servos)

    def _identity(self, data: bytes) -> Found:
        return Found(int.from_bytes(data[3:5], "big" if data[2] else "little"), data[0], data[1])

    def broadcast_ping(self) -> dict[int, Found]:
        ids = range(protocol1.MAX_ID + 1)
        self.send(encode(BROADCAST, protocol1.PING))
        with self.patient(_STAGGER_S * len(ids)):
            there = sorted(self._answers(ids, 0))
        self._owed.clear()  # no servo owes an answer to a broadcast
        return {servo: self._who(servo) for servo in there}


class Protocol1Startup(Startup):
    """Startup of servos without reboot, which report their faults in every answer."""

    can_reboot = False
    unlimited = ("moving_speed", "goal_velocity", "acceleration", "goal_acceleration", "goal_time")

    def ping(self) -> Found | None:
        who = super().ping()
        if who is not None and who.model_number is None:
            self._acknowledge()
            return None
        return who

    def _acknowledge(self) -> None:
        """Raise the status level, without confirmation: at a low level, a servo answers only pings."""
        lock, level = self.table.role("lock"), self._field("status_level")
        raised = level, level.high
        for field, value in [raised] if lock is None else [(lock, 0), raised, (lock, 1)]:
            self.link.write(self.servo.id, field.address, field.to_bytes(value))

    def _read_state(self) -> Steps[dict[str, int]]:
        level = self._field("status_level")
        if self.value(level) != level.high:
            self._acknowledge()
        yield 0.0
        return (yield from self._snapshot())

    def _find_again(self, reboot: bool) -> Steps[None]:
        self.recognise(Found(self.value(self.table["model_number"]), None))
        yield from ()

    def _defaults(self, now: Values) -> Values:
        defaults, limit = {self._name("return_delay"): 0}, self.table.role("torque_limit")
        if limit is not None and "max_torque" in now:  # from the EEPROM; an earlier run may have left less in RAM
            defaults[limit.name] = now["max_torque"]
        return defaults

    def _set(self, now: Values, name: str, target: int) -> Steps[bool]:
        """Write a register, but keep a torque limit of 0: that is a shutdown, in force until torque is switched on."""
        if name == self._name("torque_limit") and not now[name]:
            return False
        return (yield from super()._set(now, name, target))

    def _restore_torque(self) -> Steps[None]:
        """Restore the torque limit, which a shutdown sets to 0, also when torque is switched on again."""
        table, limit = self.table, self.table.role("torque_limit")
        if limit is None or self.value(limit):
            return
        yield 0.0
        full = torque_limit(self.servo)
        if not full and "max_torque" in table.fields:
            full = {limit.name: self.value(table["max_torque"])}
        for name, value in full.items():
            yield from self._write(table[name], value)

    def _write(self, field: Field, value: int) -> Steps[None]:
        """Write and verify a register; add the fault that the servo reports to an error."""
        try:
            yield from super()._write(field, value)
        except Silent:
            raise
        except ServoError as error:
            torque = self._field("torque_enable")
            answer = self.link.read(self.servo.id, torque.address, torque.size)
            fault = "" if answer is None else ", ".join(self.table.faults_in(answer.error))
            raise ServoError(f"{error}, and it reports a hardware error ({fault})" if fault else str(error)) from None


class Dynamixel1Bus(ChainBus):
    """A bus of Dynamixel servos of Protocol 1.0: AX, and MX with their old firmware.

    MX servos answer a bulk read, one request for all. AX servos do not, so on a bus with an AX servo all are read one
    by one, in rotation. The bus finds out when it connects.
    """

    maps = "dynamixel", 1
    link = Dynamixel1Link
    startup = Protocol1Startup


class FeetechBus(ChainBus):
    """A bus of Feetech servos, all of one byte order.

    STS and SMS (low byte first) answer a sync read, one request for all. SCS (high byte first) do not
    answer it reliably, so they are read one by one, in rotation.
    """

    maps = "feetech", 1
    link = FeetechLink
    startup = Protocol1Startup
