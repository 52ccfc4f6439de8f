"""The clock of a server in ours, and how long the way there and back takes (as NTP does: RFC 5905, section 8).

A message goes out at t1 of our clock, comes at t2 of theirs, its answer goes at t3 of theirs and comes at t4 of ours:

    offset = ((t2 - t1) + (t3 - t4)) / 2        delay = (t4 - t1) - (t3 - t2)

The offset is wrong by half of the difference between the two ways, at most by delay / 2: so the sample of the least
delay of the last seconds is the one to believe. Clocks drift apart, so an old sample is given up.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

WINDOW_S: Final = 10.0
SET_S: Final = 1.0  # an offset so far from the one believed: a clock was set, or the server is another one


@dataclass(frozen=True)
class ClockSample:
    """One exchange, complete at `at_s` of our clock; seconds."""

    at_s: float
    offset_s: float
    delay_s: float


class ClockOffset:
    """Remembers the samples of `WINDOW_S` that could still become the best one."""

    def __init__(self) -> None:
        self._samples: deque[ClockSample] = deque()  # delays rise: the first is the best

    def observe(self, sent_s: float, their_came_s: float, their_sent_s: float, came_s: float) -> None:
        """An exchange: the four times of the module's text, in their order."""
        sample = ClockSample(
            came_s,
            ((their_came_s - sent_s) + (their_sent_s - came_s)) / 2,
            max(0.0, (came_s - sent_s) - (their_sent_s - their_came_s)),
        )
        if self._samples and abs(sample.offset_s - self._samples[0].offset_s) > SET_S + sample.delay_s:
            self._samples.clear()
        while self._samples and self._samples[-1].delay_s >= sample.delay_s:
            self._samples.pop()
        self._samples.append(sample)
        while came_s - self._samples[0].at_s > WINDOW_S:
            self._samples.popleft()

    def forget(self) -> None:
        """Another server."""
        self._samples.clear()

    @property
    def best(self) -> ClockSample | None:
        """The sample that is believed; None before the first."""
        return self._samples[0] if self._samples else None

    def theirs(self, our_s: float) -> float | None:
        """A time of our clock by theirs; None while nothing is known of it."""
        return None if self.best is None else our_s + self.best.offset_s
