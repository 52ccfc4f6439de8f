"""A Pololu Maestro as a bus. What all boards have in common is in `pulse_bus`; this is the Maestro's own.

1. Get Errors (A1) clears them, and shows that the board is there. One in the serial mode "UART, detect baud rate"
   takes nothing before the baud indication byte AA, which is sent only when it does not answer: to one that is
   running, AA alone may be a protocol error.
2. Any error sends the channels to their home, which from the factory is no pulses at all. So after an error that it
   reports all goals are sent anew.
3. All but the Micro Maestro (6 channels) take the targets of neighbouring channels in one Set Multiple Targets (9F).

Source: Pololu Maestro Servo Controller User's Guide, pololu.com/docs/0J40, sections 4.a, 4.e and 5.e.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Final

from sfms_robot.servo.boards.board_protocol import BoardStatus, Exchange, pulses_beyond
from sfms_robot.servo.boards.pulse_bus import PulseBus
from sfms_robot.servo.codecs import maestro
from sfms_robot.servo.registers import Table

log = logging.getLogger(__name__)

_MICRO: Final = 6  # channels of the one board without "set multiple targets"


class _Maestro:
    """`board_protocol.BoardProtocol` of a Maestro."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._groups = (table.channels or 0) > _MICRO

    status_length = 2

    def status_request(self, restarted: bool) -> bytes:
        return bytes([maestro.BAUD_INDICATION] * restarted) + maestro.get_errors()

    def decode_status(self, answer: bytes) -> BoardStatus | None:
        bits = int.from_bytes(answer, "little")
        if bits >> (max(self._table.faults, default=15) + 1):
            return None
        return BoardStatus(self._table.fault_names(bits), bool(bits & ~maestro.WIRE_ERRORS), bits != 0)

    def read_pulses(self, exchange: Exchange, channels: Sequence[int]) -> dict[int, int] | None:
        pulses = {}
        for channel in channels:
            answer = exchange(maestro.get_position(channel), 2)
            if answer is None:
                return None
            pulses[channel] = int.from_bytes(answer, "little")
        return pulses

    def encode_goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        if not self._groups:
            return b"".join(maestro.set_target(channel, target) for channel, target in sorted(ticks.items()))
        return b"".join(
            maestro.set_targets(run[0], [ticks[channel] for channel in run])
            if len(run) > 1
            else maestro.set_target(run[0], ticks[run[0]])
            for run in _runs(sorted(ticks))
        )

    def encode_off(self, channels: Sequence[int], restarted: bool) -> bytes:
        off = b"".join(maestro.set_target(channel, maestro.OFF) for channel in channels)
        return bytes([maestro.BAUD_INDICATION] * restarted) + off


def _runs(channels: Sequence[int]) -> list[list[int]]:
    """Ascending channels, cut where a number is left out."""
    runs: list[list[int]] = []
    for channel in channels:
        if runs and channel == runs[-1][-1] + 1:
            runs[-1].append(channel)
        else:
            runs.append([channel])
    return runs


class MaestroBus(PulseBus):
    """One Maestro with the compact protocol, as `ports.Bus`; see `pulse_bus.PulseBus` for what is true of it."""

    def _protocol_of(self, table: Table) -> _Maestro:
        if wide := pulses_beyond(self._servos, self._conversion, table, maestro.FACTORY_PULSE_US):
            joints = ", ".join(wide)
            log.warning("bus %r: set wider limits in the Maestro itself, over USB, for %s", self.name, joints)
        return _Maestro(table)
