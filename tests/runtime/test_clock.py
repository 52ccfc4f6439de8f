"""The pacer, on a clock that the test holds in its hand."""

import itertools

import pytest

from sfms_robot.runtime.clock import TickPace, VirtualClock, tick_times


def test_ticks_are_exact_multiples_of_the_period_whatever_work_is_shorter_than_one() -> None:
    times = [beat.time_s for beat in itertools.islice(tick_times(VirtualClock(), 100, 0.0), 1000)]
    assert times == [pytest.approx(i / 100, abs=1e-12) for i in range(1000)]
    clock = VirtualClock()
    ticks = tick_times(clock, 50, 0.0)
    next(ticks)
    clock.wait_until(0.015)
    assert next(ticks).time_s == pytest.approx(0.020)


def test_a_late_tick_is_reported_and_missed_ticks_are_skipped_not_chased() -> None:
    clock = VirtualClock()
    ticks = tick_times(clock, 50, 0.0)
    next(ticks)
    clock.wait_until(0.075)  # 75 ms of work in a 20 ms period
    late = next(ticks)
    assert late.skipped == 2 and late.time_s == pytest.approx(0.060) and late.late_s == pytest.approx(0.015)
    assert next(ticks).time_s == pytest.approx(0.080)


def test_virtual_time_never_runs_backwards_and_ticks_go_on_from_where_it_is() -> None:
    clock = VirtualClock()
    clock.wait_until(2.0)
    clock.wait_until(1.0)
    assert clock.now_s() == 2.0
    clock = VirtualClock()
    clock.wait_until(5.013)
    assert next(tick_times(clock, 100, 5.0)).time_s == pytest.approx(0.02)
    assert next(tick_times(clock, 100, 3.0)).time_s == pytest.approx(2.02)


def test_a_busy_computer_is_one_name_for_an_incident_and_one_line_in_a_minute(caplog):
    pace, shown = TickPace(), []
    late_s = {100: 0.05, 120: 0.08, 130: 0.06, 1000: 0.04, 7000: 0.041}
    for tick in range(7001):
        pace.judge(tick / 100, late_s.get(tick, 0.0), 0.03 if tick == 7000 else 0.001)
        if pace.busy not in shown[-1:]:
            shown.append(pace.busy)
    assert shown == [None, "too busy for 50 ms", "too busy for 80 ms", None, "too busy for 40 ms", None,
                     "too busy for 41 ms"]  # fmt: skip
    first, again = caplog.messages
    assert first.startswith("this computer was too busy for 50 ms: other programs use its processors; ")
    assert again.startswith("this computer was too busy for 41 ms: its own work takes too long; ")
    assert again.endswith("(1 times more since the last message)")
