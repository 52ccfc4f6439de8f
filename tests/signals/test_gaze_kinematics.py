"""Gaze kinematics, and the minimum-jerk path."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sfms_robot.frames import FRAME_HZ, FRAME_S, MOTION_DIM, POSE
from sfms_robot.signals import gaze_kinematics as gaze
from sfms_robot.signals.gaze_kinematics import directions
from sfms_robot.signals.minimum_jerk import ease, minimum_jerk

FULL_RAD = np.array([gaze.EYE_PAN_RAD, gaze.EYE_TILT_RAD])
TARGETS = st.tuples(st.floats(-30, 30), st.floats(-20, 20)).map(np.radians)
SEEDS = st.integers(0, 10_000)


def played(targets, poses, state):
    """Motion (N, 58) of a head with these poses that looks at these targets, and the head's part (N, 3) of it."""
    motion = np.zeros((len(targets), MOTION_DIM), np.float32)
    motion[:, POSE] = poses
    head, eyes, _ = gaze.follow(targets, poses, state)
    motion[:, :3] += head
    motion[:, list(gaze.EYE_CHANNELS)] = eyes
    return motion, head


def gaze_of(motion):
    """(N, 2) yaw and pitch of head and eyes together."""
    return motion[:, [2, 1]] + directions(motion, FULL_RAD).mean(axis=1)


def shift(first, second, before=25, after=50):
    return np.concatenate([np.tile(first, (before, 1)), np.tile(second, (after, 1))])


def nod(frames, size_rad, length_s=0.5, at=30):
    pose, long = np.zeros((frames, 6)), round(length_s * FRAME_HZ)
    pose[at : at + long, 1] = size_rad * (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(long) / long))
    return pose


@given(st.lists(TARGETS, min_size=1, max_size=6), SEEDS)
def test_a_whole_is_its_frames_one_by_one_and_mirrored_targets_give_mirrored_motion(places, seed):
    targets = np.repeat(places, 9, axis=0)
    poses = np.random.default_rng(seed).normal(0, 0.02, (len(targets), 6))
    head, eyes, states = gaze.follow(targets, poses, gaze.start(seed))
    state = gaze.start(seed)
    for row, (target, pose) in enumerate(zip(targets, poses, strict=True)):
        one_head, one_eyes, (state,) = gaze.follow([target], [pose], state)
        np.testing.assert_array_equal(one_head[0], head[row])
        np.testing.assert_array_equal(one_eyes[0], eyes[row])
        assert state == states[row]
    targets = np.repeat(places, 12, axis=0)
    poses, state = np.zeros((len(targets), 6)), gaze.start(seed, wanders=False)
    one, _ = played(targets, poses, state)
    two, _ = played(targets * [-1, 1], poses, state)
    np.testing.assert_allclose(two[:, :3], one[:, :3] * [-1, 1, -1], atol=1e-6)
    np.testing.assert_allclose(gaze_of(two), gaze_of(one) * [-1, 1], atol=1e-6)


@given(TARGETS, TARGETS, SEEDS)
def test_gaze_is_there_after_a_fifth_of_a_second(first, second, seed):
    if math.dist(first, second) > math.radians(30):
        second = first + (second - first) * math.radians(30) / math.dist(first, second)
    targets = shift(first, second)
    motion, _ = played(targets, np.zeros((75, 6)), gaze.start(seed))
    off = np.hypot(*(gaze_of(motion) - targets).T)
    assert np.degrees(off[25 + 4 :]).max() < 3 and np.degrees(off[15:25]).max() < 3


@given(SEEDS, TARGETS.map(lambda target: 0.4 * target))
@example(212, np.zeros(2))  # a long fixation that drifts outwards
def test_eyes_hold_their_target_while_the_head_nods(seed, target):
    targets = np.tile(target, (80, 1))
    motion, _ = played(targets, nod(80, math.radians(8)), gaze.start(seed))
    assert np.degrees(np.hypot(*(gaze_of(motion) - targets)[25:].T)).max() < 1.5


@given(SEEDS)
def test_the_eyes_leave_first_and_the_head_follows_more_for_a_larger_shift(seed):
    targets = shift(np.zeros(2), np.radians([24.0, 0.0]))
    motion, head = played(targets, np.zeros((75, 6)), gaze.start(seed, wanders=False))
    yaw, final = gaze_of(motion)[:, 0], head[-1, 2]
    arrived = 25 + int(np.argmax(yaw[25:] > 0.95 * targets[-1, 0]))
    turned = 25 + int(np.argmax(head[25:, 2] > 0.95 * final))
    assert 1 <= arrived - 24 <= 3  # 40 to 120 ms
    assert turned - arrived >= 3
    assert head[25, 2] < 0.05 * final
    speed = np.diff(head[24:, 2])
    peak = int(speed.argmax())
    assert (np.diff(speed[: peak + 1]) > -1e-6).all() and (np.diff(speed[peak:]) < 1e-6).all()  # one bell
    state = gaze.start(seed)
    shares = [
        gaze.head_share((math.radians(size), 0.0), state.share)[0] / math.radians(size) for size in (4, 8, 16, 28)
    ]
    assert shares == sorted(shares) and shares[0] < 0.16 and shares[1] < 0.3 and shares[-1] > 0.3


@given(st.lists(TARGETS, min_size=2, max_size=8), SEEDS, st.integers(2, 20))
def test_the_head_never_jumps_and_neither_does_its_speed(places, seed, held):
    targets = np.concatenate([np.repeat(places, held, axis=0), np.tile(places[-1], (30, 1))])
    head, _, _ = gaze.follow(targets, np.zeros((len(targets), 6)), gaze.start(seed))
    speed = np.diff(np.concatenate([np.zeros((1, 3)), head]), axis=0) / FRAME_S
    assert np.degrees(np.abs(speed).max()) < 180
    assert np.degrees(np.abs(np.diff(speed, axis=0)).max() / FRAME_S) < 1600


def test_a_still_target_keeps_the_head_where_it_is_and_a_slow_one_is_followed_without_a_shift():
    targets = shift(np.zeros(2), np.radians([20.0, 6.0]), 5, 200)
    head, _, _ = gaze.follow(targets, np.zeros((205, 6)), gaze.start(3))
    assert np.ptp(head[40:], axis=0).max() == 0 and head[40, 2] > 0 and head[40, 1] > 0
    targets = np.radians(np.stack([np.linspace(0, 15, 200), np.zeros(200)], axis=1))
    motion, _ = played(targets, np.zeros((200, 6)), gaze.start(1, wanders=False))
    assert np.degrees(np.abs(gaze_of(motion) - targets)[1:]).max() < 0.2


def test_eyes_wander_over_what_they_look_at_as_peoples_do():
    motion, _ = played(np.zeros((3000, 2)), np.zeros((3000, 6)), gaze.start(5))
    where = gaze_of(motion)
    steps = np.hypot(*np.diff(where, axis=0).T)
    shifts = np.flatnonzero(steps > np.radians(0.15))
    assert 0.2 < np.median(np.diff(shifts)) * FRAME_S < 0.32  # 228 ms, in frames of 40
    assert 0.6 < np.degrees(np.median(steps[shifts])) < 1.2
    assert np.degrees(np.hypot(*where.T)).max() < 1.5


@pytest.mark.parametrize("target, pitch", [((np.nan, 0), 0), ((0, np.inf), 0), ((0, 0), np.nan)])
def test_what_is_not_finite_is_refused(target, pitch):
    pose = np.array([0, pitch, 0, 0, 0, 0.0])
    with pytest.raises(ValueError, match="not finite"):
        gaze.follow([target], [pose], gaze.start(0))


def test_a_path_rests_at_both_ends_and_before_and_after_it_and_is_its_own_mirror():
    u = np.linspace(0.0, 1.0, 201)
    assert (ease(-0.1), ease(1.1)) == (0.0, 1.0) and np.array_equal(ease(u), minimum_jerk(u))
    way = minimum_jerk(u)
    assert (way[0], way[-1]) == (0.0, 1.0) and np.all(np.diff(way) > 0)
    assert way + way[::-1] == pytest.approx(np.ones(201), abs=1e-12)
    for ends in (way[:2], 1 - way[-2:]):
        assert np.ptp(ends) < 10.1 * 0.005**3  # third order: neither speed nor acceleration
