"""Whether plans are in time to be shown: a listener on a computer that is too slow answers, and always too late."""

from __future__ import annotations

import logging
from typing import Final

from sfms_robot.frames import Plan

LATE_S: Final = 1.0

log = logging.getLogger(__name__)


class Lateness:
    """Told of every plan.

    Attributes:
        lasting: for `LATE_S` every plan has come after the last of its own frames. The first one in time ends it.
    """

    def __init__(self) -> None:
        self.lasting = False
        self._since_s: float | None = None  # of the first late one in a row

    def named(self, state: str) -> str:
        """The state that a listener tells: "late" for one that listens, and for nothing."""
        return "late" if self.lasting and state == "listening" else state

    def came(self, plan: Plan, now_s: float) -> None:
        """A plan at `now_s`, by the clock of its frames."""
        if now_s <= plan.times_s[-1]:
            if self.lasting:
                log.warning("the listener's plans are in time again")
            self.lasting, self._since_s = False, None
            return
        self._since_s = now_s if self._since_s is None else self._since_s
        if not self.lasting and now_s - self._since_s >= LATE_S:
            log.warning("the listener's plans come too late to be shown: the head goes on without them")
            self.lasting = True
