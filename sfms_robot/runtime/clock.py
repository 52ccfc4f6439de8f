"""Loop time: seconds from 0, real or virtual, and the pacer that turns it into ticks.

A tick has an absolute deadline, so work never makes the rate drift. A tick that starts late is counted; ticks
that were missed altogether are skipped, never chased: catching up would mean moving the head faster.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

from sfms_robot.ports import Clock

_SAME = 1e-6  # of a period: a clock this close to a tick is at it


class RealClock:
    """Monotonic time since construction."""

    def __init__(self) -> None:
        self.origin_s = time.monotonic()

    def now_s(self) -> float:
        return time.monotonic() - self.origin_s

    def wait_until(self, time_s: float) -> None:
        delay_s = time_s - self.now_s()
        if delay_s > 0:
            time.sleep(delay_s)


class VirtualClock:
    """Time that jumps to where it is asked to be, and never runs by itself."""

    origin_s = 0.0

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until(self, time_s: float) -> None:
        self._now_s = max(self._now_s, time_s)


@dataclass(frozen=True)
class TickTime:
    """One tick: its nominal time since the start, how late it began, and how many ticks were skipped before it."""

    time_s: float
    late_s: float
    skipped: int


def tick_times(clock: Clock, rate_hz: float, start_s: float) -> Iterator[TickTime]:
    """Endless ticks from now on, at `rate_hz`; nominal times are exact multiples of the period since `start_s`.

    Blocks until each is due.
    """
    index = max(0, math.ceil((clock.now_s() - start_s) * rate_hz - _SAME))
    while True:
        due_s = start_s + index / rate_hz
        clock.wait_until(due_s)
        late_s = max(0.0, clock.now_s() - due_s)
        skipped = int(late_s * rate_hz)
        index += skipped
        yield TickTime(index / rate_hz, late_s - skipped / rate_hz, skipped)
        index += 1
