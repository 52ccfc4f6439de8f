"""Bytes of a request and its answers on the wire, in every family, and the time that bytes take.

The highest rate of a bus, the time of a poll and the doctor's budget use these counts. Tests compare them with the
bytes between the buses and emulated servos. The bytes of a board depend on the goals (adjacent channels, digits of a
pulse); for boards the counts are upper bounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

BITS: Final = 10  # bits per byte on the wire: start bit, eight data bits, stop bit
Way = Literal["together", "fast", "one by one"]


class Framing(NamedTuple):
    """Bytes of a family's packets in addition to the data.

    Attributes:
        goal: data of one goal position, unless a model has another size.
        write, write_each: a write to several servos; more for each servo in it.
        read: a read request to one servo.
        answer: the answer of one servo.
        group, group_each: a read request to several servos; more for each servo in it.
        fast, fast_each: the one packet in which all servos answer a fast read; more for each servo in it.
        longest: the longest packet: for both Dynamixel protocols the longest that the vendor's SDK builds; a Feetech
            packet has a length of one byte. 0: no limit.
    """

    goal: int
    write: int
    write_each: int
    read: int = 0
    answer: int = 0
    group: int = 0
    group_each: int = 0
    fast: int = 0
    fast_each: int = 0
    longest: int = 0

    def goals(self, servos: int, length: int | None = None) -> int:
        """Return the bytes of one write of `length` bytes (default: a goal) to each of `servos`; no servo answers."""
        return self.write + servos * (self.write_each + (self.goal if length is None else length))

    def answers(self, servos: int, length: int, fast: bool = False) -> int:
        """Return the bytes of the answers of `servos` with `length` bytes of data each."""
        return self.fast + servos * (self.fast_each + length) if fast else servos * (self.answer + length)

    def reads(self, servos: int, length: int, way: Way = "together") -> int:
        """Return the bytes of reading `length` bytes of each of `servos`, requests and answers."""
        request = servos * self.read if way == "one by one" else self.group + servos * self.group_each
        return request + self.answers(servos, length, way == "fast")


FRAMINGS: Final[Mapping[str, Framing]] = {  # by bus family
    "dynamixel2": Framing(4, 14, 1, read=14, answer=11, group=14, group_each=1, fast=8, fast_each=4, longest=1024),
    "dynamixel1": Framing(2, 8, 1, read=8, answer=6, group=7, group_each=3, longest=250),
    "feetech": Framing(2, 8, 1, read=8, answer=6, group=8, group_each=1, longest=259),
    "maestro": Framing(2, 0, 2),  # 84 channel low high; for adjacent channels "multiple targets" needs fewer bytes
    "ssc32": Framing(4, 5, 4),  # #12P1500 for each channel, then T500 and a carriage return
}
