"""Signals become a flag, and easing is smooth at both ends."""

import signal

import pytest

from sfms_robot.runtime.safety import interrupt_flag, realtime_priority, smooth


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_sets_the_flag_and_raises_nothing(number: signal.Signals) -> None:
    ours = signal.default_int_handler
    before = signal.signal(number, ours)  # whatever the tests were started under
    try:
        with interrupt_flag() as interrupted:
            assert not interrupted()
            signal.raise_signal(number)
            assert interrupted()
        assert signal.getsignal(number) is ours
    finally:
        signal.signal(number, before)


def test_a_signal_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupt_flag() as interrupted:
            signal.raise_signal(signal.SIGHUP)
            assert not interrupted()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_easing_starts_and_ends_at_rest_and_never_turns_back() -> None:
    values = [smooth(u / 1000) for u in range(-100, 1101)]
    assert values[0] == 0.0 and values[-1] == 1.0
    assert all(a <= b for a, b in zip(values, values[1:], strict=False))
    assert smooth(1e-3) < 1e-7 and 1 - smooth(1 - 1e-3) < 1e-7


def test_priority_says_what_became_of_it() -> None:
    with realtime_priority() as outcome:
        assert outcome == "fifo" or outcome.startswith("refused: ")
    with realtime_priority(wanted=False) as outcome:
        assert outcome == "not asked for"
