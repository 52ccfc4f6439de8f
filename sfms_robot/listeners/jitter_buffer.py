"""Plans that come from far away, unevenly: in order, each once, and so late that the next one is always there in time.

A plan of H frames is followed until the next one comes, hop T + delay after its own last speaker frame, and plans know
(H - 1) T of the future; T of it where they are single frames, which the timeline plays one late. What the delay's 95th
percentile of the last seconds asks for beyond that is added to the times of all plans:

    shift = hop T + delay p95 + MARGIN - max(H - 1, 1) T, at least 0

So plans of eight frames are mostly not shifted at all, since they reach further than networks are late, and those of
one frame by the delay itself. The shift grows at once, where plans come later than it allows for, and shrinks slowly:
a face that is a little late is not seen to be, one that hurries is.

Plans that overtook one another are put in order while there is time: a plan is held back for one that is missing until
its own first frame is due.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_S, Plan

WINDOW: Final = 128  # delays that are remembered
PERCENT: Final = 95.0
MARGIN_S: Final = 0.01  # a tick
SHRINKS: Final = 0.02  # seconds a second
LONGEST_S: Final = 0.6  # what takes longer is an outage: it is told, not waited for


@dataclass(frozen=True, order=True)
class _Waiting:
    number: int
    came: int  # plans of one number are told apart by it
    plan: Plan


class JitterBuffer:
    """One stream's plans; time is loop time.

    Args:
        horizon: frames of a plan.
        hop: frames from one plan to the next.

    Attributes:
        lost, late, doubled: plans that never came, came after a newer one was played, or came twice.
    """

    def __init__(self, horizon: int, hop: int) -> None:
        self._reach_s = max(horizon - 1, 1) * FRAME_S
        self._hop = hop
        self._delays_s: deque[float] = deque(maxlen=WINDOW)
        self._waiting: list[_Waiting] = []
        self._given: int | None = None  # number of the newest plan given
        self._from_s = -math.inf  # plans made before it say nothing of the way
        self._shift_s = self._wanted_s = 0.0
        self._shifted_s: float | None = None  # when
        self._came = 0
        self.lost = self.late = self.doubled = 0

    @property
    def shift_s(self) -> float:
        """That is added to the times of plans at this moment."""
        return self._shift_s

    @property
    def delay_s(self) -> float | None:
        """The percentile that the shift goes by; None before the first plan."""
        return float(np.percentile(self._delays_s, PERCENT)) if self._delays_s else None

    def put(self, number: int, plan: Plan, came_s: float) -> None:
        """A plan, made for frame `number`, which came at `came_s`."""
        if self._given is not None and number <= self._given:
            self.late += number != self._given
            self.doubled += number == self._given
            return
        if any(each.number == number for each in self._waiting):
            self.doubled += 1
            return
        self._observe(came_s - plan.made_at_s, plan.made_at_s)
        self._came += 1
        heapq.heappush(self._waiting, _Waiting(number, self._came, plan))

    def take(self, now_s: float) -> Sequence[Plan]:
        """Plans whose turn it is, oldest first, with their times shifted."""
        self._follow(now_s)
        taken = []
        while self._waiting and self._is_due(self._waiting[0], now_s):
            first = heapq.heappop(self._waiting)
            if self._given is not None:
                self.lost += max(0, (first.number - self._given) // self._hop - 1)
            self._given = first.number
            taken.append(self._shifted(first.plan))
        return taken

    def restart(self, now_s: float) -> None:
        """After an outage, or for another stream: what was waiting is dropped. What is known of the way is kept, and
        plans for frames from before `now_s` add nothing to it.
        """
        self._waiting.clear()
        self._given, self._from_s = None, now_s

    def _observe(self, delay_s: float, made_at_s: float) -> None:
        if made_at_s < self._from_s or delay_s > LONGEST_S:
            return
        self._delays_s.append(delay_s)
        self._wanted_s = max(0.0, self._hop * FRAME_S + (self.delay_s or 0.0) + MARGIN_S - self._reach_s)

    def _is_due(self, first: _Waiting, now_s: float) -> bool:
        """The next in turn, or nothing is to be gained by waiting for the one before."""
        if self._given is None or first.number <= self._given + self._hop:
            return True
        return bool(now_s + MARGIN_S >= first.plan.times_s[0] + self._shift_s)

    def _shifted(self, plan: Plan) -> Plan:
        if not self._shift_s:
            return plan
        events = tuple(replace(event, start_s=event.start_s + self._shift_s) for event in plan.events)
        return replace(plan, times_s=plan.times_s + self._shift_s, events=events)

    def _follow(self, now_s: float) -> None:
        """The shift at `now_s`: up at once, down slowly."""
        passed_s = 0.0 if self._shifted_s is None else max(0.0, now_s - self._shifted_s)
        self._shifted_s = now_s
        self._shift_s = max(self._wanted_s, self._shift_s - SHRINKS * passed_s)
