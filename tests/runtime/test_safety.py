"""Signals become a request to end."""

import signal

import pytest

from sfms_robot.runtime.safety import Interrupt, Released, signals_to


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
        interrupt = Interrupt()
        interrupt.arm(bus)
        with signals_to(interrupt):
            assert not interrupt()
            signal.raise_signal(number)
            assert interrupt() and bus.released == 0
            with pytest.raises(Released):
                signal.raise_signal(number)
            assert bus.released == 1
            signal.raise_signal(number)  # it must not cut short what the second has begun
            assert bus.released == 2
        assert signal.getsignal(number) is ours
    finally:
        signal.signal(number, before)


def test_ctrl_backslash_releases_at_once() -> None:
    bus, interrupt = NoBus(), Interrupt()
    interrupt.arm(bus)
    with signals_to(interrupt), pytest.raises(Released):
        signal.raise_signal(signal.SIGQUIT)
    assert bus.released == 1


def test_a_signal_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        interrupt = Interrupt()
        with signals_to(interrupt):
            signal.raise_signal(signal.SIGHUP)
            assert not interrupt()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
