"""Derating of warm servos, and requests to end."""

import signal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.runtime import safety


class NoBus:
    """What an armed `Interrupt` releases: here nothing is plugged in, so it only counts."""

    released = 0

    def torque_off(self, policy: str) -> None:
        self.released += 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_first_signal_is_a_request_a_second_releases_and_a_third_only_says_so_again(number: signal.Signals) -> None:
    ours, bus = signal.default_int_handler, NoBus()
    before = signal.signal(number, ours)  # whatever the tests were started under
    try:
        interrupt = safety.Interrupt()
        interrupt.arm(bus)
        with safety.signals_to(interrupt):
            assert not interrupt()
            signal.raise_signal(number)
            assert interrupt() and bus.released == 0
            with pytest.raises(safety.Released):
                signal.raise_signal(number)
            assert bus.released == 1
            signal.raise_signal(number)  # it must not cut short what the second has begun
            assert bus.released == 2
        assert signal.getsignal(number) is ours
    finally:
        signal.signal(number, before)


def test_ctrl_backslash_releases_at_once() -> None:
    bus, interrupt = NoBus(), safety.Interrupt()
    interrupt.arm(bus)
    with safety.signals_to(interrupt), pytest.raises(safety.Released):
        signal.raise_signal(signal.SIGQUIT)
    assert bus.released == 1


def test_a_signal_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        interrupt = safety.Interrupt()
        with safety.signals_to(interrupt):
            signal.raise_signal(signal.SIGHUP)
            assert not interrupt()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


WARM, HOT = np.full(3, 60.0), np.full(3, 67.0)


def test_shares_follow_the_temperature_and_come_back_a_little_below() -> None:
    guard, heat, warm, cool_c = safety.HeatGuard(WARM, HOT, []), safety.Heat.cool(3), safety.WARM_SHARE, safety.COOLER_C
    for degrees, wanted in [
        (59.9, 1.0), (60.0, warm), (67.0, 0.0), (67.0 - cool_c + 0.1, 0.0), (67.0 - cool_c - 0.1, warm),
        (60.0 - cool_c + 0.1, warm), (60.0 - cool_c - 0.1, 1.0),
    ]:  # fmt: skip
        heat = guard.judge(np.array([degrees, 20.0, np.nan]), heat)
        assert heat.wanted.tolist() == [wanted, 1.0, 1.0], degrees


@given(st.lists(st.lists(st.floats(0, 100), min_size=3, max_size=3), min_size=1, max_size=50))
def test_a_share_never_jumps_and_the_neck_goes_as_one(degrees: list[list[float]]) -> None:
    guard, heat, dt_s = safety.HeatGuard(WARM, HOT, [0, 2]), safety.Heat.cool(3), 0.01
    for row in degrees:
        after = guard.after(guard.judge(np.array(row), heat), dt_s)
        assert np.abs(after.share - heat.share).max() <= safety.PER_S * dt_s + 1e-12
        assert after.share[0] == after.share[2] and ((after.share >= 0) & (after.share <= 1)).all()
        heat = after


def test_a_hot_joint_is_at_rest_after_two_seconds_and_comes_back_when_it_has_cooled() -> None:
    guard, heat = safety.HeatGuard(WARM, HOT, []), safety.Heat.cool(3)
    for degrees, shown in ((70.0, 0.0), (30.0, 1.0)):
        for _ in range(round(1 / safety.PER_S / 0.01) + 1):
            heat = guard.after(guard.judge(np.array([degrees, 20.0, 20.0]), heat), 0.01)
        assert np.allclose(heat.share, [shown, 1.0, 1.0])
    assert heat.none
