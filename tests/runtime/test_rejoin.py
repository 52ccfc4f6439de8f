"""The loop and joints that come back: they ease in from where they stand, and nobody else notices. In virtual time."""

from collections.abc import Callable

import numpy as np
import pytest
from loop_rig import Posed, driven

from sfms_robot.app.open_head import build_bus
from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.clock import InlineFeed, VirtualClock
from sfms_robot.runtime.log import RunLog
from sfms_robot.sources.paired import PairedSource

RATE_HZ = 100.0
HEAD = load_head("face28")
JOINTS = list(HEAD.joints)


class Hand(Observer):
    """An observer that does things to the chain at given ticks, and keeps what it sees up to the way to rest."""

    def __init__(self, does: dict[int, Callable[[], None]]) -> None:
        self._does = does
        self.ticks: list[Tick] = []

    def tick(self, seen: Tick) -> None:
        if seen.state == "stopping":
            return
        self.ticks.append(seen)
        if (act := self._does.get(len(self.ticks))) is not None:
            act()


def run(chain: Chain, hand: Hand, seconds: float) -> tuple[str, RunLog]:
    clock = VirtualClock()
    bus = build_bus(HEAD, {"main": chain}, clock)
    bus.connect()
    try:
        return driven(
            HEAD, bus, clock, rate_hz=RATE_HZ, duration_s=seconds, observer=hand,
            source=PairedSource(duration_s=seconds), feed=InlineFeed(Posed(pitch=lambda times_s: 0.2), 0, 0.01),
        )  # fmt: skip
    finally:
        bus.close()


def test_joint_that_came_back_eases_in_from_where_it_stands():
    pitch = JOINTS.index("neck_pitch")
    servo = HEAD.joints["neck_pitch"].id
    with launch(emulated(HEAD)["main"], virtual=True) as chain:
        hand = Hand({50: lambda: chain.kill(servo), 201: lambda: chain.revive(servo)})  # half way into its bow
        outcome, log = run(chain, hand, 6.0)
    assert outcome == "done" and log.audited.violations == 0
    goals = np.array([tick.goals_rad for tick in hand.ticks])
    back = [k for k, tick in enumerate(hand.ticks) if tick.readings["neck_pitch"].rejoined]
    assert len(back) == 1 and back[0] > 201
    bowed, stands = goals[200, pitch], hand.ticks[back[0]].readings["neck_pitch"].position_rad
    assert abs(bowed - stands) > 0.05
    assert goals[back[0] + 1, pitch] == pytest.approx(stands, abs=0.003)
    assert goals[-1, pitch] == pytest.approx(bowed, abs=0.003)
    others = np.delete(goals, pitch, axis=1)
    assert np.abs(np.diff(others[190:], axis=0)).max() < 1e-3  # they stood still all the while
    assert hand.ticks[-1].readings["neck_pitch"].position_rad == pytest.approx(bowed, abs=0.01)


def test_head_comes_back_whole_after_its_adapter_was_unplugged():
    with launch(emulated(HEAD)["main"], virtual=True) as chain:
        hand = Hand({150: chain.hang_up, 250: chain.come_back})
        outcome, log = run(chain, hand, 7.0)
        torque = [chain.state(joint.id)["torque"] for joint in HEAD.joints.values()]
    assert outcome == "done" and log.audited.violations == 0
    ages = np.array([[each.age_s for each in tick.readings.values()] for tick in hand.ticks])
    assert (ages[155:249] > 0).all()
    assert (ages[450:] == 0.0).all()  # 2 s after it was plugged in again
    last = hand.ticks[-1]
    for name, reading in last.readings.items():
        assert reading.position_rad == pytest.approx(last.goals_rad[JOINTS.index(name)], abs=0.01), name
    assert not any(torque)
