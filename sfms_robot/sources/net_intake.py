"""Voice and face that come from elsewhere, judged by their age and pace, with their times in our clock.

For programs (`net_person`) and for who looks at the page (`browser`): both send `net_messages`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from sfms_robot.frames import Floats
from sfms_robot.sources.net_messages import Seen, Sound
from sfms_robot.sources.push import PushedVoice

OLDEST_S: Final = 1.0  # of a voice or a face that is still of use
_WINDOW_S: Final = 10.0  # that is remembered, once or twice
_SET_S: Final = 1.0  # a message that took so much longer than the quickest: the clock was set
_SPARE_S: Final = 2.0  # of sound, that may come in faster than time passes


class SenderClock:
    """The clock of a program that sends, in ours.

    Every message tells when it was sent, by a clock of any origin. Of all messages of the last seconds the one that
    took least long on its way tells where that clock stands: its delay is taken for none. So what is said of a time is
    late by the shortest delay of the way, and never early; a clock that drifts is followed. Holds the least
    `arrived - sent` of two windows.
    """

    def __init__(self) -> None:
        self._began_s = 0.0
        self._now_least: float | None = None
        self._last_least: float | None = None

    def observe(self, sent_s: float, arrived_s: float) -> None:
        """A message came in at `arrived_s` of `time.monotonic`."""
        took = arrived_s - sent_s
        if self._now_least is None or took > self.offset_s + _SET_S:
            self._began_s, self._now_least, self._last_least = arrived_s, took, None
        elif arrived_s - self._began_s > _WINDOW_S:
            self._began_s, self._last_least, self._now_least = arrived_s, self._now_least, took
        else:
            self._now_least = min(self._now_least, took)

    @property
    def offset_s(self) -> float:
        """Seconds to add to a time of the sender. 0 before the first message."""
        known = [each for each in (self._now_least, self._last_least) if each is not None]
        return min(known, default=0.0)


class Sees(Protocol):
    """A sight that takes faces (58,), None: it is lost; `seen_s` of `time.monotonic`, None: now."""

    def see(self, face: Floats | None, seen_s: float | None, attention: float | None) -> None: ...


class Intake:
    """What comes of one person.

    Attributes:
        counts: messages that came too late, and sound that came faster than time passes.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self.counts = dict.fromkeys(("old", "too_fast"), 0)
        self._now = now
        self._spare_s = _SPARE_S
        self._spared_s = now()

    def hear(self, voice: PushedVoice, message: Sound, clock: SenderClock) -> None:
        """The next piece of their voice. Never blocks."""
        now_s, at_s = self.times(message, clock)
        if at_s is not None and at_s < now_s - OLDEST_S:
            self.counts["old"] += 1
        elif self._in_time(len(message.samples) / message.rate_hz, now_s):
            voice.hear(message.samples, message.rate_hz, None if at_s is None else min(at_s, now_s))

    def see(self, sight: Sees, message: Seen, clock: SenderClock) -> None:
        """Their face now, or that it is lost. Never blocks."""
        now_s, at_s = self.times(message, clock)
        if at_s is not None and at_s < now_s - OLDEST_S:
            self.counts["old"] += 1
        else:
            sight.see(message.motion, None if at_s is None else min(at_s, now_s), message.attention)

    def times(self, message: Sound | Seen, clock: SenderClock) -> tuple[float, float | None]:
        """Now, and what the sender says of a time in our clock."""
        now_s = self._now()
        if not message.at_s:
            return now_s, None
        clock.observe(message.sent_s, now_s)
        return now_s, message.at_s + clock.offset_s

    def _in_time(self, piece_s: float, now_s: float) -> bool:
        """Whether no more sound came than time has passed, and a little."""
        self._spare_s = min(_SPARE_S, self._spare_s + (now_s - self._spared_s))
        self._spared_s = now_s
        if piece_s > self._spare_s:
            self.counts["too_fast"] += 1
            return False
        self._spare_s -= piece_s
        return True
