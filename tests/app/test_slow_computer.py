"""A computer that is too slow, in virtual time: how states degrade and come back, and what servos are spared."""

import numpy as np
import pytest

from sfms_robot.app.open_head import open_head, run_log
from sfms_robot.app.options import HeadOptions
from sfms_robot.app.session import drive_head, run_parts
from sfms_robot.frames import FRAME_HZ, FRAME_S, Plan
from sfms_robot.lab.bench.throttle_bench import state_problems
from sfms_robot.listeners.thread import LATE_S, Lateness
from sfms_robot.ports import Observer
from sfms_robot.runtime.clock import IDLE_FEED
from sfms_robot.runtime.safety import Interrupt
from sfms_robot.sources.registry import DEFAULT_SPEAKER, open_source

HOP = 4
SLOW_S = (3.0, 7.0)  # from then to then


class SlowListener:
    """Plans that sway the head, each ready some time after its frame: later than it reaches while `SLOW_S`."""

    def __init__(self):
        self._lateness, self._coming = Lateness(), []

    @property
    def lost(self):
        return self._lateness.lasting

    def push(self, frame, now_s):
        if round(frame.time_s * FRAME_HZ) % HOP == 0:
            times_s = frame.time_s + FRAME_S * (1 + np.arange(2 * HOP))
            faces = np.zeros((len(times_s), 58), np.float32)
            faces[:, :3] = 0.3 * np.sin(3.0 * times_s)[:, None]
            slow = SLOW_S[0] <= now_s < SLOW_S[1]
            self._coming.append((now_s + (0.6 if slow else 0.05), Plan(frame.time_s, times_s, faces)))

    def poll(self, now_s):
        ready = [plan for at_s, plan in self._coming if at_s <= now_s]
        self._coming = [each for each in self._coming if each[0] > now_s]
        for plan in ready:
            self._lateness.came(plan, now_s)
        return ready

    def statistics(self):
        return IDLE_FEED

    def close(self):
        pass


class Burden(Observer):
    """Every tick takes `takes_s` of the computer's time; what plans came is kept."""

    def __init__(self, clock, takes_s):
        self.clock, self.takes_s = clock, takes_s
        self.plans_s, self.now_s = [], 0.0

    def tick(self, seen):
        self.now_s = seen.time_s
        self.clock.wait_until(self.clock.now_s() + self.takes_s)

    def planned(self, plan):
        self.plans_s.append((self.now_s, float(plan.times_s[-1])))


@pytest.mark.parametrize("tick_takes_s", [0.0, 0.035])
def test_a_slow_listener_is_named_while_it_is_slow_and_no_limit_is_broken(tick_takes_s):
    with open_head(HeadOptions(fast=True)) as opened:
        burden, person = Burden(opened.clock, tick_takes_s), open_source(DEFAULT_SPEAKER, "auto", 10.0)
        log = run_log(opened.config, opened.rate_hz)
        parts = run_parts(opened, person, SlowListener(), observers=[burden])
        drive_head(opened, parts, Interrupt(), duration_s=10.0, log=log)
    changes = [(at_s, state.name, state.why) for at_s, state in log.states]
    assert [name for _, name, _ in changes] == [
        "starting", "listening", "degraded", "listening", "stopping", "stopped",
    ]  # fmt: skip
    (degraded_s, _, why), (back_s, _, _) = changes[2:4]
    assert why == ("listener",)
    assert SLOW_S[0] + LATE_S <= degraded_s <= SLOW_S[0] + LATE_S + 1.0 and SLOW_S[1] <= back_s <= SLOW_S[1] + 0.5
    assert state_problems(changes, burden.plans_s) == []
    assert (log.audited.violations, log.frames) == (0, 10 * FRAME_HZ) and (log.skipped > 0) == (tick_takes_s > 0)
