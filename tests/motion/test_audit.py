import numpy as np
import pytest

from sfms_robot.config import load_head
from sfms_robot.motion.audit import CommandAudit
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import JerkLimiter, JointLimits

DT_S = 0.01
HEAD = load_head("face28")
LIMITS = JointLimits.of(HEAD)
J = len(LIMITS.low)
AUDIT = CommandAudit(LIMITS, Calibration(HEAD.joints, np.full(J, 4096)), DT_S)


def audited(stream, wanted=None):
    state = AUDIT.start(stream[0])
    for k, angles in enumerate(stream):
        state = AUDIT.step(angles, angles if wanted is None else wanted[k], state)
    return state


def test_what_the_limiter_sends_breaks_nothing_and_is_counted_as_clamped():
    limiter = JerkLimiter(LIMITS, DT_S)
    state, audit, clamped = limiter.start(np.zeros(J)), AUDIT.start(np.zeros(J)), 0
    rng = np.random.default_rng(0)
    for k in range(400):
        if k % 20 == 0:
            wanted = np.stack([rng.uniform(2 * LIMITS.low, 2 * LIMITS.high), np.zeros(J), np.zeros(J)])
        goals, state = limiter.step(wanted, state)
        audit = AUDIT.step(goals, wanted[0], audit)
        clamped += int((np.abs(goals - wanted[0]) > 1e-6).sum())
    assert audit.violations == 0 and audit.clamped == clamped > 0


def steps(joint: int, angles) -> np.ndarray:
    stream = np.zeros((len(angles), J))
    stream[:, joint] = angles
    return stream


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_speed_acceleration_or_jerk_just_over_its_limit_is_a_violation(order):
    jaw = list(HEAD.joints).index("jaw")
    bound = [LIMITS.speed, LIMITS.acceleration, LIMITS.jerk][order - 1][jaw]
    alone = JointLimits(LIMITS.low - 9, LIMITS.high + 9, *(
        limit if order == n else np.full(J, 1e9)
        for n, limit in enumerate((LIMITS.speed, LIMITS.acceleration, LIMITS.jerk), 1)
    ))  # fmt: skip
    audit = CommandAudit(alone, Calibration(HEAD.joints, np.full(J, 4096)), DT_S)
    for share, found in ((0.9999, 0), (1.0001, 1)):
        state, rise = audit.start(np.zeros(J)), bound * DT_S**order * share
        state = audit.step(steps(jaw, [rise])[0], np.zeros(J), state)
        assert state.violations == found


@pytest.mark.parametrize("out_rad", [0.0, 0.1])
def test_a_joint_at_the_edge_or_found_outside_may_come_in_but_not_go_further_out(out_rad):
    lid = list(HEAD.joints).index("lid_left")
    found = LIMITS.high[lid] + out_rad
    state = AUDIT.start(steps(lid, [found])[0])
    assert AUDIT.step(steps(lid, [found - 1e-9])[0], np.zeros(J), state).violations == 0
    assert AUDIT.step(steps(lid, [found + 1e-9])[0], np.zeros(J), state).violations == 1


def test_an_angle_that_is_not_finite_is_a_violation_and_does_not_spread():
    state = audited(steps(2, [0.0, np.nan, 0.0, 0.0]))
    assert state.violations == 1 and state.clamped == 1
