"""One of two buses fails for good: the other eases its joints to rest, and torque goes off. In virtual time."""

from contextlib import ExitStack

import numpy as np
import pytest
from loop_rig import Watcher, driven

from sfms_robot.app.head.pose import NobodyThere, held_face, parse_face
from sfms_robot.app.open_head import build_bus, run_log
from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import launch
from sfms_robot.errors import BusError
from sfms_robot.runtime.clock import VirtualClock

GIVES_UP_S = 6.0
WHOLE = load_head("open_duck_mini_v2_head")
HEAD = WHOLE.model_copy(
    update={"buses": {name: bus.model_copy(update={"reconnect_s": GIVES_UP_S}) for name, bus in WHOLE.buses.items()}}
)
RATE_HZ = max(bus.rate_hz for bus in HEAD.buses.values())


@pytest.mark.parametrize(("dead", "alive"), [("antennas", "neck"), ("neck", "antennas")])
def test_the_bus_that_works_comes_to_rest(dead, alive):
    clock = VirtualClock()
    with ExitStack() as stack:
        chains = {name: stack.enter_context(launch(servos, True)) for name, servos in emulated(HEAD).items()}
        bus = build_bus(HEAD, chains, clock)
        bus.connect()
        stack.callback(bus.close)
        log = run_log(HEAD, RATE_HZ)
        watcher = Watcher({round(2.0 * RATE_HZ) + 1: chains[dead].hang_up})
        with pytest.raises(BusError, match=dead):
            driven(
                HEAD, bus, clock, rate_hz=RATE_HZ, duration_s=60.0, observer=watcher, log=log, source=NobodyThere(),
                feed=NobodyThere(), timeline=held_face(parse_face(["pitch=0.2", "browInnerUp=1"]), 60.0),
            )  # fmt: skip
        mine = [(j.id, j.zero_ticks) for j in HEAD.joints.values() if j.bus == alive]
        states = {servo: chains[alive].state(servo) for servo, _ in mine}
    last = [tick for tick in watcher.ticks if tick.state != "stopping"][-1]
    assert 2.0 + GIVES_UP_S <= last.time_s < 2.0 + GIVES_UP_S + 1.0
    rest_rad = np.array([joint.rest_rad for joint in HEAD.joints.values()])
    assert np.abs(last.goals_rad - rest_rad).max() > 0.05  # the face was somewhere else
    assert log.eased >= RATE_HZ and log.audited.violations == 0
    if alive == "neck":
        assert all(states[servo]["torque"] == 0 for servo, _ in mine)
        assert all(abs(states[servo]["position"] - zero) <= 6 for servo, zero in mine)
