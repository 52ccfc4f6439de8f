"""The loop and joints that come back: they ease in from where they stand, and nobody else notices. In virtual time."""

from collections.abc import Callable

import numpy as np
import pytest
from loop_rig import Posed, Ran, Watcher, run_listener

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.ports import Tick
from sfms_robot.sources.paired import PairedSource

RATE_HZ = 100.0
HEAD = load_head("face28")
JOINTS = list(HEAD.joints)


def run(chain: Chain, does: dict[int, Callable[[], None]], seconds: float) -> tuple[Ran, list[Tick]]:
    """Run, and also return the ticks up to the way to rest."""
    ran = run_listener(
        HEAD, chain, Posed(pitch=lambda times_s: 0.2), Watcher(does), rate_hz=RATE_HZ, duration_s=seconds,
        source=PairedSource(duration_s=seconds),
    )  # fmt: skip
    return ran, [tick for tick in ran.ticks if tick.state != "stopping"]


def test_joint_that_came_back_eases_in_from_where_it_stands():
    pitch, servo = JOINTS.index("neck_pitch"), HEAD.joints["neck_pitch"].id
    with launch(emulated(HEAD)["main"], virtual=True) as chain:
        does = {49: lambda: chain.kill(servo), 200: lambda: chain.revive(servo)}  # half way into its bow
        ran, ticks = run(chain, does, 6.0)
    assert ran.outcome == "done" and ran.log.audited.violations == 0
    goals = np.array([tick.goals_rad for tick in ticks])
    back = [k for k, tick in enumerate(ticks) if tick.readings["neck_pitch"].rejoined]
    assert len(back) == 1 and back[0] > 201
    bowed, stands = goals[200, pitch], ticks[back[0]].readings["neck_pitch"].position_rad
    assert abs(bowed - stands) > 0.05 and goals[back[0] + 1, pitch] == pytest.approx(stands, abs=0.003)
    assert goals[-1, pitch] == pytest.approx(bowed, abs=0.003)
    others = np.delete(goals, pitch, axis=1)
    assert np.abs(np.diff(others[190:], axis=0)).max() < 1e-3  # they stood still all the while
    assert ticks[-1].readings["neck_pitch"].position_rad == pytest.approx(bowed, abs=0.01)
