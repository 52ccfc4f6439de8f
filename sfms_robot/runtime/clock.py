"""Loop time: seconds from 0, real or virtual, and the pacer that turns it into ticks.

A tick has an absolute deadline, so work never makes the rate drift. A tick that starts late is counted; ticks
that were missed altogether are skipped, never chased: catching up would mean moving the head faster.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

from sfms_robot.ports import Clock


class RealClock:
    """Monotonic time since construction."""

    def __init__(self) -> None:
        self._origin_s = time.monotonic()

    def now_s(self) -> float:
        return time.monotonic() - self._origin_s

    def wait_until(self, time_s: float) -> None:
        delay_s = time_s - self.now_s()
        if delay_s > 0:
            time.sleep(delay_s)


class VirtualClock:
    """Time that jumps to where it is asked to be, and never runs by itself."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until(self, time_s: float) -> None:
        self._now_s = max(self._now_s, time_s)


@dataclass(frozen=True)
class Beat:
    """One tick: its nominal time, how late it started, and how many ticks were skipped before it."""

    time_s: float
    late_s: float
    skipped: int


def beats(clock: Clock, rate_hz: float) -> Iterator[Beat]:
    """Endless ticks at `rate_hz` from the clock's present time on; nominal times are exact multiples."""
    period_s = 1.0 / rate_hz
    start_s = clock.now_s()
    index = 0
    while True:
        due_s = start_s + index * period_s
        clock.wait_until(due_s)
        late_s = max(0.0, clock.now_s() - due_s)
        skipped = int(late_s / period_s)
        index += skipped
        yield Beat(start_s + index * period_s, late_s - skipped * period_s if skipped else late_s, skipped)
        index += 1
