"""Rotations and poses: the laws that every neck rests on."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sfms_robot.signals import rotations

turns = st.floats(-3.0, 3.0)
seeds = st.integers(0, 2**32 - 1)


def any_rotations(seed: int, count: int = 50) -> np.ndarray:
    return Rotation.from_rotvec(np.random.default_rng(seed).normal(size=(count, 3)) * 1.5).as_matrix()


@given(st.floats(-np.pi, np.pi), st.floats(-1.57, 1.57), st.floats(-np.pi, np.pi))
def test_rotations_and_angles_are_those_of_scipy(roll, pitch, yaw):
    turn = Rotation.from_euler("xyz", [roll, pitch, yaw])
    assert rotations.rotation(np.array([roll, pitch, yaw])) == pytest.approx(turn.as_matrix(), abs=1e-12)
    away = rotations.angles_of(turn.as_matrix()) - turn.as_euler("xyz")
    assert np.abs((away + np.pi) % (2 * np.pi) - np.pi).max() < 1e-9


def test_plus_is_right_ear_down_nose_down_and_left_and_small_angles_are_exact():
    forward, left = np.eye(3)[0], np.eye(3)[1]
    assert (rotations.rotation(np.array([0.3, 0, 0])) @ left)[2] > 0  # the left ear goes up
    assert (rotations.rotation(np.array([0, 0.3, 0])) @ forward)[2] < 0
    assert (rotations.rotation(np.array([0, 0, 0.3])) @ forward)[1] > 0
    assert rotations.angle_between(np.eye(3), rotations.about(1, 1e-9)) == pytest.approx(1e-9, rel=1e-6)


@pytest.mark.parametrize("axes", list(permutations(range(3))))
@given(seed=seeds)
def test_euler_angles_of_any_order_give_the_rotation_back(axes, seed):
    matrix = any_rotations(seed)
    angles = rotations.euler(matrix, axes)
    back = (
        rotations.about(axes[0], angles[:, 0])
        @ rotations.about(axes[1], angles[:, 1])
        @ rotations.about(axes[2], angles[:, 2])
    )
    assert np.abs(back - matrix).max() < 1e-9


@pytest.mark.parametrize("axes", list(permutations(range(3))))
@pytest.mark.parametrize("middle", [np.pi / 2, -np.pi / 2])
def test_with_the_middle_axis_at_ninety_degrees_the_last_angle_is_zero_and_the_rotation_the_same(axes, middle):
    a, b, c = axes
    matrix = rotations.about(a, 0.4) @ rotations.about(b, middle) @ rotations.about(c, 0.3)
    angles = rotations.euler(matrix, axes)
    assert angles[2] == 0.0
    assert rotations.about(a, angles[0]) @ rotations.about(b, angles[1]) == pytest.approx(matrix, abs=1e-9)


@given(seeds, st.integers(0, 2), st.floats(-0.5, 0.5))
def test_no_other_turn_about_the_axis_leaves_less_than_the_twist(seed, axis, off):
    matrix = any_rotations(seed)
    best = rotations.twist(matrix, axis)
    left = rotations.angle_between(matrix, rotations.about(axis, best))
    assert (left <= rotations.angle_between(matrix, rotations.about(axis, best + off)) + 1e-12).all()


@given(seeds, turns)
def test_a_pose_seen_from_a_turned_body_is_the_same_transform_in_its_frame(seed, body):
    world = np.random.default_rng(seed).uniform(-1, 1, (20, 6))
    seen, back = rotations.seen_from(body, world), rotations.about(2, body)
    assert back @ rotations.rotation(seen[:, :3]) == pytest.approx(rotations.rotation(world[:, :3]), abs=1e-12)
    assert seen[:, 3:] @ back.T == pytest.approx(world[:, 3:], abs=1e-12)
    assert rotations.seen_from(-body, seen) == pytest.approx(world, abs=1e-9)
