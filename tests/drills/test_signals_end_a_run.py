"""Signals from a terminal, a service manager or a hand on the keyboard, in every phase of a run on the command line."""

import json
import os
import signal

import drill_rig as rig
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="no /proc here")]
PHASES = (rig.loading, rig.connecting, rig.enabling, rig.listening, rig.resting)
HIDE, SHOW = b"\x1b[?25l", b"\x1b[?25h"
CASES = [(phase, signal.SIGINT) for phase in PHASES]  # one handler serves all three: tests/runtime/test_safety.py
CASES += [(rig.enabling, signal.SIGTERM), (rig.listening, signal.SIGTERM), (rig.connecting, signal.SIGHUP)]


def assert_limp(chain):
    assert rig.torque(chain) == (False, False)


@pytest.mark.parametrize(("phase", "number"), CASES, ids=[f"{p.__name__}-{n.name}" for p, n in CASES])
def test_a_signal_ends_a_run_without_torque_and_without_a_word(phase, number, slow_head, device, chain):
    with rig.run(slow_head, device, "--json", duration_s=rig.DURATION_S.get(phase, 600)) as running:
        phase(running, chain)
        running.signal(number)
        code, out, err = running.ended()
    assert_limp(chain)
    assert code == 130
    assert [line for line in err.splitlines() if not line.startswith("WARNING: ")] == []  # of a computer that is busy
    assert json.loads(out.splitlines()[-1])["exit"] == "interrupted"


@pytest.fixture
def in_the_background():
    """What a script's shell does for whatever it starts with `&`."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("phase", [rig.loading, rig.listening], ids=lambda each: each.__name__)
def test_an_interrupt_ends_a_run_that_a_script_started_in_the_background(
    phase, in_the_background, slow_head, device, chain
):
    test_a_signal_ends_a_run_without_torque_and_without_a_word(phase, signal.SIGINT, slow_head, device, chain)


def once(running, chain):
    running.signal(signal.SIGQUIT)


def twice(running, chain):
    running.signal(signal.SIGINT)
    running.until(running.heeded)
    rig.more_said(running, chain, 100)  # Python has seen it too: a tick has passed
    running.signal(signal.SIGINT)


def many_times(running, chain):
    for _ in range(27):
        if running.process.poll() is None:
            running.signal(signal.SIGINT)
            rig.said(chain)  # something else meanwhile


@pytest.mark.parametrize(
    ("phase", "press"),
    [
        (rig.enabling, once),
        (rig.listening, once),
        (rig.resting, once),
        (rig.listening, twice),
        (rig.resting, twice),
        (rig.listening, many_times),
    ],
    ids=lambda each: each.__name__,
)
def test_who_insists_gets_no_torque_and_the_cursor_back(phase, press, slow_head, device, chain):
    terminal = rig.Terminal()
    with rig.run(
        slow_head, device, stderr=terminal.far, duration_s=rig.DURATION_S.get(phase, 600), TERM="xterm", COLUMNS="80"
    ) as running:
        phase(running, chain)
        press(running, chain)
        code, _, _ = running.ended()
    shown = terminal.closed()
    assert_limp(chain)
    assert code == 130 and b"Traceback" not in shown and b"Error" not in shown
    assert HIDE in shown and shown.rfind(SHOW) > shown.rfind(HIDE)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda each: each.name)
def test_a_servo_moved_by_hand_is_limp_again_after_a_signal(number, device, chain):
    with rig.Command(
        "servo", "move", rig.PAN, "--by", "1000", "--baud", 1_000_000, "--port", device, "--json"
    ) as moving:
        moving.until(lambda: any(rig.torque(chain)))
        moving.signal(number)
        code, out, err = moving.ended()
    assert_limp(chain)
    assert code == 130 and "Traceback" not in err
    assert json.loads(out.splitlines()[-1])["exit"] == "interrupted"
