"""What `pulse_bus.PulseBus` needs of one kind of board: its protocol, and whether a bus fits on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.ports import TickConversion
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Table

Exchange = Callable[[bytes, int], bytes | None]
"""Sends a request; the answer, if exactly that many bytes came."""


class BoardStatus(NamedTuple):
    """What a board says of itself: faults since it was last asked, in words."""

    faults: str = ""
    lasting: bool = False  # something is wrong with the board, not just with what it received
    went_home: bool = False  # it has switched its channels off, or to wherever its home is


class BoardProtocol(Protocol):
    """Bytes to and from one kind of board. Pure but for `misfit` and `read_pulses`, which are handed the port."""

    @property
    def status_length(self) -> int:
        """Bytes of the answer to `status_request`."""

    @property
    def reports_pulses(self) -> bool:
        """Whether the board can report the pulses that it sends."""

    def status_request(self, restarted: bool) -> bytes:
        """Asks the board for its status; `restarted`: it may have been switched off since it last answered."""

    def misfit(self, exchange: Exchange, present: bool) -> str | None:
        """Return how the board is set otherwise than the head's file says, and the cure; None when it is not.

        `present`: it has answered `status_request`.
        """

    def decode_status(self, answer: bytes) -> BoardStatus | None:
        """None for what is no answer."""

    def read_pulses(self, exchange: Exchange, channels: Sequence[int]) -> dict[int, int] | None:
        """Return ticks of the pulses that it sends now, 0 for none; None where a channel is not answered."""

    def encode_goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        """Moves channels to `ticks`; the goals before went out `interval_s` ago, 0 for the first."""

    def encode_off(self, channels: Sequence[int], restarted: bool) -> bytes:
        """Ends the pulses, whatever the bytes before were; `restarted` as in `status_request`."""


def board_of(bus: str, servos: Sequence[BusServo]) -> Table:
    """The board. Raises ConfigError when the servos are not all on one."""
    tables = [Table.of(servo.map) for servo in servos]
    table = tables[0]
    others = sorted({each.model for each in tables} - {table.model})
    if others:
        raise ConfigError(f"bus {bus!r}: one board is one model, the head says {table.model} and {', '.join(others)}")
    if table.channels is None or table.pulse_us is None or table.tick_us is None:
        raise ConfigError(f"bus {bus!r}: {table.model} is no servo board")
    for servo in servos:
        if servo.id >= table.channels:
            raise ConfigError(
                f"bus {bus!r}: joints.{servo.joint}.id = {servo.id} is no channel of a {table.model} "
                f"(0..{table.channels - 1})"
            )
    return table


def pulses_beyond(
    servos: Sequence[BusServo], conversion: TickConversion, table: Table, range_us: tuple[float, float]
) -> list[str]:
    """Joints, each with the pulses of its range, that do not fit between (shortest, longest)."""
    ends = [conversion.to_ticks(np.array([getattr(servo, end) for servo in servos])) for end in ("min_rad", "max_rad")]
    pulses = np.sort(np.stack(ends), axis=0) * (table.tick_us or 1.0)
    return [
        f"{servo.joint} ({low:g}..{high:g} us, not in {range_us[0]:g}..{range_us[1]:g})"
        for servo, low, high in zip(servos, *pulses, strict=True)
        if low < range_us[0] or high > range_us[1]
    ]
