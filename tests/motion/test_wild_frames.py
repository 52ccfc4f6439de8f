"""Whatever a listener gives, what a head is told to do stays within its limits, at every head that is shipped."""

import numpy as np
import pytest

from sfms_robot.app.bench.adversary import wild
from sfms_robot.app.session import build_motion
from sfms_robot.config import load_head
from sfms_robot.data import data_dir, shipped_names
from sfms_robot.runtime.loop import difference

HEADS = shipped_names(data_dir("configs") / "heads", "head.yaml")


def violations(name: str, count: int, seed: int) -> tuple[int, bool]:
    """How often the commands of `count` ticks broke a limit, and whether the head moved at all."""
    head = load_head(name)
    rate_hz = max(bus.rate_hz for bus in head.buses.values())
    parts = build_motion(head, rate_hz)
    memory, limiter, audit = parts.retargeter.start(), parts.limiter.start(parts.rest_rad), parts.audit
    state = audit.start(parts.rest_rad)
    before = here = parts.rest_rad
    travel = np.zeros(len(parts.rest_rad))
    for frame in wild(np.random.default_rng(seed), count):
        ahead, memory = parts.retargeter.step(frame, memory)
        goals, limiter = parts.limiter.step(difference(before, here, ahead, 1 / rate_hz), limiter)
        state = audit.step(goals, here, state)
        travel = np.maximum(travel, np.abs(goals - parts.rest_rad))
        before, here = here, ahead
    return state.violations, bool((travel > 0.01).sum() >= len(travel) - len(parts.retargeter.dead_joints))


@pytest.mark.parametrize("name", HEADS)
def test_a_thousand_wild_frames_break_no_limit_and_move_every_joint(name):
    assert violations(name, 1000, 0) == (0, True)


@pytest.mark.slow
@pytest.mark.parametrize("name", HEADS)
def test_ten_thousand_wild_frames_break_no_limit(name):
    assert violations(name, 10_000, 1) == (0, True)
