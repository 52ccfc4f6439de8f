"""Requests to servos that speak the FF FF frame, Dynamixel 1.0 or Feetech, and their answers, over a `Port`.

The vendor's SDK builds the Dynamixel packets (`sdk_packets`), our codec those of Feetech: other instructions alone.

The frame does not say what an answer answers, so an answer that comes late could pass for the next one. Three rules
keep it out: an answer counts only from an id that was asked and with the number of bytes that was asked for; what
came before a request is thrown away; and no request is made whose answer would be as long as one that the servo
still owes. In that case the servo is first asked for something of another length (a fence). It answers in order, so
once it has answered that, nothing older can come.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, Literal

from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.errors import PacketError
from sfms_robot.servo.chain.link import CHUNK, Answer, Found, RegisterLink
from sfms_robot.servo.chain.sdk_packets import SdkPackets1
from sfms_robot.servo.codecs import dxl1, feetech, protocol1
from sfms_robot.servo.codecs.protocol1 import BROADCAST, MAX_FRAME, Frame, encode, maybe_frame, salvage
from sfms_robot.servo.port import Port

Family = Literal["dynamixel", "feetech"]

_OWED_S: Final = 1.0  # an answer that has not come by then never will
_FENCES: Final = 2  # of a group at most: answers share one wire, so those behind cannot overtake
_STAGGER_S: Final = 0.003  # lerobot @7427f31, motors/feetech/feetech.py: what a broadcast ping may take per id


class Protocol1Link(RegisterLink):
    """One wire; `family` is whose instructions are spoken."""

    def __init__(self, port: Port, baud: int, silence_s: float, family: Family) -> None:
        super().__init__(port, baud, silence_s)
        self.family = family
        self.framing = FRAMINGS["feetech" if family == "feetech" else "dynamixel1"]
        self._build = SdkPackets1().instruction if family == "dynamixel" else encode
        self._sent = b""
        self._owed: dict[int, dict[int, float]] = {}
        self._echoed = False

    # --- one servo ----------------------------------------------------------------------------------------------

    def ping(self, servo: int) -> Found | None:
        """Whether it is there; who it is comes from its registers, for this protocol's ping does not say."""
        if self._ask(servo, protocol1.PING, b"", 0) is None:
            if not self._echoed:
                return None
            # With only the voltage bit set, an answer to a ping has the bytes of the ping: it looks like an echo.
            who = self._who(servo)
            return None if who.model_number is None else who
        return self._who(servo)

    def broadcast_ping(self) -> dict[int, Found]:
        """Everybody, by id. Dynamixel 1.0 has no such request: all 254 ids are asked, one silence each."""
        everyone = list(range(protocol1.MAX_ID + 1))
        if self.family == "dynamixel":
            return {servo: found for servo in everyone if (found := self.ping(servo)) is not None}
        self._send(BROADCAST, protocol1.PING, b"")
        with self.patient(_STAGGER_S * len(everyone)):
            there = sorted(self._answers(everyone, 0))
        self._owed.clear()  # nobody owes an answer to a question to everybody
        return {servo: self._who(servo) for servo in there}

    def read(self, servo: int, address: int, length: int) -> Answer | None:
        return self._ask(servo, protocol1.READ, bytes([address, length]), length)

    def write(self, servo: int, address: int, data: bytes) -> Answer | None:
        return self._ask(servo, protocol1.WRITE, bytes([address]) + data, 0)

    def refusal(self, answer: Answer) -> str:
        """Feetech has no bit that says so: its error byte is about the servo alone."""
        return dxl1.refusal_text(answer.error) if self.family == "dynamixel" else ""

    def reboot(self, servo: int) -> Answer | None:
        """Raises PacketError: there is no such instruction in these protocols."""
        raise PacketError(
            f"{self.port.name}: servo {servo} speaks {self.family} and has no reboot instruction: "
            "switch its supply off and on"
        )

    def factory_reset(self, servo: int, option: int) -> Answer | None:
        """Everything, id and baud included. Raises PacketError when `option` asks to keep something."""
        if option != 0xFF:
            raise PacketError(f"{self.port.name}: a {self.family} servo resets everything (255), not option {option}")
        return self._ask(servo, protocol1.FACTORY_RESET, b"", 0)

    def _who(self, servo: int) -> Found:
        """Model number and (of Feetech: major) firmware; a Feetech servo says itself which byte of a word is first."""
        answer = self.read(servo, 0, 3 if self.family == "dynamixel" else 5)
        if answer is None or not answer.data:
            return Found(None, None)
        data = answer.data
        if self.family == "dynamixel":
            return Found(int.from_bytes(data[:2], "little"), data[2])
        return Found(int.from_bytes(data[3:5], "big" if data[2] else "little"), data[0])

    def _ask(self, servo: int, code: int, params: bytes, length: int) -> Answer | None:
        if self._owes(servo, length) and not self._fence(servo):
            return None
        self._send(servo, code, params)
        return self._answers([servo], length).get(servo)

    # --- several servos -----------------------------------------------------------------------------------------

    def sync_write(self, address: int, values: Mapping[int, bytes]) -> None:
        """One packet for all servos; all values have one length. Nothing answers."""
        self._send(BROADCAST, protocol1.SYNC_WRITE, dxl1.sync_write_params(address, values))

    def sync_read(self, address: int, length: int, servos: Sequence[int]) -> dict[int, Answer]:
        """Answers by id, of those that answered. Feetech STS only."""
        return self._ask_group(
            servos, length, lambda ids: (feetech.SYNC_READ, feetech.sync_read_params(address, length, ids))
        )

    def bulk_read(self, address: int, length: int, servos: Sequence[int]) -> dict[int, Answer]:
        """Answers by id, of those that answered. Dynamixel MX only."""
        return self._ask_group(
            servos, length, lambda ids: (dxl1.BULK_READ, dxl1.bulk_read_params((s, address, length) for s in ids))
        )

    def _ask_group(
        self, servos: Sequence[int], length: int, request: Callable[[Sequence[int]], tuple[int, bytes]]
    ) -> dict[int, Answer]:
        late = [servo for servo in servos if self._owes(servo, length)]
        closed: list[int] = []
        judged = False
        for servo in late[:_FENCES]:
            answered = self._fence(servo)
            judged |= self.judged
            if answered:
                for each in servos:  # nothing older than that answer can come, from nobody
                    self._owed.pop(each, None)
                break
            closed.append(servo)
        else:
            closed = late  # nothing says that what they owe will not come yet
        asked = [servo for servo in servos if servo not in closed]
        if not asked:
            self.judged = judged  # by one of them: the last may have had no time left
            return {}
        self._send(BROADCAST, *request(asked))
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
        """Ask for something that no owed answer can be taken for; whether the servo answered."""
        size = next(size for size in range(MAX_FRAME) if size not in self._owed[servo])
        if size == 0:
            self._send(servo, protocol1.PING, b"")
        else:
            self._send(servo, protocol1.READ, bytes([0, size]))
        return servo in self._answers([servo], size)

    def _send(self, servo: int, code: int, params: bytes) -> None:
        self.port.discard_input()
        packet = self._build(servo, code, params)
        self.port.write(packet)
        self._sent = packet

    def _answers(self, servos: Sequence[int], length: int) -> dict[int, Answer]:
        """Answers of `servos` with `length` bytes of data, or with a refusal and none.

        Waits until all are there, or nothing came for `silence_s` beyond the time that the bytes take.
        """
        port, buffer, answers, echo = self.port, bytearray(), dict[int, Answer](), self._sent
        pending = set(servos)
        self._echoed = False
        allowance_s = self._allowance_s()
        asked_s = port.now_s()
        size = self.framing.answer + length
        deadline_s = asked_s + (len(echo) + size) * self._byte_s + allowance_s
        last_s = deadline_s + (len(servos) - 1) * size * self._byte_s + self._rubbish_s()
        while pending and port.now_s() < last_s:
            data = port.read(CHUNK, min(deadline_s, last_s))
            if not data:
                break
            buffer += data
            deadline_s = port.now_s() + allowance_s
            if len(buffer) < len(echo) and echo.startswith(buffer):
                continue  # perhaps an adapter that hears itself
            if echo and buffer.startswith(echo):
                self._echoed = True
                del buffer[: len(echo)]
            echo = b""
            while (frame := maybe_frame(buffer)) is not None:
                self._take(frame, length, pending, answers)
        for frame in salvage(buffer):
            self._take(frame, length, pending, answers)
        now_s = port.now_s()
        if pending:
            self._waited(min(allowance_s, now_s - asked_s))
        for servo in pending:
            self._owed.setdefault(servo, {})[length] = now_s
        return answers

    def _take(self, frame: Frame, length: int, pending: set[int], answers: dict[int, Answer]) -> None:
        refused = self.family == "dynamixel" and frame.code & dxl1.REFUSAL_BITS and not frame.params
        if frame.servo in pending and (len(frame.params) == length or refused):
            answers[frame.servo] = Answer(frame.code, frame.params)
            pending.remove(frame.servo)
            self._owed.pop(frame.servo, None)
