"""Times of a listener on another machine: its clock relative to ours, and plans that arrive unevenly (`JitterBuffer`).

Clock offset and delay of a round trip are those of NTP (RFC 5905, section 8). A message leaves at t1 of our clock and
arrives at t2 of the server's; its answer leaves at t3 of the server's and arrives at t4 of ours:

    offset = ((t2 - t1) + (t3 - t4)) / 2        delay = (t4 - t1) - (t3 - t2)

The error of the offset is half the difference between the two ways, at most delay / 2. So the sample with the least
delay of the last seconds is used. Clocks drift apart, so old samples are dropped.

The buffer delays plans so that the next one is always there in time, in order and each once. A plan of H frames is
played until the next one comes, hop T + delay after its own last speaker frame. Plans cover (H - 1) T of the future;
plans of a single frame cover T, because the timeline plays them one frame late. If the 95th percentile of the delay
over the last seconds needs more than that, the difference is added to the times of all plans:

    shift = hop T + delay p95 + MARGIN - max(H - 1, 1) T, at least 0

So plans of eight frames are mostly not shifted, since they cover more time than networks delay them, and plans of one
frame are shifted by the delay itself. The shift grows at once if plans come later than it allows, and shrinks slowly:
viewers do not notice a face that is a little late, but they notice one that hurries.

Plans that overtook one another are put in order while there is time: a plan waits for a missing one until its own first
frame is due.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_S, Plan

WINDOW_S: Final = 10.0
SET_S: Final = 1.0  # an offset that differs by more than this: a clock was set, or the server is another one

DELAYS: Final = 128  # number of delays that are kept
PERCENT: Final = 95.0
MARGIN_S: Final = 0.01  # one tick
SHRINKS: Final = 0.02  # decrease of the shift, seconds per second
LONGEST_S: Final = 0.6  # a longer delay is an outage, which does not change the shift


@dataclass(frozen=True)
class ClockSample:
    """One exchange of messages, complete at `at_s` of our clock; all values in seconds."""

    at_s: float
    offset_s: float
    delay_s: float


class ClockOffset:
    """The clock samples of the last `WINDOW_S`."""

    def __init__(self) -> None:
        self._samples = deque[ClockSample]()

    def observe(self, sent_s: float, their_came_s: float, their_sent_s: float, came_s: float) -> None:
        """Add an exchange: t1 to t4 of the module's text."""
        offset_s = ((their_came_s - sent_s) + (their_sent_s - came_s)) / 2
        delay_s = max(0.0, (came_s - sent_s) - (their_sent_s - their_came_s))
        if self.best is not None and abs(offset_s - self.best.offset_s) > SET_S + delay_s:
            self._samples.clear()
        self._samples.append(ClockSample(came_s, offset_s, delay_s))
        while came_s - self._samples[0].at_s > WINDOW_S:
            self._samples.popleft()

    @property
    def best(self) -> ClockSample | None:
        """Return the sample with the least delay; None before the first."""
        return min(self._samples, key=lambda sample: sample.delay_s, default=None)

    def theirs(self, our_s: float) -> float | None:
        """Return the time on the server's clock at a time of ours; None before the first sample."""
        best = self.best
        return None if best is None else our_s + best.offset_s


class JitterBuffer:
    """A buffer that orders and delays the plans of one stream; all times are loop time.

    Args:
        horizon: frames of a plan.
        hop: frames from one plan to the next.

    Attributes:
        shift_s: time that is currently added to the times of plans.
        lost, late, doubled: counts of plans that never came, came after a newer one was played, or came twice.
    """

    def __init__(self, horizon: int, hop: int) -> None:
        self._reach_s = max(horizon - 1, 1) * FRAME_S
        self._hop = hop
        self._delays_s = deque[float](maxlen=DELAYS)
        self._waiting: dict[int, Plan] = {}  # by number
        self._given: int | None = None  # number of the newest plan returned
        self._from_s = -math.inf  # plans made before this time were delayed by an outage
        self.shift_s = self._wanted_s = 0.0
        self._shifted_s: float | None = None  # time of the last update of the shift
        self.lost = self.late = self.doubled = 0

    def put(self, number: int, plan: Plan, came_s: float) -> None:
        """Add a plan for frame `number` that came at `came_s`."""
        if self._given is not None and number <= self._given:
            self.late += number != self._given
            self.doubled += number == self._given
            return
        if number in self._waiting:
            self.doubled += 1
            return
        self._observe(came_s - plan.made_at_s, plan.made_at_s)
        self._waiting[number] = plan

    def take(self, now_s: float) -> Sequence[Plan]:
        """Return plans that are due, oldest first, with their times shifted."""
        self._follow(now_s)
        taken = []
        while self._waiting:
            number = min(self._waiting)
            in_turn = self._given is None or number <= self._given + self._hop
            # A plan is returned out of turn once it is too late to wait for the one before.
            if not in_turn and now_s + MARGIN_S < self._waiting[number].times_s[0] + self.shift_s:
                break
            if self._given is not None:
                self.lost += max(0, (number - self._given) // self._hop - 1)
            self._given = number
            plan = self._waiting.pop(number)
            if self.shift_s:
                events = tuple(replace(event, start_s=event.start_s + self.shift_s) for event in plan.events)
                plan = replace(plan, times_s=plan.times_s + self.shift_s, events=events)
            taken.append(plan)
        return taken

    def restart(self, now_s: float) -> None:
        """Drop waiting plans, after an outage or for another stream.

        Measured delays are kept; plans made before `now_s` add none.
        """
        self._waiting.clear()
        self._given, self._from_s = None, now_s

    def _observe(self, delay_s: float, made_at_s: float) -> None:
        if made_at_s < self._from_s or delay_s > LONGEST_S:
            return
        self._delays_s.append(delay_s)
        late_s = float(np.percentile(self._delays_s, PERCENT))
        self._wanted_s = max(0.0, self._hop * FRAME_S + late_s + MARGIN_S - self._reach_s)

    def _follow(self, now_s: float) -> None:
        """Update the shift: up at once, down slowly."""
        passed_s = 0.0 if self._shifted_s is None else max(0.0, now_s - self._shifted_s)
        self._shifted_s = now_s
        self.shift_s = max(self._wanted_s, self.shift_s - SHRINKS * passed_s)
