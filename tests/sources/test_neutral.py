"""Rest is learned while a person is seen; what they do apart from it stays."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, POSE, SHAPES
from sfms_robot.signals.rotations import rotation
from sfms_robot.signals.spaces import angles_of
from sfms_robot.sources.live_face import AWAY_S, RestingFace

SMILE, JAW = CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["jawOpen"]
HZ = 10


def motion(pose=(0, 0, 0), **shapes):
    out = np.zeros(MOTION_DIM, np.float32)
    out[:3] = pose
    for name, value in shapes.items():
        out[CHANNEL_INDEX[name]] = value
    return out


def follow(faces, start_s=0.0, state=None):
    """Return what comes of faces at `HZ`, and the memory."""
    state = state or RestingFace()
    return np.array([state.relative(face, start_s + i / HZ) for i, face in enumerate(faces)]), state


angles = st.floats(-0.8, 0.8)


@given(st.tuples(angles, angles, angles), st.floats(0, 0.5))
def test_a_face_that_never_moves_is_at_rest_from_the_first_frame_on(pose, smile):
    out, _ = follow([motion(pose, mouthSmileLeft=smile)] * 20)
    assert np.abs(out).max() < 1e-5


@given(st.tuples(angles, angles, angles), st.integers(0, 2**32 - 1))
def test_whatever_the_first_face_did_the_offset_is_gone_after_3_s(pose, seed):
    """A person around some pose, caught in mid-turn, with a smile, at the start."""
    random = np.random.default_rng(seed)
    faces = [motion(np.add(pose, random.normal(0, 0.01, 3)), jawOpen=0.1) for _ in range(60)]
    faces[0] = motion(np.add(pose, 0.4), jawOpen=0.1, mouthSmileLeft=0.9)
    out, _ = follow(faces)
    assert np.abs(out[30:, :3]).max() < 0.08
    assert out[30:, JAW].max() < 0.02


def test_after_the_camera_was_moved_straight_ahead_is_found_anew():
    _, state = follow([motion((0, 0, 0))] * 120 * HZ)
    out, _ = follow([motion((0, 0.2, 0.5))] * 80 * HZ, 120, state)
    assert abs(out[0][2]) > 0.4
    assert np.abs(out[-1][:3]).max() < 0.01


@pytest.mark.parametrize("seconds", [1, 10, 50])
def test_what_lasts_less_than_a_minute_stays_what_it_is(seconds):
    _, state = follow([motion((0.1, 0, 0), mouthSmileLeft=0.1)] * 120 * HZ)
    out, _ = follow([motion((0.1, 0, 0.5), mouthSmileLeft=0.6)] * seconds * HZ, 120, state)
    assert out[:, SMILE] == pytest.approx((0.6 - 0.1) / 0.9, abs=1e-5)
    assert out[:, 2].min() > 0.45


def test_a_held_expression_never_goes_whole():
    out, _ = follow([motion(mouthSmileLeft=0.9)] * 300 * HZ)
    assert out[:, SMILE].min() > 0.75


def test_a_pose_is_told_from_the_resting_one_as_rotations_are():
    at_rest, turn = np.array([0.1, -0.2, 0.6]), np.array([0.0, 0.3, 0.0])
    rest_matrix, turn_matrix = rotation(np.stack([at_rest, turn]))
    seen = angles_of((rest_matrix @ turn_matrix)[None])[0]
    _, state = follow([motion(at_rest)] * 10 * HZ)
    (out,), _ = follow([motion(seen)], 10, state)
    assert out[:3] == pytest.approx(turn, abs=1e-5)


def test_a_place_is_told_from_the_resting_one_in_the_persons_axes():
    far = motion((0, 0, np.pi / 2))
    far[3:6] = (1.0, 2.0, 3.0)
    _, state = follow([far] * 10 * HZ)
    nearer = far.copy()
    nearer[4] += 0.1  # the camera's left is straight ahead of who is turned to it
    (out,), _ = follow([nearer], 10, state)
    assert out[3:6] == pytest.approx([0.1, 0, 0], abs=1e-5)


def test_who_comes_back_after_10_s_is_somebody_else():
    _, state = follow([motion((0, 0, 0))] * 60 * HZ)
    out, state = follow([motion((0, 0, 0.5))] * 10, 60 + AWAY_S, state)
    assert np.abs(out).max() < 1e-5
    assert len(state.samples) < 5


def test_who_comes_back_sooner_is_known():
    _, state = follow([motion((0, 0, 0))] * 60 * HZ)
    out, _ = follow([motion((0, 0, 0.5))] * 10, 60 + AWAY_S / 2, state)
    assert out[0][2] == pytest.approx(0.5, abs=1e-4)


def test_memory_is_bounded():
    _, state = follow([motion((0.1, 0, 0))] * 200 * HZ)
    assert state.samples.shape == (240, MOTION_DIM)


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(0, 1), st.floats(0, 30)), min_size=1, max_size=40))
def test_what_comes_out_is_a_face(faces):
    state, time_s = RestingFace(), 0.0
    for angle, value, pause_s in faces:
        time_s += pause_s
        given_face = np.full(MOTION_DIM, value, np.float32)
        given_face[POSE] = angle
        out = state.relative(given_face, time_s)
        assert np.isfinite(out).all()
        assert out[SHAPES].min() >= 0 and out[SHAPES].max() <= 1
