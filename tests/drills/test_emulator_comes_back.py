"""All servos lose their supply at once, and are found again somewhere else, outside their ranges."""

import json
import os
import signal

import pytest
from drill_rig import HEAD, PAN, TILT, listening, run, servos, torque

pytestmark = pytest.mark.slow


def test_servos_that_were_all_away_come_back_and_the_run_ends_as_usual(device):
    with servos(device) as first, run(HEAD, device, "--json", duration_s=12) as running:
        listening(running, first)
        device.unlink()  # as a plug that is pulled; the name it stood for may be another terminal's soon
        os.kill(first.pid, signal.SIGKILL)
        with servos(device, 3500) as second:
            listening(running, second)
            code, out, err = running.ended()
            states = [second.state(servo) for servo in (PAN, TILT)]
            assert torque(second) == (False, False)
    report = json.loads(out.splitlines()[-1])
    assert (code, report["exit"], report["error"]) == (0, "done", None), err
    assert report["limits"]["violations"] == 0 and report["bus"]["reconnects"] >= 1
    assert all(abs(state["position"] - 2048) <= 10 for state in states)
