"""The limiter keeps every limit, with ruckig and without, and arrives nearly as soon as ruckig does."""

import subprocess
import sys

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_head
from sfms_robot.motion.jerk_step import StopChase, TimeOptimalChase
from sfms_robot.motion.limits import JerkLimiter, JointLimits, _one_tick
from sfms_robot.runtime.loop import difference

DT_S = 0.01
LIMITS = JointLimits.of(load_head("face28"))
J = len(LIMITS.low)
LIMITER, WITHOUT_RUCKIG = JerkLimiter(LIMITS, DT_S), JerkLimiter(LIMITS, DT_S, StopChase)
FREE = (LIMITS.low < -np.radians(4)) & (LIMITS.high > np.radians(4))  # joints that can swing 4 degrees either way


def standing(angles) -> np.ndarray:
    angles = np.broadcast_to(np.asarray(angles, dtype=float), (J,))
    return np.stack([angles, np.zeros(J), np.zeros(J)])


def followed(references, start=None, limiter=None):
    """Positions sent, the three before the start included, and the last state."""
    start = np.zeros(J) if start is None else start
    limiter = limiter or LIMITER
    state, sent = limiter.start(start), [start] * 3
    for wanted in references:
        goals, state = limiter.step(wanted, state)
        sent.append(goals)
    return np.array(sent), state


def excess(sent, limits=LIMITS) -> float:
    """Largest share by which finite differences exceed a limit; inf when a position does at all."""
    if not (np.isfinite(sent).all() and (sent >= limits.low).all() and (sent <= limits.high).all()):
        return np.inf
    bounds = (limits.speed, limits.acceleration, limits.jerk)
    return max(np.abs(np.diff(sent, n, axis=0) / DT_S**n / bound).max() - 1 for n, bound in enumerate(bounds, 1))


def square_wave(rng, ticks):
    """From edge to edge, every joint at its own time."""
    half = rng.integers(2, 60, J)
    return [standing(np.where((k // half) % 2, LIMITS.low, LIMITS.high)) for k in range(ticks)]


def random_walk(rng, ticks):
    walk = np.cumsum(rng.normal(size=(ticks + 2, J)) * rng.uniform(1e-4, 0.1), axis=0)
    return [difference(*walk[k : k + 3], DT_S) for k in range(ticks)]


def bang_bang_jerk(rng, ticks):
    """Rides on the limits themselves: full jerk one way or the other, integrated, range ignored."""
    motion, out = np.zeros((3, J)), []
    for _ in range(ticks):
        jerk = LIMITS.jerk * rng.choice([-1.0, 0.0, 1.0], J)
        p, v, a = motion
        motion = np.stack([p + v * DT_S + a * DT_S**2 / 2 + jerk * DT_S**3 / 6, v + a * DT_S + jerk * DT_S**2 / 2, a])
        motion[2] = np.clip(a + jerk * DT_S, -LIMITS.acceleration, LIMITS.acceleration)
        motion[1] = np.clip(motion[1], -LIMITS.speed, LIMITS.speed)
        out.append(motion)
    return out


@pytest.mark.parametrize(("ruckig_there", "ticks"), [(True, 1500), (False, 300)])
@pytest.mark.parametrize("adversary", [square_wave, random_walk, bang_bang_jerk])
def test_no_command_ever_exceeds_a_limit(adversary, ruckig_there, ticks):
    rng = np.random.default_rng(0)
    sent, _ = followed(adversary(rng, ticks), limiter=LIMITER if ruckig_there else WITHOUT_RUCKIG)
    assert excess(sent) < 1e-6


@given(st.integers(0, 2**32 - 1))
def test_any_pose_is_a_fixed_point(seed):
    pose = np.random.default_rng(seed).uniform(LIMITS.low, LIMITS.high)
    sent, state = followed([standing(pose)] * 20, pose)
    assert np.array_equal(sent, np.broadcast_to(pose, sent.shape)) and state.chased == 0


@pytest.mark.parametrize("edge", [LIMITS.low, LIMITS.high])
def test_the_edges_of_the_range_are_reached_and_kept(edge):
    sent, _ = followed([standing(edge)] * 200)
    assert np.abs(sent[-20:] - edge).max() < 1e-9


def test_a_slow_nod_passes_unchanged():
    t = DT_S * np.arange(-1, 400)
    rise = np.clip(t / 0.5, 0, 1)
    nod = np.radians(2.5) * rise**3 * (10 - 15 * rise + 6 * rise**2) * np.sin(2 * np.pi * 2 * t)
    angles = np.outer(nod, FREE)
    sent, state = followed([difference(*angles[k - 1 : k + 2], DT_S) for k in range(1, 400)])
    assert state.chased == 0 and np.array_equal(sent[3:], angles[1:400])


def test_what_is_not_finite_is_refused_and_the_joint_comes_to_a_stop():
    moving = [np.stack([LIMITS.speed * 0.2 * DT_S * k, LIMITS.speed * 0.2, 0 * LIMITS.speed]) for k in range(4)]
    for row in range(3):  # angle, speed, acceleration
        lost = np.where(np.arange(3)[:, None] == row, np.nan, np.zeros((3, J)))
        sent, state = followed([*moving, *[lost] * 60])
        assert excess(sent) < 1e-6 and state.refused == 60 * J
        assert not np.diff(sent[-20:], axis=0).any() and not state.motion[1:].any()


def test_a_steady_reference_that_goes_on_past_the_range_is_left_before_its_end():
    path = LIMITS.high - 0.301 + 0.3 * DT_S * np.arange(130)[:, None]
    start = np.clip(path[0], LIMITS.low, LIMITS.high)
    assert excess(followed([difference(*path[k : k + 3], DT_S) for k in range(128)], start)[0]) < 1e-6


def test_acceleration_between_two_samples_counts_too():
    """It is highest two thirds through each of the last ticks, which begin and end just below its limit."""
    (p, v, a), h, references = np.zeros((3, J)), DT_S / 3, []
    ramp, most = 0.999 * LIMITS.acceleration / (4 * DT_S), 0.9 * LIMITS.jerk
    for jerks in [(ramp, ramp, ramp)] * 4 + [(0 * most, most, -most)] * 4:
        for j in jerks:
            p, v, a = p + v * h + a * h**2 / 2 + j * h**3 / 6, v + a * h + j * h**2 / 2, a + j * h
        references.append(np.stack([p, v, a]))
    assert excess(followed([*references, *[standing(0.0)] * 60])[0]) < 1e-6


def test_one_broken_joint_does_not_disturb_the_others():
    t = DT_S * np.arange(102)
    angles = np.outer(np.radians(1) * np.sin(2 * np.pi * 0.5 * t) ** 3, FREE)
    good = [difference(*angles[k : k + 3], DT_S) for k in range(100)]
    bad = [np.where(np.arange(J) == 3, np.nan, wanted) for wanted in good]
    others = np.arange(J) != 3
    assert np.array_equal(followed(good)[0][:, others], followed(bad)[0][:, others])


def test_a_joint_brakes_where_ruckig_gives_up():
    state = LIMITER.start(np.zeros(J))
    state.motion[:, 3] = 0.17804168553992583, -7.8795453147226855, -421.2077944104259  # ruckig 0.19: result -101
    wanted = state.motion.copy()
    wanted[:, 3] = 0.1440767811399577, 17.453289029284793, 2094.394683514175
    _, after = LIMITER.step(wanted, state)
    assert abs(after.motion[1, 3]) < abs(state.motion[1, 3]) and after.chased == 1


def test_it_does_not_start_from_nonsense():
    with pytest.raises(ValueError, match="joint 2 starts at an angle that is not finite"):
        LIMITER.start(np.where(np.arange(J) == 2, np.nan, 0.0))


def test_a_step_leaves_its_state_alone():
    state = LIMITER.start(np.zeros(J))
    goals, after = LIMITER.step(standing(LIMITS.high), state)
    goals += 1.0
    assert not state.motion.any() and (after.motion[0] <= LIMITS.high).all()


def test_two_states_tell_the_jerks_between_them_and_what_the_tick_reaches_inside():
    jerks, before = np.array([700.0, -400.0, 250.0]), np.array([0.2, 0.5, -3.0])
    state, corners, h = before, [], DT_S / 3
    for jerk in jerks:
        q, v, a = state
        state = np.array([q + v * h + a * h**2 / 2 + jerk * h**3 / 6, v + a * h + jerk * h**2 / 2, a + jerk * h])
        corners.append(state[2])
    told = _one_tick(DT_S) @ np.concatenate([before, state])
    assert told == pytest.approx([*jerks, *corners[:2], state[0] - before[0]], rel=1e-6)


def test_the_reference_of_a_parabola_is_exact():
    t = np.array([[0.99], [1.0], [1.01]])
    assert difference(*(1 + 2 * t + 3 * t**2), 0.01)[:, 0] == pytest.approx([6, 8, 6])


RATES = (3.0, 30.0, 1500.0)  # speed, acceleration, jerk
ONE = JointLimits(np.array([-2.0]), np.array([2.0]), *(np.array([rate]) for rate in RATES))


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_a_move_from_rest_to_rest_takes_hardly_longer_than_the_fastest(start, end):
    plan = ruckig.InputParameter(1)
    plan.current_position, plan.target_position = [start], [end]
    plan.max_velocity, plan.max_acceleration, plan.max_jerk = ([rate] for rate in RATES)
    path = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(plan, path)
    still = np.array([[end], [0.0], [0.0]])
    sent, _ = followed([still] * 400, np.array([start]), JerkLimiter(ONE, DT_S, StopChase))
    assert excess(sent, ONE) < 1e-6
    arrived = int(np.argmax(np.abs(sent - end) < 1e-4)) - 2
    assert abs(sent[-1] - end) < 1e-9 and arrived * DT_S <= 1.05 * path.duration + 5 * DT_S
    assert (sent >= min(start, end) - 1e-9).all() and (sent <= max(start, end) + 1e-9).all()  # no overshoot


@pytest.mark.parametrize("chase", [TimeOptimalChase, StopChase])
@pytest.mark.parametrize("hz", [0.3, 0.7])
def test_a_moving_reference_is_met_again_after_a_jump(chase, hz):
    wave = 0.5 * np.sin(2 * np.pi * hz * DT_S * np.arange(402))[:, None]
    references = [difference(*wave[k : k + 3], DT_S) for k in range(400)]
    sent, _ = followed(references, np.array([1.9]), JerkLimiter(ONE, DT_S, chase))
    assert excess(sent, ONE) < 1e-6 and sent[-100:] == pytest.approx(wave[301:401], abs=1e-12)


def test_without_ruckig_the_limiter_chases_by_itself():
    code = (
        "import sys; sys.modules['ruckig'] = None\n"
        "from sfms_robot.motion.jerk_step import FASTEST, StopChase\n"
        "assert FASTEST is StopChase"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
