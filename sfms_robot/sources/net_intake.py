"""Voice and face that come from elsewhere, judged by their age and pace, with their times in our clock.

For programs (`net_person`) and for who looks at the page (`browser`): both send `net_messages`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from sfms_robot.frames import Floats
from sfms_robot.sources.net_clock import SenderClock
from sfms_robot.sources.net_messages import Seen, Sound
from sfms_robot.sources.push import PushedVoice

OLDEST_S: Final = 1.0  # of a voice or a face that is still of use
_SPARE_S: Final = 2.0  # of sound, that may come in faster than time passes


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
