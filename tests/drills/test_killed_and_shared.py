"""A program that is killed, two programs that want one port."""

import json
import os
import signal

import pytest
from drill_rig import HEAD, PAN, TILT, command, gone, listening, run, torque

pytestmark = [
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="no /proc here"),
]


def stand(chain):
    """Whether the watchdog of both has stopped them: the goal is where they are, and nothing moves."""
    states = [chain.state(servo) for servo in (PAN, TILT)]
    return all(abs(s["goal"] - s["position"]) <= 1 and abs(s["speed"]) < 1 for s in states)


def test_after_a_kill_watchdogs_trip_the_listener_ends_and_the_next_run_starts(device, chain):
    with run(HEAD, device) as killed:
        listening(killed, chain)
        children = killed.children()
        assert children
        killed.signal(signal.SIGKILL)
        assert killed.ended().code == -signal.SIGKILL
    ended = command("servo", "read", "1-2", "bus_watchdog", "--port", device, "--baud", 1_000_000, "--json")
    assert ended.code == 0, ended.err
    assert [(row["id"], row["raw"]) for row in ended.told["registers"]] == [(PAN, -1), (TILT, -1)]
    assert stand(chain) and torque(chain) == (True, True)
    ended = command("servo", "release", "--head", HEAD, "--port", device, "--json")
    assert ended.code == 0, ended.err
    assert [row["torque"] for row in ended.told["released"]] == ["off", "off"]
    assert ended.told["torque_unconfirmed"] == [] and torque(chain) == (False, False)
    with run(HEAD, device, "--json", duration_s=0.5) as following:
        following.until(lambda: all(map(gone, children)))
        ended = following.ended()
    assert (ended.code, ended.told["exit"], ended.told["bus"]["faults"]) == (0, "done", [])
    assert torque(chain) == (False, False)


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
