"""A Lynxmotion SSC-32 as a bus. The rules of every hobby board are in `hobby`; these are the SSC-32's own.

Its wire is slow (9600 baud unless its jumpers say otherwise), so goals arrive a few times a second. Each group move is
therefore given the time since the one before it: the board draws a straight line between goals instead of steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from sfms_robot.config import Bus as BusConfig
from sfms_robot.frames import Doubles
from sfms_robot.ports import TickConversion
from sfms_robot.servo.boards.board_protocol import Ask, Health
from sfms_robot.servo.boards.pulse_bus import PulseBus
from sfms_robot.servo.codecs import ssc32
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port

READ_DEADLINE_S: Final = 0.02
_PULSE_FRAME_S: Final = 0.02  # a servo hears a pulse this often: no need to draw lines within
_LONGEST_LINE_S: Final = 0.5


class _Ssc32:
    """`hobby.BoardProtocol` of an SSC-32, which has no error word: it answers, or it does not."""

    answer_length = 1

    def question(self, lost: bool) -> bytes:
        """When it was lost, a carriage return in front ends whatever line noise had begun."""
        return b"\r" * lost + ssc32.query_moving()

    def health(self, answer: bytes) -> Health | None:
        return Health() if answer in (ssc32.DONE, ssc32.MOVING) else None

    def pulses(self, ask: Ask, channels: Sequence[int]) -> dict[int, int] | None:
        """None: it tells its pulses in steps of 10 us, and for a channel that it never moved nobody says what."""
        return None

    def goals(self, ticks: Mapping[int, int], interval_s: float) -> bytes:
        line_s = min(interval_s, _LONGEST_LINE_S) if interval_s > _PULSE_FRAME_S else 0.0
        return ssc32.group_move({channel: ssc32.Move(us) for channel, us in ticks.items()}, round(line_s * 1e3))

    def off(self, channels: Sequence[int]) -> bytes:
        return ssc32.outputs_low(channels)


class Ssc32Bus(PulseBus):
    """One SSC-32, as `ports.Bus`; see `hobby.PulseBus` for what is true of it."""

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: Callable[[], Port],
        baud: int,
        read_deadline_s: float = READ_DEADLINE_S,
        *,
        confirmed: bool = False,
        rest_rad: Doubles | None = None,
        config: BusConfig | None = None,
    ) -> None:
        super().__init__(
            name, servos, conversion, open_port, baud, read_deadline_s,
            dialect=_Ssc32(), confirmed=confirmed, rest_rad=rest_rad, config=config,
        )  # fmt: skip
