"""Protocols of boards for hobby servos (the bytes to and from each kind), and a port for answers without a frame.

Pololu Maestro (User's Guide, pololu.com/docs/0J40, sections 4.a, 4.e, 5.d and 5.e):

1. Get Errors (A1) clears the errors, and shows that the board is there. A board in the serial mode "UART, detect baud
   rate" ignores all bytes before the baud indication byte AA. This byte is sent only if the board does not answer: a
   board that already runs may treat AA alone as a protocol error.
2. Any error moves the channels to their home positions; with factory settings that means pulses off. So all goals are
   sent again after an error.
3. A board may have "Enable CRC" on. Nothing on the wire reports this, so it is set in the head's file (`crc`). A board
   that expects a CRC and gets none waits for it and never answers. A board that gets an unexpected CRC has already
   answered before the CRC arrives. `connect` checks for both.
4. All models except the Micro Maestro (6 channels) accept the targets of neighbouring channels in one Set Multiple
   Targets (9F).

Lynxmotion SSC-32: its wire is slow (9600 baud unless its jumpers select another rate), so goals arrive a few times a
second. Each group move therefore contains the time since the previous move: the board then interpolates linearly
between goals instead of moving in steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from sfms_robot.config.wire_time import BITS
from sfms_robot.errors import ConfigError
from sfms_robot.ports import TickConversion
from sfms_robot.servo.bus import tick_ranges
from sfms_robot.servo.codecs import maestro, ssc32
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table, consecutive

_CHUNK: Final = 4096
_CURE: Final = "for this bus in the head's file, or change 'Enable CRC' in Pololu's Maestro Control Center"
_CRC_TRIES: Final = 2  # the bytes of the first try may complete a command that the board is still waiting for
TRIES: Final = 3  # tries of a request, each with and without the bytes that a restarted board needs
_MICRO: Final = 6  # channels of the Micro Maestro, the only model without Set Multiple Targets
_SLOW_RAD_S: Final = 3.5  # speed of a slow hobby servo under load: 0.3 s for 60 degrees
_LONGEST_TRAVEL_S: Final = 0.7  # longest wait of `enable` for one joint
_PULSE_FRAME_S: Final = 0.02  # pulse period of an SSC-32; shorter moves need no interpolation
_LONGEST_LINE_S: Final = 0.5


class RateLimitedPort:
    """An open port that tracks when its bytes have left, for requests whose answers have no frame.

    At 9600 baud a command is still being transmitted for a fifth of a second after `write` has returned. Sending more
    before that only fills a buffer.

    Args:
        port: owned by this object from now on.
        patience_s: longest delay of an answer, in addition to the transmission time of its bytes.

    Attributes:
        busy_until_s: time at which the last byte sent will have left.
        awaiting: True while a request is waiting for its answer.
    """

    def __init__(self, port: Port, baud: int, patience_s: float) -> None:
        self.port = port
        self.busy_until_s = port.now_s()
        self.awaiting = False
        self._byte_s = BITS / baud
        self._patience_s = patience_s
        self._answer = bytearray()
        self._length = 0
        self._until_s = 0.0

    @property
    def free(self) -> bool:
        """Return whether all bytes sent have left."""
        return self.port.now_s() >= self.busy_until_s

    def send(self, data: bytes) -> float:
        """Send bytes; return when the first of them leaves. Raises BusError if the port is gone, like all methods."""
        start_s = max(self.port.now_s(), self.busy_until_s)
        self.port.write(data)
        self.busy_until_s = start_s + len(data) * self._byte_s
        return start_s

    def wait(self, until_s: float) -> None:
        """Block until `until_s`; drop the bytes that arrive meanwhile."""
        while self.port.now_s() < until_s and self.port.read(_CHUNK, until_s):
            pass

    def request(self, request: bytes, length: int) -> None:
        """Send a request for `length` bytes without waiting; `answer` returns them."""
        self.port.discard_input()
        self.send(request)
        self.awaiting = True
        self._answer.clear()
        self._length = length
        self._until_s = self.busy_until_s + length * self._byte_s + self._patience_s

    def answer(self, block: bool = False) -> bytes | None:
        """Return the answer; b"" if it did not come, or has another length; None while it may still come."""
        deadline_s = self._until_s if block else self.port.now_s()
        while len(self._answer) < self._length and (data := self.port.read(_CHUNK, deadline_s)):
            self._answer += data
        if len(self._answer) < self._length and not block and self.port.now_s() < self._until_s:
            return None
        self.awaiting = False
        return bytes(self._answer) if len(self._answer) == self._length else b""

    def exchange(self, request: bytes, length: int) -> bytes | None:
        """Send a request, block until the answer is complete or overdue, and return it; None if the length differs."""
        self.request(request, length)
        return self.answer(block=True) or None


class BoardStatus(NamedTuple):
    """The status of a board: faults since the last request, in words."""

    faults: str = ""
    lasting: bool = False  # the fault is in the board, not only in the bytes it received
    went_home: bool = False  # the board has moved its channels to their home positions, or switched them off


class PulseOutput:
    """The state of one channel of a board.

    Attributes:
        releases: True if torque off switches the channel off; otherwise its joint holds.
        enabled: True if it receives goals.
        waiting: True if it is enabled but off, until its turn to be switched on.
        resting: True if it was switched off by `release`, or by torque off, until it is switched on again.
        pulse: pulse that the board last reported [ticks], 0 for none.
        sent: ticks last sent.
        arrived: True if its pulse came on again since the last reading.
    """

    def __init__(self, index: int, servo: BusServo) -> None:
        self.index = index
        self.channel = servo.id
        self.servo = servo
        self.releases = servo.safety.stop == "release"
        # Time in which a slow servo crosses the joint's range.
        self.travel_s = min((servo.max_rad - servo.min_rad) / _SLOW_RAD_S, _LONGEST_TRAVEL_S)
        self.enabled = self.waiting = self.resting = self.arrived = False
        self.pulse = 0
        self.sent: int | None = None
        self.fault: str | None = None


@dataclass(frozen=True)
class Maestro:
    """The bytes to and from a Pololu Maestro, with the compact protocol.

    Attributes:
        table: table of its model.
        crc: whether its setting "Enable CRC" is on, according to the head's file.
        status_length: length of the answer to `status_request` [bytes].
        factory_us: (shortest, longest) pulse that its factory settings allow, if they are narrower than the board.
        reports_pulses: whether `read_pulses` works.
    """

    table: Table
    crc: bool
    status_length = 2
    factory_us = maestro.FACTORY_PULSE_US
    reports_pulses = True

    def _sealed(self, command: bytes) -> bytes:
        return maestro.sealed(command) if self.crc else command

    def status_request(self, restarted: bool) -> bytes:
        """Return a request for the status; `restarted`: the board may have been off since it last answered."""
        return bytes([maestro.BAUD_INDICATION] * restarted) + self._sealed(maestro.get_errors())

    def decode_status(self, answer: bytes) -> BoardStatus | None:
        """Return the status in an answer; None for bytes that are not an answer."""
        bits = int.from_bytes(answer, "little")
        if len(answer) != self.status_length or bits >> (max(self.table.faults, default=15) + 1):
            return None
        return BoardStatus(", ".join(self.table.faults_in(bits)), bool(bits & ~maestro.WIRE_ERRORS), bits != 0)

    def encode_goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        """Return the bytes that move channels to `ticks`, `interval_s` after the previous goals; 0 for the first."""
        grouped = (self.table.channels or 0) > _MICRO  # one command can move neighbouring channels
        runs = consecutive(ticks) if grouped else [[channel] for channel in sorted(ticks)]
        commands = (
            maestro.set_targets(run[0], [ticks[channel] for channel in run])
            if len(run) > 1
            else maestro.set_target(run[0], ticks[run[0]])
            for run in runs
        )
        return b"".join(map(self._sealed, commands))

    def encode_off(self, channels: Sequence[int], restarted: bool) -> bytes:
        """Return the bytes that end the pulses after any other bytes; `restarted` as in `status_request`."""
        off = b"".join(self._sealed(maestro.set_target(channel, maestro.OFF)) for channel in channels)
        return bytes([maestro.BAUD_INDICATION] * restarted) + off

    def misfit(self, wire: RateLimitedPort, present: bool) -> str | None:
        """Return how the board's settings differ from the head's file, and the correction; None if they agree.

        `present`: the board has answered `status_request`.
        """

        def answers(request: bytes) -> bool:
            return self.decode_status(wire.exchange(request, self.status_length) or b"") is not None

        question = maestro.get_errors()
        if not self.crc:
            differs = not present and any(answers(maestro.sealed(question)) for _ in range(_CRC_TRIES))
            return f"expects a CRC: set crc: true {_CURE}" if differs else None
        if answers(question):
            return f"expects no CRC: set crc: false {_CURE}"
        answers(bytes([maestro.crc7(question)]))  # the CRC of the request above, for which the board is waiting
        return None

    def read_pulses(self, wire: RateLimitedPort, channels: Sequence[int]) -> dict[int, int] | None:
        """Return the present pulses [ticks] by channel, 0 for none; None if a request for a channel is not answered."""
        pulses = {}
        for channel in channels:
            answer = wire.exchange(self._sealed(maestro.get_position(channel)), 2)
            if answer is None:
                return None
            pulses[channel] = int.from_bytes(answer, "little")
        return pulses


class Ssc32:
    """The bytes to and from a Lynxmotion SSC-32, with the methods of `Maestro`.

    It has no error register: it answers, or it does not. It reports pulses in steps of 10 us, and the value for a
    channel that it never moved is not documented, so `read_pulses` returns None.
    """

    status_length = 1
    factory_us = None
    reports_pulses = False

    def status_request(self, restarted: bool) -> bytes:
        """Return a query; after a restart it begins with a carriage return, to end a line begun by line noise."""
        return b"\r" * restarted + ssc32.query_moving()

    def decode_status(self, answer: bytes) -> BoardStatus | None:
        return BoardStatus() if answer in (ssc32.DONE, ssc32.MOVING) else None

    def encode_goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        line_s = min(interval_s, _LONGEST_LINE_S) if interval_s > _PULSE_FRAME_S else 0.0
        return ssc32.group_move({channel: ssc32.Move(us) for channel, us in ticks.items()}, round(line_s * 1e3))

    def encode_off(self, channels: Sequence[int], restarted: bool) -> bytes:
        """Return the command after a carriage return, since another thread may have been in the middle of a line."""
        return b"\r" + ssc32.outputs_low(channels)

    def misfit(self, wire: RateLimitedPort, present: bool) -> str | None:
        """Return None: the board has no settings that could differ."""
        return None

    def read_pulses(self, wire: RateLimitedPort, channels: Sequence[int]) -> dict[int, int] | None:
        """Return None."""
        return None


def board_for(table: Table, crc: bool) -> Maestro | Ssc32:
    """Return the protocol of a board. `crc`: its setting in the head's file."""
    return Maestro(table, crc) if table.family == "maestro" else Ssc32()


def answers(board: Maestro | Ssc32, wire: RateLimitedPort, tries: int = 2 * TRIES, restarted: bool = False) -> bool:
    """Return whether the board answers. Blocks for at most `tries` answers.

    `restarted` is for the first request, see `status_request`. A request clears the errors of a board. So a board that
    reports damaged bytes every time does not read what is sent: it has another setting, or is not such a board.
    """
    for _ in range(tries):
        answer = wire.exchange(board.status_request(restarted), board.status_length)
        status = None if answer is None else board.decode_status(answer)
        if status is not None and (status.lasting or not status.went_home):  # not only a report of damaged bytes
            return True
        restarted = status is None and not restarted
    return False


def board_problem(table: Table, board: Maestro | Ssc32, wire: RateLimitedPort) -> str | None:
    """Return why a head cannot run with the board on a port, None if it can. Run and doctor share this rule."""
    there = answers(board, wire)
    if misfit := board.misfit(wire, there):
        return f"the {table.model} {misfit}"
    return None if there else f"no {table.model} answers"


def board_of(bus: str, servos: Sequence[BusServo]) -> Table:
    """Return the table of the board of these servos. Raises ConfigError if they are not all on one board."""
    table = servos[0].table
    others = sorted({servo.table.model for servo in servos} - {table.model})
    if others:
        raise ConfigError(f"bus {bus!r}: one board has one model, the head names {table.model} and {', '.join(others)}")
    if table.channels is None or table.pulse_us is None or table.tick_us is None:
        raise ConfigError(f"bus {bus!r}: expected a servo board, got {table.model}")
    for servo in servos:
        if servo.id >= table.channels:
            raise ConfigError(
                f"bus {bus!r}: joints.{servo.joint}.id: expected a channel of a {table.model} "
                f"(0..{table.channels - 1}), got {servo.id}"
            )
    return table


def pulses_beyond(
    servos: Sequence[BusServo], conversion: TickConversion, table: Table, range_us: tuple[float, float] | None
) -> str:
    """Return the joints whose pulses do not all lie in `range_us` (shortest, longest), each with its pulses."""
    if range_us is None:
        return ""
    pulses = tick_ranges(servos, conversion) * (table.tick_us or 1.0)
    return ", ".join(
        f"{servo.joint} ({low:g}..{high:g} us, not in {range_us[0]:g}..{range_us[1]:g})"
        for servo, low, high in zip(servos, *pulses, strict=True)
        if low < range_us[0] or high > range_us[1]
    )
