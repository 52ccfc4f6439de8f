"""The chase without ruckig obeys the law of the limiter, and arrives nearly as soon as ruckig does."""

import subprocess
import sys

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.motion.jerk_step import StopChase, TimeOptimalChase
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.runtime.loop import difference

DT_S = 0.01
RATES = (3.0, 30.0, 1500.0)  # speed, acceleration, jerk
ONE = JointLimits(np.array([-2.0]), np.array([2.0]), *(np.array([rate]) for rate in RATES))


def followed(chase, references, start=0.0):
    """Positions sent (T,), three at the start before them."""
    limiter = JerkLimiter(ONE, DT_S, chase)
    state, sent = limiter.start(np.array([start])), [start] * 3
    for reference in references:
        goals, state = limiter.step(reference, state)
        sent.append(float(goals[0]))
    return np.array(sent)


def still(angle) -> np.ndarray:
    return np.array([[angle], [0.0], [0.0]])


def assert_lawful(sent):
    assert (np.abs(sent) <= 2.0).all()
    for order, rate in enumerate(RATES, 1):
        assert (np.abs(np.diff(sent, order)) / DT_S**order <= rate * (1 + 1e-6)).all()


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_a_move_from_rest_to_rest_takes_hardly_longer_than_the_fastest(start, end):
    plan = ruckig.InputParameter(1)
    plan.current_position, plan.target_position = [start], [end]
    plan.max_velocity, plan.max_acceleration, plan.max_jerk = ([rate] for rate in RATES)
    path = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(plan, path)
    sent = followed(StopChase, [still(end)] * 400, start)
    assert_lawful(sent)
    arrived = int(np.argmax(np.abs(sent - end) < 1e-4)) - 2
    assert abs(sent[-1] - end) < 1e-9 and arrived * DT_S <= 1.05 * path.duration + 5 * DT_S
    assert (sent >= min(start, end) - 1e-9).all() and (sent <= max(start, end) + 1e-9).all()  # no overshoot


@pytest.mark.parametrize("chase", [TimeOptimalChase, StopChase])
@pytest.mark.parametrize("hz", [0.3, 0.7])
def test_a_moving_reference_is_met_again_after_a_jump(chase, hz):
    wave = 0.5 * np.sin(2 * np.pi * hz * DT_S * np.arange(402))[:, None]
    references = [difference(*wave[k : k + 3], DT_S) for k in range(400)]
    sent = followed(chase, references, start=1.9)
    assert_lawful(sent)
    assert sent[-100:] == pytest.approx(wave[301:401, 0], abs=1e-12)


def test_without_ruckig_the_limiter_chases_by_itself():
    code = (
        "import sys; sys.modules['ruckig'] = None\n"
        "from sfms_robot.motion.jerk_step import FASTEST, StopChase\n"
        "assert FASTEST is StopChase"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
