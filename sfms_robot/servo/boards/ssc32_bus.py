"""A Lynxmotion SSC-32 as a bus. What all boards have in common is in `pulse_bus`; these are the SSC-32's own.

Its wire is slow (9600 baud unless its jumpers say otherwise), so goals arrive a few times a second. Each group move is
therefore given the time since the one before it: the board draws a straight line between goals instead of steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from sfms_robot.servo.boards.board_protocol import BoardStatus, Exchange
from sfms_robot.servo.boards.pulse_bus import PulseBus
from sfms_robot.servo.codecs import ssc32
from sfms_robot.servo.registers import Table

_PULSE_FRAME_S: Final = 0.02  # a servo hears a pulse this often: no need to draw lines within
_LONGEST_LINE_S: Final = 0.5


class _Ssc32:
    """`board_protocol.BoardProtocol` of an SSC-32, which has no error word: it answers, or it does not."""

    status_length = 1
    reports_pulses = False

    def status_request(self, restarted: bool) -> bytes:
        """After a restart, a carriage return in front ends whatever line noise had begun."""
        return b"\r" * restarted + ssc32.query_moving()

    def misfit(self, exchange: Exchange, present: bool) -> str | None:
        return None

    def decode_status(self, answer: bytes) -> BoardStatus | None:
        return BoardStatus() if answer in (ssc32.DONE, ssc32.MOVING) else None

    def read_pulses(self, exchange: Exchange, channels: Sequence[int]) -> dict[int, int] | None:
        """None: it tells its pulses in steps of 10 us, and for a channel that it never moved nobody says what."""
        return None

    def encode_goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        line_s = min(interval_s, _LONGEST_LINE_S) if interval_s > _PULSE_FRAME_S else 0.0
        return ssc32.group_move({channel: ssc32.Move(us) for channel, us in ticks.items()}, round(line_s * 1e3))

    def encode_off(self, channels: Sequence[int], restarted: bool) -> bytes:
        """A carriage return in front always: another thread may have been in the middle of a line."""
        return b"\r" + ssc32.outputs_low(channels)


class Ssc32Bus(PulseBus):
    """One SSC-32, as `ports.Bus`; see `pulse_bus.PulseBus` for what is true of it."""

    def _protocol_of(self, table: Table) -> _Ssc32:
        return _Ssc32()
