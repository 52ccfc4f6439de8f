"""Clocks of two machines, and plans that come unevenly: played evenly, in order, each once."""

import numpy as np
import pytest

from sfms_robot.frames import FRAME_S, ListenerEvent, Plan
from sfms_robot.listeners.remote_timing import LONGEST_S, SHRINKS, WINDOW_S, ClockOffset, JitterBuffer


def exchange(clock, at_s, offset_s, there_s, back_s, works_s=0.01):
    clock.observe(
        at_s, at_s + there_s + offset_s, at_s + there_s + works_s + offset_s, at_s + there_s + works_s + back_s
    )


@pytest.mark.parametrize("offset_s", [0.0, 12_345.6, -7.5])
def test_the_offset_is_found_within_the_jitter_of_the_quickest(offset_s):
    clock, rng = ClockOffset(), np.random.default_rng(1)
    for index in range(200):
        exchange(clock, index * 0.04, offset_s, *(0.05 + rng.uniform(-0.02, 0.02, 2)))
    assert clock.best is not None and clock.best.offset_s == pytest.approx(offset_s, abs=0.005)
    assert abs(clock.best.offset_s - offset_s) <= clock.best.delay_s / 2


def test_a_clock_is_unknown_before_the_first_bounded_in_memory_and_believed_at_once_when_it_was_set():
    assert ClockOffset().best is None and ClockOffset().theirs(3.0) is None
    clock = ClockOffset()
    for index in range(50):
        exchange(clock, index * 0.04, 0.0, 0.01, 0.01)
    exchange(clock, 2.0, 3600.0, 0.03, 0.03)
    assert clock.theirs(2.1) == pytest.approx(3602.1)
    clock = ClockOffset()
    for index in range(10_000):
        exchange(clock, index * 0.04, 0.0, 0.01 + 1e-6 * index, 0.01)
    assert len(clock._samples) <= WINDOW_S / 0.04 + 2


def test_a_clock_that_drifts_is_followed():
    clock = ClockOffset()
    for index in range(5000):
        exchange(clock, index * 0.04, index * 0.04 * 1e-4, 0.02, 0.02)
    assert clock.theirs(200.0) == pytest.approx(200.0 + 200.0 * 1e-4, abs=2 * WINDOW_S * 1e-4)


def plan(number, horizon, events=()):
    made_s = (number + 1) * FRAME_S
    times_s = made_s + FRAME_S * (1 + np.arange(horizon))
    return Plan(made_s, times_s, np.zeros((horizon, 58), np.float32), None, events)


def played(buffer, arrivals, until_s, tick_s=0.01):
    """(now, plan) of all that is given; `arrivals` are (time, number, plan)."""
    arrivals, given = sorted(arrivals, key=lambda each: each[0]), []
    for now_s in np.arange(0, until_s, tick_s):
        while arrivals and arrivals[0][0] <= now_s:
            came_s, number, one = arrivals.pop(0)
            buffer.put(number, one, came_s)
        given += [(now_s, each) for each in buffer.take(now_s)]
    return given


def jittered(horizon, hop, delay_s, jitter_s, frames=500, loss=0.0, seed=0):
    rng = np.random.default_rng(seed)
    return [
        ((number + 1) * FRAME_S + delay_s + rng.uniform(-jitter_s, jitter_s), number, plan(number, horizon))
        for number in range(0, frames, hop)
        if rng.random() >= loss
    ]


def test_a_long_plan_that_comes_in_time_is_left_as_it_is_and_doubles_are_given_once():
    buffer, one = JitterBuffer(8, 3), plan(0, 8)
    buffer.put(0, one, one.made_at_s + 0.05)
    assert buffer.take(0.1) == [one] and buffer.shift_s == 0.0
    buffer = JitterBuffer(8, 3)
    for _ in range(3):
        buffer.put(0, plan(0, 8), 0.1)
    assert len(buffer.take(0.1)) == 1
    buffer.put(0, plan(0, 8), 0.12)
    assert buffer.take(0.12) == [] and buffer.doubled == 3


def test_plans_that_overtook_one_another_are_given_in_order_and_a_missing_one_is_waited_for():
    buffer = JitterBuffer(8, 1)
    for number, came_s in [(0, 0.1), (2, 0.14), (1, 0.15), (3, 0.2)]:
        buffer.put(number, plan(number, 8), came_s)
    given = [each.made_at_s for _, each in played(buffer, [], 0.5)]
    assert given == sorted(given) and len(given) == 4
    buffer = JitterBuffer(8, 3)
    buffer.put(0, plan(0, 8), 0.05)
    assert len(buffer.take(0.05)) == 1
    buffer.put(6, plan(6, 8), 0.29)  # made at 0.28 s, its first frame is of 0.32 s
    assert buffer.take(0.30) == [] and len(buffer.take(0.31)) == 1 and buffer.lost == 1
    buffer.put(3, plan(3, 8), 0.33)
    assert buffer.take(0.34) == [] and buffer.late == 1


def test_the_shift_shrinks_slowly_and_an_outage_does_not_make_all_plans_late():
    buffer = JitterBuffer(1, 1)
    played(buffer, jittered(1, 1, 0.3, 0.0, frames=100), 5.0)
    before_s = buffer.shift_s
    better = [(5.0 + came_s, 125 + number, plan(125 + number, 1)) for came_s, number, _ in jittered(1, 1, 0.05, 0.0)]
    for came_s, number, one in better[:200]:
        buffer.put(number, one, came_s)
        buffer.take(came_s)
    assert before_s > 0.3 and before_s - 8.0 * SHRINKS - 0.01 <= buffer.shift_s < before_s
    buffer = JitterBuffer(1, 1)
    played(buffer, jittered(1, 1, 0.05, 0.0, frames=100), 5.0)
    before_s = buffer.shift_s
    buffer.restart(10.0)
    for number in range(100, 240):  # all at once
        buffer.put(number, plan(number, 1), 10.0)
    buffer.take(10.0)
    assert buffer.shift_s <= before_s < LONGEST_S


def test_events_are_shifted_with_the_motion_that_shows_them():
    buffer = JitterBuffer(1, 1)
    played(buffer, jittered(1, 1, 0.3, 0.0, frames=100), 5.0)
    nod = ListenerEvent("nod", 5.2, 0.5, 0.1)
    one = plan(124, 1, (nod,))
    buffer.put(124, one, 5.3)
    (given,) = buffer.take(6.0)
    assert given.events[0].start_s - nod.start_s == pytest.approx(given.times_s[0] - one.times_s[0])
    assert given.times_s[0] > one.times_s[0]
