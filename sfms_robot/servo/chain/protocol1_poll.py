"""Two ways to read the servos of a wire in one poll: all by one request, or one by one in rotation.

Both say who answered and who is suspect. On a chain each servo waits for the answer of the one before it, so where the
answers to one request stop, exactly one servo is suspect, and those behind it are asked again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from sfms_robot.servo.chain.link import Answer
from sfms_robot.servo.chain.protocol1_link import Frame1Link

_REQUESTS: Final = 3  # group reads in one poll at most
_SILENCES: Final = 2  # single reads in one poll that may stay unanswered
_TURNAROUND_S: Final = 0.0005  # host and servo, between a request and its answer
_FRAMES: Final = 14  # bytes of request and answer beside the data

GroupRead = Callable[[int, int, Sequence[int]], Mapping[int, Answer]]


@dataclass
class Sweep:
    """What one poll brought. `gaps`: ids where answers stopped; `missed`: ids that were passed over."""

    answers: dict[int, Answer] = field(default_factory=dict)
    gaps: list[int] = field(default_factory=list)
    missed: list[int] = field(default_factory=list)
    requests: int = 0
    retries: int = 0


def ask_together(read: GroupRead, block: tuple[int, int], servos: Sequence[int], quiet_polls: int) -> Sweep:
    """All by one request, and those behind a silent one by a second.

    When nothing at all comes, the wire gets a second chance before its first servo is suspected.
    """
    sweep = Sweep()
    rest = list(servos)
    for attempt in range(_REQUESTS):
        if not rest or (not sweep.answers and attempt > min(quiet_polls, 1)):
            break
        sweep.requests += 1
        sweep.retries += attempt > 0
        got = read(*block, rest)
        sweep.answers |= got
        last = max((i for i, servo in enumerate(rest) if servo in got), default=-1)
        sweep.missed += [servo for servo in rest[: last + 1] if servo not in got]
        sweep.gaps += rest[last + 1 : last + 2]
        rest = rest[last + 2 :]
    return sweep


class InTurn:
    """One by one, as many per poll as the budget allows, going on where the last poll left off.

    Args:
        servos: all ids of the wire, in order.
        block: (address, length) of what is read.
        budget_s: time for reading in one poll.
    """

    def __init__(self, servos: Sequence[int], block: tuple[int, int], baud: int, budget_s: float) -> None:
        self._place = {servo: i for i, servo in enumerate(servos)}
        self._block = block
        self._budget_s = budget_s
        self._many = max(1, int(budget_s / ((_FRAMES + block[1]) * 10.0 / baud + _TURNAROUND_S)))
        self._turn = 0

    def ask(self, link: Frame1Link, servos: Sequence[int]) -> Sweep:
        """Ask the next of `servos`."""
        sweep = Sweep()
        began_s = link.port.now_s()
        order = sorted(servos, key=lambda servo: (self._place[servo] - self._turn) % len(self._place))
        for servo in order[: self._many]:
            self._turn = (self._place[servo] + 1) % len(self._place)
            sweep.requests += 1
            answer = link.read(servo, *self._block)
            if answer is None:
                sweep.gaps.append(servo)
            else:
                sweep.answers[servo] = answer
            if len(sweep.gaps) >= _SILENCES or link.port.now_s() - began_s > self._budget_s:
                break
        return sweep
