"""The six-legged platform of Reachy Mini: inverse in closed form, forward by a search, one against the other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from published import rows

from sfms_robot.config import load_head
from sfms_robot.config.kinematics import StewartPlatform
from sfms_robot.errors import ConfigError
from sfms_robot.retarget.head_retargeter import build_neck
from sfms_robot.retarget.stewart import Stewart
from sfms_robot.signals import rotations

HEAD = load_head("reachy_mini")
CONFIG = HEAD.kinematics
assert isinstance(CONFIG, StewartPlatform)
NECK = build_neck(CONFIG, HEAD.joints)
assert isinstance(NECK, Stewart)
PLATFORM = NECK.geometry
HOME = np.zeros(6)
WIDE = np.array([*np.radians([40, 40, 65]), 0.05, 0.05, 0.05])
WEIGHTS = np.array([0.1] * 3 + [1.0] * 3)  # pose -> metres: a radian counts as the 0.1 m by which it moves a head
seeds = st.integers(0, 2**32 - 1)


def distance_m(one, other):
    return np.linalg.norm((one - other) * WEIGHTS, axis=-1)


def in_reach(seed: int, count: int = 400) -> np.ndarray:
    """Poses all over the reach: what of a box around all of it the platform can take, about a quarter."""
    tried = np.random.default_rng(seed).uniform(-WIDE, WIDE, (count, 6))
    return tried[NECK.reachable(tried)]


@pytest.mark.parametrize("row", rows("reachy_mini_ik.csv"), ids=lambda row: row["name"])
def test_the_inverse_is_that_of_the_published_geometry(row):
    wanted = np.array([float(row[key]) for key in ("roll_rad", "pitch_rad", "yaw_rad", "x_m", "y_m", "z_m")])
    angles = [float(row[f"q{leg}_rad"]) for leg in range(1, 7)]
    body = float(row["body_yaw_rad"])
    assert PLATFORM.inverse(rotations.seen_from(body, wanted)) == pytest.approx(angles, abs=1e-9)
    solved = NECK.solve(wanted, np.array(body))
    assert solved.angles_rad == pytest.approx([body, *angles], abs=1e-9) and solved.reached


@given(seeds)
def test_forward_of_inverse_is_the_pose_all_over_the_reach_starting_at_home(seed):
    wanted = in_reach(seed, 100)
    assert np.abs(PLATFORM.forward(PLATFORM.inverse(wanted), HOME) - wanted).max() < 1e-9


@given(seeds)
def test_inverse_of_forward_is_the_cranks_starting_at_the_last_pose(seed):
    wanted = in_reach(seed, 100)
    cranks = PLATFORM.inverse(wanted)
    found = PLATFORM.forward(cranks, 0.9 * wanted)
    assert PLATFORM.inverse(found) == pytest.approx(cranks, abs=1e-9)


@given(seeds)
def test_every_rod_keeps_its_length(seed):
    wanted = in_reach(seed)
    for leg, angles in zip(CONFIG.legs, PLATFORM.inverse(wanted).T, strict=True):
        servo = np.array(leg.servo_from_body)
        arm = CONFIG.crank_m * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
        tips = (arm - servo[:, 3]) @ servo[:, :3]  # rotation and shift undone: in the body's frame
        ends = (
            rotations.rotation(wanted[:, :3]) @ np.array(leg.rod_end_m) + wanted[:, 3:] + [0, 0, CONFIG.home_height_m]
        )
        assert np.linalg.norm(ends - tips, axis=1) == pytest.approx(np.full(len(wanted), CONFIG.rod_m), abs=1e-12)


@given(seeds)
def test_a_mirrored_pose_gives_the_cranks_of_the_other_side_turned_the_other_way(seed):
    wanted = 0.9 * in_reach(seed)
    mirrored = wanted * np.array([-1, 1, -1, 1, -1, 1])
    assert PLATFORM.inverse(mirrored) == pytest.approx(-PLATFORM.inverse(wanted)[:, ::-1], abs=5e-4)  # as it was drawn


@given(seeds)
def test_a_small_move_of_the_head_is_a_small_move_of_the_cranks(seed):
    wanted = in_reach(seed)
    step = np.random.default_rng(seed).normal(size=wanted.shape) * 1e-6 / WEIGHTS
    moved = np.linalg.norm(PLATFORM.inverse(wanted + step) - PLATFORM.inverse(wanted), axis=1)
    assert (moved < 25 * distance_m(wanted + step, wanted) / CONFIG.crank_m).all()


def test_many_poses_at_once_are_the_same_as_one_by_one():
    wanted = in_reach(0)
    cranks = PLATFORM.inverse(wanted)
    assert np.array([PLATFORM.inverse(one) for one in wanted]) == pytest.approx(cranks, abs=1e-12)
    found = PLATFORM.forward(cranks, HOME)
    assert np.array([PLATFORM.forward(one, HOME) for one in cranks[:20]]) == pytest.approx(found[:20], abs=1e-9)
    square = PLATFORM.inverse(wanted[:20].reshape(4, 5, 6))
    assert square.shape == (4, 5, 6) and PLATFORM.forward(square, HOME).shape == (4, 5, 6)


def test_the_head_file_rests_the_legs_where_home_has_them():
    rest = [HEAD.joints[joint].rest_rad for joint in NECK.joints]
    assert NECK.solve(HOME).angles_rad == pytest.approx(rest, abs=1e-9)


def test_a_leg_that_does_not_reach_is_nan_and_so_is_a_pose_for_cranks_that_have_none():
    assert np.isnan(PLATFORM.inverse(np.array([0, 0, 0, 0, 0, 0.2]))).all()
    alternating = np.radians([80, -80, -48, 48, 80, -80.0])
    found = PLATFORM.forward(alternating, HOME)
    assert np.isnan(found).all() or PLATFORM.inverse(found) == pytest.approx(alternating, abs=1e-9)
    assert np.isnan(PLATFORM.forward(np.radians([80, 80, 80, 80, 80, 80.0]), HOME)).all()
    cranks = np.array([PLATFORM.inverse(HOME), np.full(6, np.nan), PLATFORM.inverse(HOME)])
    starts = np.array([HOME, HOME, [0, 0, 0, 0, 0, 0.2]])
    assert np.isnan(PLATFORM.forward(cranks, starts)).any(axis=1).tolist() == [False, True, True]


def test_a_home_outside_the_cranks_ranges_is_told_with_the_angles():
    for height_m, first in ((0.2005, r"82\.1"), (0.25, "nan")):
        raised = CONFIG.model_copy(update={"home_height_m": height_m})
        with pytest.raises(ConfigError, match=f"kinematics: home is out of reach: .*stewart_1 {first}"):
            build_neck(raised, HEAD.joints)
