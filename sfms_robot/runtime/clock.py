"""Clocks of the loop, real and virtual, in seconds from 0; its ticks; and a listener that is stepped in virtual time.

A tick has an absolute deadline, so work never makes the rate drift. A tick that starts late is counted. Ticks that were
missed altogether are skipped and never made up for, because catching up would mean moving the head faster.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Clock, Facts, Listener

FAST_LATENCY_S: Final = 0.010  # in virtual time a plan becomes visible this long after its last speaker frame
BUSY_S: Final = 0.04  # smallest lateness that is reported: one frame of the face
SHOWN_S: Final = 2.0  # an incident is over this long after its last late tick
LOGGED_EVERY_S: Final = 60.0
log = logging.getLogger(__name__)

_SAME: Final = 1e-6  # share of a period: a clock this close to a tick counts as being at it
# Statistics of a feed whose steps have no duration and that skips no frame.
IDLE_FEED: Final[Facts] = {
    "state": "listening", "restarts": 0, "skipped_frames": 0, "step_ms": {"p50": None, "p99": None},
}  # fmt: skip


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
    """Clock whose time advances only in `wait_until`."""

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
    """Yield ticks at `rate_hz` without end; nominal times are exact multiples of the period since `start_s`.

    Blocks until each tick is due.
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


class TickPace:
    """Detector of late ticks: those close together are one incident, with a log message and a text.

    Attributes:
        busy: text that the page shows during an incident; None without one.
    """

    def __init__(self) -> None:
        self.busy: str | None = None
        self._worst_s = 0.0
        self._last_s = self._logged_s = -math.inf
        self._unlogged = 0

    def judge(self, time_s: float, late_s: float, worked_s: float) -> None:
        """Judge a tick that began `late_s` after its deadline; the loop computed for `worked_s` in the tick before."""
        if late_s < BUSY_S:
            if self.busy is not None and time_s - self._last_s > SHOWN_S:
                self.busy, self._worst_s = None, 0.0
            return
        begins, self._last_s = self.busy is None, time_s
        if late_s > self._worst_s:
            self._worst_s, self.busy = late_s, f"too busy for {late_s * 1e3:.0f} ms"
        if time_s - self._logged_s < LOGGED_EVERY_S:
            self._unlogged += begins
            return
        cause = "its own work takes too long" if worked_s > late_s / 2 else "other programs use its processors"
        again = f" ({self._unlogged} times more since the last message)" if self._unlogged else ""
        text = "this computer was too busy for %.0f ms: %s; the head moves late, no servo is at fault%s"
        log.warning(text, late_s * 1e3, cause, again)
        self._logged_s, self._unlogged = time_s, 0


class InlineFeed:
    """A `ports.PlanFeed` that steps the listener in `push`, so that runs with the same seed are identical.

    A plan becomes visible `FAST_LATENCY_S` after its frame. `engine`: name of the listener's engine for the report.
    """

    lost = False

    def __init__(self, listener: Listener, seed: int, engine: str | None = None) -> None:
        self._listener, self._engine = listener, engine
        self._memory = listener.start(seed)
        self._coming: list[tuple[float, Plan]] = []

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        plan, self._memory = self._listener.step(frame, self._memory)
        if plan is not None:
            self._coming.append((now_s + FAST_LATENCY_S, plan))

    def poll(self, now_s: float) -> Sequence[Plan]:
        visible = [plan for at_s, plan in self._coming if at_s <= now_s]
        self._coming = self._coming[len(visible) :]
        return visible

    def statistics(self) -> Facts:
        """Return the figures of `ports.PlanFeed`; in virtual time a step has no duration."""
        return {**IDLE_FEED, "engine": self._engine, "hop": self._listener.hop}

    def close(self) -> None:
        """Do nothing: the feed holds no resources."""
