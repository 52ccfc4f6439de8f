"""How much of the listener's answer shows: all of it while somebody is there, none while nobody is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sfms_robot.frames import Doubles
from sfms_robot.signals.minimum_jerk import ease

FADE_S: Final = 0.5


@dataclass(frozen=True)
class Fade:
    """A share that goes smoothly from `before` to `after`, from `since_s` on for `FADE_S`."""

    before: float = 0.0
    after: float = 0.0
    since_s: float = 0.0

    def at(self, times_s: Doubles) -> Doubles:
        """(N,) at (N,) instants."""
        share: Doubles = self.before + (self.after - self.before) * ease((times_s - self.since_s) / FADE_S)
        return share

    def toward(self, share: float, times_s: Doubles) -> Fade:
        """Goes to `share`, beginning at the latest of the instants (N,): none that was played before changes."""
        if share == self.after:
            return self
        latest = times_s.max(keepdims=True)
        return Fade(float(self.at(latest)[0]), share, float(latest[0]))
