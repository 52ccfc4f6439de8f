"""How a board of hobby servos is spoken to, and whether a bus fits on it. `hobby` is the bus, this is what it needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.ports import TickConversion
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Table

Ask = Callable[[bytes, int], bytes | None]
"""Sends a request; the answer, if exactly that many bytes came."""


class Health(NamedTuple):
    """What a board says of itself: faults since it was last asked, in words."""

    faults: str = ""
    lasting: bool = False  # something is wrong with the board, not just with what it heard
    went_home: bool = False  # it has switched its channels off, or to wherever its home is


class BoardProtocol(Protocol):
    """How one kind of board is spoken to. Pure but for `pulses`, which is handed the wire."""

    @property
    def answer_length(self) -> int:
        """Bytes of the answer to `question`."""

    def question(self, lost: bool) -> bytes:
        """Asks the board how it is; `lost`: it may have been switched off since it last answered."""

    def health(self, answer: bytes) -> Health | None:
        """None for what is no answer."""

    def pulses(self, ask: Ask, channels: Sequence[int]) -> dict[int, int] | None:
        """Ticks of the pulses it sends now, 0 for none; None when it does not say."""

    def goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        """Bytes that move channels to `ticks`; the goals before went out `interval_s` ago, 0 for the first."""

    def off(self, channels: Sequence[int]) -> bytes:
        """Bytes that end the pulses."""


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
