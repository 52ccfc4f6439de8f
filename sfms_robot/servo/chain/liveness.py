"""Whether a servo answers, and how often that is said: a loose contact comes and goes many times a second."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Final

log = logging.getLogger(__name__)

FIRST_PAUSE_S: Final = 0.05  # between two probes of a silent servo
LONGEST_PAUSE_S: Final = 1.0
SAID_EVERY_S: Final = 10.0


@dataclass
class Liveness:
    """Whether a servo answers: misses, probes, and what is said of it.

    Attributes:
        listed: asked in every poll; otherwise it is probed alone, with growing pauses.
        probe_s: when a servo that is not listed is asked next.
    """

    listed: bool = True
    misses: int = 0
    pause_s: float = FIRST_PAUSE_S
    probe_s: float = -math.inf
    said_s: float = -math.inf  # when it was last said to be silent
    unsaid: int = 0  # silences since
    told_silent: bool = False

    def say_silent(self, name: str, now_s: float, again: bool) -> None:
        """Once in ten seconds; what is held back is counted. `again`: it is a new silence, not the same one."""
        if self.told_silent:
            return
        if now_s < self.said_s + SAID_EVERY_S:
            self.unsaid += again
            return
        times = f" ({self.unsaid} times since the last word)" if self.unsaid else ""
        log.warning("%s is silent%s", name, times)
        self.said_s, self.unsaid, self.told_silent = now_s, 0, True

    def say_back(self, name: str) -> None:
        if self.told_silent:
            self.told_silent = False
            log.warning("%s answers again", name)
