"""Registers over a wire, for every protocol: requests in a time budget, verified writes, servos that share an id.

A request to one servo returns None if there was no answer; the protocol defines the error byte of an answer. A
request blocks until all answers are there, or no byte came for `silence_s` beyond the time that the bytes take on the
wire. Inside `within` all requests share one allowance of silence, so a poll costs one silence, however many servos are
dead. A request that `grants` refuses is allowed after a while, also on a wire that is too slow for its budget.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import ClassVar, Final, NamedTuple, TypeVar

from sfms_robot.config.wire_time import BITS, Framing
from sfms_robot.errors import ServoError
from sfms_robot.servo.codecs import dxl2, protocol1
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Field

log = logging.getLogger(__name__)

T = TypeVar("T")
Steps = Generator[float, None, T]  # work in steps; between two exchanges it yields the seconds to wait

TRIES: Final = 3
NO_PATIENCE: Final = 10  # read deadlines that noise on the wire may take before a request is given up
LATE_S: Final = 0.25  # after this wait for room in the budget, a purpose gets one request in addition to it
AWAY_LATE_S: Final = 0.05  # the same for servos that were lost
_CHUNK: Final = 4096
_SPENT_LATE_S: Final = 1.0  # the same if silent servos have used up the allowance
_SLACK_S: Final = 0.001  # extra time of a request that is granted, for a busy computer
_ADAPTER_S: Final = 0.05  # longest time that an adapter may hold an answer back
_SAMPLES: Final = 3
_MARGIN: Final = 1.25
_MOST_READS: Final = 64  # reads after which a wire that never falls silent is given up


class Found(NamedTuple):
    """The servo that answered a ping. Values that the protocol's ping does not report are None.

    `firmware_minor`: only of Feetech servos, whose firmware has two numbers.
    """

    model_number: int | None
    firmware: int | None
    firmware_minor: int | None = None


class Answer(NamedTuple):
    """The answer of one servo: the error byte as received, and the data read (empty for a write)."""

    error: int
    data: bytes


Answers = dict[int, Answer]  # by id


class RegisterLink(ABC):
    """A wire of servos that have registers. Requests raise BusError if the port is gone, never for a silent servo.

    Args:
        port: the port of the wire; the link owns it from now on.
        baud: bits per second; it determines the time that bytes take.
        silence_s: time without a byte after which the servo counts as silent.

    Attributes:
        framing: sizes of its packets, in bytes.
        has_fast_read: whether servos can answer in one packet.
        tries: attempts of a startup before a servo counts as silent; 1 while the bus is running.
        judged: whether the last request waited for the full silence. Inside `within` a request may wait for
            less, and then a servo that did not answer may still be there.
    """

    framing: ClassVar[Framing]
    has_fast_read = False

    def __init__(self, port: Port, baud: int, silence_s: float) -> None:
        self.port = port
        self.silence_s = silence_s
        self.tries = 1
        self.judged = True
        self._sent = b""  # the last request
        self._byte_s = BITS / baud
        self._end_s = math.inf
        self._left_s = math.inf
        self._refused_s: dict[str, float] = {}  # purpose -> time at which it was first refused

    @abstractmethod
    def ping(self, servo: int) -> Found | None:
        """Return the servo at an id; None if it does not answer."""

    @abstractmethod
    def broadcast_ping(self) -> dict[int, Found]:
        """Return all servos that answer at this baud, by id; waits the whole time that 253 answers may take."""

    @abstractmethod
    def read(self, servo: int, address: int, length: int) -> Answer | None:
        """Read `length` bytes of one servo."""

    @abstractmethod
    def read_many(self, address: int, length: int, servos: Sequence[int], fast: bool = False) -> Answers:
        """Read `length` bytes of several servos by one request; return the received answers by id.

        `fast`: all servos answer in one packet, which ends at the first silent servo (`has_fast_read`).
        """

    @abstractmethod
    def write(self, servo: int, address: int, data: bytes) -> Answer | None:
        """Write to one servo; return the acknowledgement. After None the servo may still have taken the data."""

    @staticmethod
    @abstractmethod
    def sync_packet(address: int, length: int, rows: bytes) -> bytes:
        """Return the packet of a write to several servos; `rows` are the id and the `length` bytes of each."""

    @abstractmethod
    def refusal(self, answer: Answer) -> str:
        """Return the reason of a refusal in words; empty if the request was done, even if the servo reports a fault."""

    @abstractmethod
    def reboot(self, servo: int) -> Answer | None:
        """Restart a servo."""

    @abstractmethod
    def factory_reset(self, servo: int, option: int) -> Answer | None:
        """Reset everything (`option` 0xFF). Protocol 2.0 can also keep the id (1), or id and baud (2)."""

    @classmethod
    def sync_write_packet(cls, address: int, values: Mapping[int, bytes]) -> bytes:
        """Return the packet of `sync_write`, which may be written from any thread."""
        length = len(next(iter(values.values())))
        return cls.sync_packet(address, length, b"".join(bytes([servo]) + data for servo, data in values.items()))

    def sync_write(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write to several servos in one packet; all values have one length. No servo answers."""
        self.send(self.sync_write_packet(address, values))

    def send(self, packet: bytes) -> None:
        """Send a packet; drop the input received before it."""
        self.port.discard_input()
        self.port.write(packet)
        self._sent = packet

    # --- time ---------------------------------------------------------------------------------------------------

    @contextmanager
    def patient(self, silence_s: float, tries: int = 1) -> Iterator[None]:
        """Wait at least `silence_s` for answers inside the block, and let a startup make `tries` attempts."""
        usual = self.silence_s, self.tries  # also restored after an error
        self.silence_s, self.tries = max(self.silence_s, silence_s), tries
        try:
            yield
        finally:
            self.silence_s, self.tries = usual

    @contextmanager
    def within(self, budget_s: float, silence_s: float) -> Iterator[None]:
        """Set a time budget for the requests inside the block; their caller checks with `affords` whether they fit.

        Args:
            budget_s: time after which all requests must be over.
            silence_s: time that all requests together may wait for answers that do not come; once it is used up, a
                request waits only for the time of its bytes.
        """
        self._end_s, self._left_s = self.port.now_s() + budget_s, silence_s
        try:
            yield
        finally:
            self._end_s = self._left_s = math.inf
            self.judged = True

    def affords(self, bytes_on_wire: int, alone: bool = False) -> bool:
        """Return whether a request of so many bytes, answer included, would end in time even without an answer.

        `alone`: it is for one servo that may be silent, so it is useful only if a full silence is left.
        """
        if alone and self._left_s < self.silence_s:
            return False
        return self.port.now_s() + bytes_on_wire * self._byte_s + min(self.silence_s, self._left_s) <= self._end_s

    def grants(self, purpose: str, bytes_on_wire: int, alone: bool = False, late_s: float = LATE_S) -> bool:
        """Return `affords`, but allow one request, whatever is left, for a purpose that was refused for `late_s`.

        At 57600 baud, or with an adapter that holds every answer back for 16 ms, the first read uses up the budget of
        every poll. Without this exception no lost servo would be found, and no fault would be read.
        """
        if self.affords(bytes_on_wire, alone):
            self._refused_s.pop(purpose, None)
            return True
        now_s = self.port.now_s()
        patience_s = late_s if self._left_s >= self.silence_s else _SPENT_LATE_S
        if now_s - self._refused_s.setdefault(purpose, now_s) < patience_s:
            return False
        del self._refused_s[purpose]
        self._left_s = max(self._left_s, self.silence_s)
        self._end_s = max(self._end_s, now_s + bytes_on_wire * self._byte_s + self.silence_s + _SLACK_S)
        return True

    def wait(self, duration_s: float) -> None:
        """Wait on the port's clock, which may be virtual."""
        if duration_s > 0.0:
            self.port.wait_until(self.port.now_s() + duration_s)

    def rest(self, duration_s: float) -> None:
        """Leave the wire idle, and drop the bytes that come; in virtual time this takes no time."""
        end_s = self.port.now_s() + duration_s
        while self.port.read(_CHUNK, end_s):
            pass

    def adapt(self, servo: int, address: int, length: int) -> float:
        """Measure how long the adapter holds answers back, and set `silence_s` longer than that.

        Returns the `silence_s` that is in force from now on.
        """
        held_s = 0.0
        with self.patient(_ADAPTER_S):
            for _ in range(_SAMPLES):
                asked_s = self.port.now_s()
                if self.read(servo, address, length) is not None:
                    wire_s = self.framing.reads(1, length, "one by one") * self._byte_s
                    held_s = max(held_s, self.port.now_s() - asked_s - wire_s)
        if held_s > self.silence_s:
            self.silence_s = _MARGIN * held_s
            log.warning(
                "%s: an answer is held back for %.1f ms, so a silent servo costs %.1f ms; `sfms-robot doctor` says "
                "what to do",
                self.port.name, held_s * 1e3, self.silence_s * 1e3,
            )  # fmt: skip
        return self.silence_s

    def _incoming(self, first: int, rest: int = 0) -> Iterator[bytes]:
        """Yield bytes as they come, until none comes for the remaining silence; the consumer stops when it has all.

        Args:
            first: number of bytes of the request and of the first answer; their time is added to the first wait.
            rest: number of bytes of the other answers. Noise may add `NO_PATIENCE` silences, but not in a budget.
        """
        port, allowance_s = self.port, min(self.silence_s, self._left_s)
        self.judged = allowance_s >= self.silence_s
        asked_s = port.now_s()
        deadline_s = asked_s + first * self._byte_s + allowance_s
        noise_s = NO_PATIENCE * self.silence_s if self._left_s == math.inf else 0.0
        last_s = deadline_s + rest * self._byte_s + noise_s
        over = False
        while not over:
            over = port.now_s() >= last_s  # bytes that came while this computer was busy still count
            if not (data := port.read(_CHUNK, min(deadline_s, last_s))):
                break
            deadline_s = port.now_s() + allowance_s
            yield data
        self._left_s = max(0.0, self._left_s - min(allowance_s, port.now_s() - asked_s))


# --- verified writes ------------------------------------------------------------------------------------------------


class Silent(ServoError):
    """Error about a servo that did not answer, as opposed to one that refuses."""


def verified_write(
    link: RegisterLink,
    servo_id: int,
    field: Field,
    value: int,
    *,
    lock: Field | None = None,
    tries: int = TRIES,
    about: str | None = None,
) -> Steps[None]:
    """Write one register, read it back, and repeat until it holds `value`. Startup and tools have no other retry rule.

    An acknowledgement proves nothing. A missing one may have been lost, or the status return level may forbid it. A
    locked EEPROM of Dynamixel 1.0 or Feetech acknowledges a write and ignores it. Only the value read back counts.

    Args:
        lock: the register that opens the EEPROM (0) and closes it (1), for a field behind such a lock. Once it was
            opened, it is closed again even if a write fails or its answer is lost.
        tries: number of writes before giving up. A refusal, a silence and another value read back all count, since
            a corrupted request can look like any of them.
        about: name of the servo in messages; `id 5` by default.

    Yields between exchanges: 0.0, or `link.silence_s` after a silence, so that a running bus ends its tick there. One
    exchange blocks at most `link.silence_s` beyond the time that its bytes take.

    Raises Silent if no read back was answered, ServoError for a value that does not fit, is refused or not taken,
    BusError if the port is gone.
    """
    write = partial(_write, link, servo_id, about or f"id {servo_id}", tries)
    if lock is None or not field.eeprom:  # RAM, or an EEPROM without a lock (Dynamixel 2.0)
        yield from write(field, value)
        return
    try:
        yield from write(lock, 0)
        yield from write(field, value)
    except BaseException:  # also if the caller closes this generator early
        link.write(servo_id, lock.address, lock.to_bytes(1))
        raise
    yield from write(lock, 1)


def _write(link: RegisterLink, servo_id: int, name: str, tries: int, field: Field, value: int) -> Steps[None]:
    try:
        data = field.to_bytes(value)
    except OverflowError:
        raise ServoError(f"{name}: {field.name} = {value} does not fit the register") from None
    failure: ServoError = Silent(f"{name} does not answer to {field.name} := {value}")
    for _ in range(tries):
        answer = link.write(servo_id, field.address, data)
        if answer is not None and (refusal := link.refusal(answer)):
            failure = ServoError(f"{name} refuses {field.name} := {value}: {refusal}")
            yield 0.0
            continue
        yield 0.0 if answer is not None else link.silence_s
        seen = link.read(servo_id, field.address, field.size)
        if seen is None or len(seen.data) != field.size:
            yield link.silence_s
        elif (now := field.from_bytes(seen.data)) == value:
            yield 0.0
            return
        else:
            failure = ServoError(f"{name}: {field.name} was set to {value} and reads {now}")
            yield 0.0
    raise failure


def finish(steps: Steps[T], wait: Callable[[float], None] = lambda duration_s: None) -> T:
    """Run work in steps to its end; return its result.

    Args:
        wait: called between two exchanges with the seconds to wait. An exception in it ends the work.
    """
    with closing(steps):
        while True:
            try:
                pause_s = next(steps)
            except StopIteration as end:
                result: T = end.value
                return result
            wait(pause_s)


# --- two servos with one id -----------------------------------------------------------------------------------------


def looks_double(port: Port, protocol: int, servo: int, silence_s: float) -> bool:
    """Ping one id; return whether two servos seem to have it. `protocol` is 2, or 1 (also for Feetech).

    Two servos with one id answer together, so the ping causes two answers, or bytes that belong to no answer, which a
    link drops. Two servos of one model that answer at the very same time look like one servo: only a wire with a single
    servo on it is certain. Blocks until no byte came for `silence_s`.
    """
    if protocol == 2:
        sent = dxl2.encode_instruction(servo, dxl2.PING)
    else:
        sent = protocol1.encode(servo, protocol1.PING)
    port.discard_input()
    port.write(sent)
    data = bytearray()
    for _ in range(_MOST_READS):
        part = port.read(_CHUNK, port.now_s() + silence_s)
        if not part:
            break
        data += part
    if data.startswith(sent):  # an adapter that receives its own bytes
        del data[: len(sent)]
    total = len(data)
    if protocol == 2:
        packets = [each for each in iter(partial(dxl2.maybe_packet, data), None) if each.instruction == dxl2.STATUS]
        found = [(each.servo, dxl2.STATUS_OVERHEAD + len(each.params)) for each in packets]
    else:
        found = [(frame.servo, protocol1.OVERHEAD + len(frame.params)) for frame in protocol1.salvage(data)]
    return [each for each, _ in found].count(servo) > 1 or total > sum(size for _, size in found)
