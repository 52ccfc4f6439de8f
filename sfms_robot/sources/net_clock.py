"""The clock of a program that sends, in ours.

Every message tells when it was sent, by a clock of any origin. Of all messages of the last seconds the one that took
least long on its way tells where that clock stands: its delay is taken for none. So what is said of a time is late by
the shortest delay of the way, and never early; a clock that drifts is followed.
"""

from __future__ import annotations

from typing import Final

WINDOW_S: Final = 10.0  # that is remembered, once or twice
SET_S: Final = 1.0  # a message that took so much longer than the quickest: the clock was set


class SenderClock:
    """Holds the least `arrived - sent` of two windows."""

    def __init__(self) -> None:
        self._began_s = 0.0
        self._now_least: float | None = None
        self._last_least: float | None = None

    def observe(self, sent_s: float, arrived_s: float) -> None:
        """A message came in at `arrived_s` of `time.monotonic`."""
        took = arrived_s - sent_s
        if self._now_least is None or took > self.offset_s + SET_S:
            self._began_s, self._now_least, self._last_least = arrived_s, took, None
        elif arrived_s - self._began_s > WINDOW_S:
            self._began_s, self._last_least, self._now_least = arrived_s, self._now_least, took
        else:
            self._now_least = min(self._now_least, took)

    @property
    def offset_s(self) -> float:
        """Seconds to add to a time of the sender. 0 before the first message."""
        known = [each for each in (self._now_least, self._last_least) if each is not None]
        return min(known, default=0.0)
