"""What a tick has time for: position of every servo always, the rest for as many as still fit.

    tick = goals + positions + what is left for whole blocks (current, velocity, position, voltage, temperature)

Protocol 2.0 arithmetic, 10 bits a byte. A request costs an adapter's turn as well (USB hands bytes over every
millisecond), a servo its return delay, which is set to 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

USE: Final = 0.8  # of a tick; the rest is for probes, retries and a busy computer
TURN_S: Final = 0.001
_REQUEST: Final = 14  # bytes of a sync request without its ids
_STATUS: Final = 11
_FAST_HEAD: Final = 8
_FAST_EACH: Final = 4


def read_bytes(servos: int, length: int, fast: bool) -> int:
    """Bytes on the wire of one sync read of `length` bytes from `servos`, request and answers."""
    if fast:
        reply = _FAST_HEAD + servos * (length + _FAST_EACH)
    else:
        reply = servos * (length + _STATUS)
    return _REQUEST + servos + reply


def read_s(servos: int, length: int, baud: int, fast: bool) -> float:
    """Seconds that such a read takes."""
    return read_bytes(servos, length, fast) * 10.0 / baud + TURN_S


def write_s(servos: int, length: int, baud: int) -> float:
    """Seconds on the wire of one sync write of `length` bytes to `servos`."""
    return (_REQUEST + servos * (length + 1)) * 10.0 / baud


def blocks_per_tick(servos: int, position: int, block: int, goal: int, baud: int, rate_hz: float, fast: bool) -> int:
    """How many servos' blocks fit in a tick beside goals and positions; all of them where one read does for all."""
    budget_s = USE / rate_hz - write_s(servos, goal, baud)
    if read_s(servos, block, baud, fast) <= budget_s:
        return servos
    left_s = budget_s - read_s(servos, position, baud, fast)
    count = 1
    while count < servos and read_s(count + 1, block, baud, fast) <= left_s:
        count += 1
    return count


class Rotation:
    """Everybody's turn, `count` at a time."""

    def __init__(self) -> None:
        self._next = 0

    def take(self, servos: Sequence[int], count: int) -> list[int]:
        """The next `count` of `servos`, in their own order; whoever is missing from the list loses no turn."""
        if count >= len(servos):
            return list(servos)
        start = self._next % len(servos)
        self._next = start + count
        chosen = {servos[(start + k) % len(servos)] for k in range(count)}
        return [servo for servo in servos if servo in chosen]
