"""A program that is killed, two programs that want one port."""

import json
import os
import signal

import pytest
from drill_rig import HEAD, PAN, TILT, command, gone, listening, run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="no /proc here"),
]


def stand(chain):
    """Whether the watchdog of both has stopped them: the goal is where they are, and nothing moves."""
    states = [chain.state(servo) for servo in (PAN, TILT)]
    return all(abs(s["goal"] - s["position"]) <= 1 and abs(s["speed"]) < 1 for s in states)


def test_after_a_kill_servos_stop_the_listener_ends_and_the_next_run_starts(device, chain):
    with run(HEAD, device) as killed:
        listening(killed, chain)
        children = killed.children()
        assert children
        killed.signal(signal.SIGKILL)
        assert killed.ended().code == -signal.SIGKILL
    with run(HEAD, device, "--json", duration_s=0.5) as following:
        following.until(lambda: all(map(gone, children)))
        code, out, _ = following.ended()
    report = json.loads(out.splitlines()[-1])
    assert (code, report["exit"], report["bus"]["faults"]) == (0, "done", [])
    assert not chain.state(PAN)["torque"] and not chain.state(TILT)["torque"]


def test_after_a_kill_the_watchdog_of_each_servo_has_tripped(device, chain):
    with run(HEAD, device) as killed:
        listening(killed, chain)
        killed.signal(signal.SIGKILL)
        killed.ended()
    code, out, err = command("servo", "read", "1-2", "bus_watchdog", "--port", device, "--baud", 1_000_000, "--json")
    assert code == 0, err
    told = json.loads(out.splitlines()[-1])
    assert [(row["id"], row["raw"]) for row in told["registers"]] == [(PAN, -1), (TILT, -1)]
    assert stand(chain) and chain.state(PAN)["torque"] and chain.state(TILT)["torque"]
    code, out, err = command("servo", "release", "--head", HEAD, "--port", device, "--json")
    assert code == 0, err
    told = json.loads(out.splitlines()[-1])
    assert [row["torque"] for row in told["released"]] == ["off", "off"] and told["torque_unconfirmed"] == []
    assert not chain.state(PAN)["torque"] and not chain.state(TILT)["torque"]


def test_the_second_run_on_a_port_is_refused_and_names_the_first(device, chain):
    with run(HEAD, device) as first:
        listening(first, chain)
        for words in (("run", "--audio", "none", "--duration", 1), ("servo", "release")):
            code, out, err = command(*words, "--head", HEAD, "--port", device, "--json")
            assert code == 3 and f"pid {first.pid}" in err and "stop that first" in err and len(err.splitlines()) == 1
            assert json.loads(out.splitlines()[-1])["exit_code"] == 3
        listening(first, chain)  # it goes on
        first.signal(signal.SIGINT)
        assert first.ended().code == 130
