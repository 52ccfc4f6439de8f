"""The clock of a server, from messages that take unevenly long."""

import numpy as np
import pytest

from sfms_robot.listeners.remote import WINDOW_S, ClockOffset


def exchange(clock, at_s, offset_s, there_s, back_s, works_s=0.01):
    clock.observe(
        at_s, at_s + there_s + offset_s, at_s + there_s + works_s + offset_s, at_s + there_s + works_s + back_s
    )


@pytest.mark.parametrize("offset_s", [0.0, 12_345.6, -7.5])
def test_the_offset_is_found_within_the_jitter_of_the_quickest(offset_s):
    clock, rng = ClockOffset(), np.random.default_rng(1)
    for index in range(200):
        exchange(clock, index * 0.04, offset_s, *(0.05 + rng.uniform(-0.02, 0.02, 2)))
    assert clock.best is not None
    assert clock.best.offset_s == pytest.approx(offset_s, abs=0.005)
    assert abs(clock.best.offset_s - offset_s) <= clock.best.delay_s / 2


def test_nothing_is_known_before_the_first():
    assert ClockOffset().best is None and ClockOffset().theirs(3.0) is None


def test_a_clock_that_drifts_is_followed():
    clock = ClockOffset()
    for index in range(5000):
        exchange(clock, index * 0.04, index * 0.04 * 1e-4, 0.02, 0.02)
    assert clock.theirs(200.0) == pytest.approx(200.0 + 200.0 * 1e-4, abs=2 * WINDOW_S * 1e-4)


def test_a_server_whose_clock_was_set_is_believed_at_once():
    clock = ClockOffset()
    for index in range(50):
        exchange(clock, index * 0.04, 0.0, 0.01, 0.01)
    exchange(clock, 2.0, 3600.0, 0.03, 0.03)
    assert clock.theirs(2.1) == pytest.approx(3602.1)


def test_memory_is_bounded_by_the_window():
    clock = ClockOffset()
    for index in range(10_000):
        exchange(clock, index * 0.04, 0.0, 0.01 + 1e-6 * index, 0.01)
    assert len(clock._samples) <= WINDOW_S / 0.04 + 2
