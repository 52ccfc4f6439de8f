"""A bus slower than the loop sends every k-th goal, and those keep the limits at its own rate."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.config import load_head
from sfms_robot.motion.limits import JerkLimiter, JointLimits

DT_S = 0.01
LIMITS = JointLimits.of(load_head("open_duck_mini_v2_head"))
BOUNDS = (LIMITS.speed, LIMITS.acceleration, LIMITS.jerk)


def wild_goals(seed: int, ticks: int) -> np.ndarray:
    """What the limiter makes of jumps to anywhere, at rest before them."""
    rng = np.random.default_rng(seed)
    limiter = JerkLimiter(LIMITS, DT_S)
    start = rng.uniform(LIMITS.low, LIMITS.high)
    state, sent = limiter.start(start), [start] * 40
    for k in range(ticks):
        if k % 12 == 0:
            wanted = np.stack([rng.uniform(LIMITS.low, LIMITS.high), 0 * LIMITS.low, 0 * LIMITS.low])
        goals, state = limiter.step(wanted, state)
        sent.append(goals)
    return np.array(sent)


@pytest.mark.parametrize("every", [2, 3, 4, 5, 10])
@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), phase=st.integers(0, 9))
def test_every_kth_goal_keeps_the_limits_at_its_own_rate(every, seed, phase):
    sent = wild_goals(seed, 120)[phase::every]
    assert (sent >= LIMITS.low).all() and (sent <= LIMITS.high).all()
    for order, bound in enumerate(BOUNDS, 1):
        assert (np.abs(np.diff(sent, order, axis=0)) / (every * DT_S) ** order <= bound * (1 + 1e-6)).all()
