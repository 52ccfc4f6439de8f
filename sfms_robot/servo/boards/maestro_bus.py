"""A Pololu Maestro as a bus: its protocol and its checks. `pulse_bus` holds what all boards share.

1. Get Errors (A1) clears them, and shows that the board is there. One in the serial mode "UART, detect baud rate"
   takes nothing before the baud indication byte AA, which is sent only when it does not answer: a board that runs
   may take AA alone for a protocol error.
2. Any error sends the channels to their home, which from the factory is no pulses at all. So after an error that it
   reports all goals are sent anew.
3. A board may have "Enable CRC" on, which nothing on the wire says, so the head's file does (`crc`). A board that
   expects a CRC and gets none waits for it and never answers; one that gets a CRC it does not expect has answered
   before the CRC is there. `connect` looks for both.
4. All but the Micro Maestro (6 channels) take the targets of neighbouring channels in one Set Multiple Targets (9F).

Source: Pololu Maestro Servo Controller User's Guide, pololu.com/docs/0J40, sections 4.a, 4.e, 5.d and 5.e.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from sfms_robot.servo.boards.board_protocol import BoardStatus, Exchange, pulses_beyond
from sfms_robot.servo.boards.pulse_bus import PulseBus
from sfms_robot.servo.codecs import maestro
from sfms_robot.servo.registers import Table

log = logging.getLogger(__name__)

_CURE: Final = "for this bus in the head's file, or change 'Enable CRC' in Pololu's Maestro Control Center"
_TRIES: Final = 2  # what the board still waits for may cost it the first
_MICRO: Final = 6  # channels of the one board without "set multiple targets"


class _Maestro:
    """`board_protocol.BoardProtocol` of a Maestro, whose setting "Enable CRC" is `crc`."""

    def __init__(self, table: Table, crc: bool) -> None:
        self._table = table
        self._crc = crc
        self._sealed: Callable[[bytes], bytes] = maestro.sealed if crc else bytes
        self._groups = (table.channels or 0) > _MICRO

    status_length = 2
    reports_pulses = True

    def status_request(self, restarted: bool) -> bytes:
        return bytes([maestro.BAUD_INDICATION] * restarted) + self._sealed(maestro.get_errors())

    def misfit(self, exchange: Exchange, present: bool) -> str | None:
        def answers(request: bytes) -> bool:
            return self.decode_status(exchange(request, self.status_length) or b"") is not None

        question = maestro.get_errors()
        if not self._crc:
            differs = not present and any(answers(maestro.sealed(question)) for _ in range(_TRIES))
            return f"expects a CRC: set crc: true {_CURE}" if differs else None
        if answers(question):
            return f"expects no CRC: set crc: false {_CURE}"
        answers(bytes([maestro.crc7(question)]))  # the board has been waiting for it
        return None

    def decode_status(self, answer: bytes) -> BoardStatus | None:
        bits = int.from_bytes(answer, "little")
        if len(answer) != self.status_length or bits >> (max(self._table.faults, default=15) + 1):
            return None
        return BoardStatus(self._table.fault_names(bits), bool(bits & ~maestro.WIRE_ERRORS), bits != 0)

    def read_pulses(self, exchange: Exchange, channels: Sequence[int]) -> dict[int, int] | None:
        pulses = {}
        for channel in channels:
            answer = exchange(self._sealed(maestro.get_position(channel)), 2)
            if answer is None:
                return None
            pulses[channel] = int.from_bytes(answer, "little")
        return pulses

    def encode_goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        runs: list[list[int]] = []  # of channels that one command can take
        for channel in sorted(ticks):
            if self._groups and runs and channel == runs[-1][-1] + 1:
                runs[-1].append(channel)
            else:
                runs.append([channel])
        commands = (
            maestro.set_targets(run[0], [ticks[channel] for channel in run])
            if len(run) > 1
            else maestro.set_target(run[0], ticks[run[0]])
            for run in runs
        )
        return b"".join(map(self._sealed, commands))

    def encode_off(self, channels: Sequence[int], restarted: bool) -> bytes:
        off = b"".join(self._sealed(maestro.set_target(channel, maestro.OFF)) for channel in channels)
        return bytes([maestro.BAUD_INDICATION] * restarted) + off


class MaestroBus(PulseBus):
    """One Maestro with the compact protocol, as `ports.Bus`; see `pulse_bus.PulseBus` for what is true of it."""

    def _protocol_of(self, table: Table) -> _Maestro:
        if wide := pulses_beyond(self._servos, self._conversion, table, maestro.FACTORY_PULSE_US):
            joints = ", ".join(wide)
            log.warning("bus %r: set wider limits in the Maestro itself, over USB, for %s", self.name, joints)
        return _Maestro(table, self._crc)
