"""Gaze targets, the camera, and eyes that hold."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from life_rig import FULL_RAD, LEADS_S, PITCH, TICK_S, eyes_deg, lived

from sfms_robot.config import CameraMount, Gaze, Life, load_head
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM
from sfms_robot.retarget.channel_mapping import ChannelMapping
from sfms_robot.retarget.gaze import Camera
from sfms_robot.signals.gaze_kinematics import Jump, direction_to, directions, turn
from sfms_robot.signals.rotations import rotation


def looking(yaw_deg: float, pitch_deg: float = 0.0, **pose_rad: float) -> np.ndarray:
    """A motion row with both eyes turned."""
    row = np.zeros(MOTION_DIM, np.float32)
    turn(row, np.radians([[yaw_deg, pitch_deg]] * 2), FULL_RAD)
    for name, angle in pose_rad.items():
        row[CHANNEL_INDEX[name]] = angle
    return row


def looked(listener, seconds: float, **gaze) -> np.ndarray:
    return lived(Life(gaze=Gaze(**gaze)), seconds, listener)


@given(st.floats(-29, 29), st.floats(-19, 19), st.floats(-29, 29), st.floats(-19, 19))
def test_channels_and_directions_are_inverse(yaw_left, pitch_left, yaw_right, pitch_right):
    wanted = np.radians([[yaw_left, pitch_left], [yaw_right, pitch_right]])
    motion = np.zeros(MOTION_DIM, np.float32)
    turn(motion, wanted, FULL_RAD)
    assert directions(motion, FULL_RAD) == pytest.approx(wanted, abs=1e-6) and motion.min() >= 0


@pytest.mark.parametrize("size_deg", [0.0, 2.0, 10.0, 40.0])
def test_a_jump_takes_as_long_as_a_human_saccade_and_stays_where_it_lands(size_deg):
    jump = Jump.between(np.zeros(2), np.radians([size_deg, 0.0]), 1.0)
    assert jump.duration_s == pytest.approx(0.025 + 0.00235 * size_deg)
    path = np.degrees(jump.at(np.linspace(0.9, 1.3, 401)))[:, 0]
    assert path[0] == 0 and path[-1] == pytest.approx(size_deg) and np.all(np.diff(path) >= 0)


def test_eyes_jump_to_a_new_target_and_noise_inside_the_dead_zone_moves_none():
    noise = np.random.default_rng(0).uniform(-0.4, 0.4, (400, 2))
    shown = looked(lambda t: looking(5.0 + noise[int(t / TICK_S), 0], noise[int(t / TICK_S), 1]), 3.0)
    assert np.ptp(eyes_deg(shown), axis=(0, 1)).max() < 1e-4
    shown = eyes_deg(looked(lambda t: looking(0.0 if t < 0.5 else 12.0), 1.0))[:, 0, 0]
    assert shown[0] == 0 and shown[-1] == pytest.approx(12.0, abs=1e-3)
    between = (shown > 0.1) & (shown < 11.9)
    assert 0 < between.sum() * TICK_S <= 0.025 + 0.00235 * 12 + TICK_S


def test_eyes_take_back_a_nod_and_the_share_is_in_the_config():
    def nod(t):
        return looking(0.0, pitch=math.radians(5) * math.sin(2 * math.pi * 2 * t))

    for gain in (1.0, 0.5, 0.0):
        shown = looked(nod, 2.0, neck_gain=gain)
        in_space = eyes_deg(shown)[..., 1] + gain * np.degrees(shown[..., PITCH])
        assert np.ptp(in_space) < 1e-3


def test_a_listener_that_looks_at_one_point_while_nodding_is_left_alone():
    def nod(t):
        pitch_deg = 5 * math.sin(2 * math.pi * 2 * t)
        return looking(0.0, -pitch_deg, pitch=math.radians(pitch_deg))

    shown = looked(nod, 2.0)
    wanted = np.array([[nod(now_s + lead) for lead in LEADS_S] for now_s in TICK_S * np.arange(200)])
    assert shown == pytest.approx(wanted, abs=1e-5)


def test_eyes_turned_too_far_by_a_turning_head_jump_back_to_its_front():
    shown = eyes_deg(looked(lambda t: looking(0.0, yaw=0.5 * min(t, 1.5)), 3.0, recentre_deg=10.0))[..., 0]
    assert shown.min() < -8 and np.abs(shown).max() < 10 + 5  # 40 ms to settle at 29 deg/s, and the leads
    assert np.abs(shown[-1]).max() <= 10


def test_no_joint_jumps_whatever_its_lead():
    targets = np.random.default_rng(3).uniform(-20, 20, (20, 2)) * [1, 0.5]
    shown = eyes_deg(looked(lambda t: looking(*targets[int(t / 0.3)], yaw=0.3 * math.sin(3 * t)), 5.0))
    speed = np.abs(np.diff(shown, axis=0)) / TICK_S
    assert speed.max() < 1000  # a 40-degree saccade peaks at about 640 deg/s


def test_both_eyes_keep_the_angle_between_them_and_lids_follow_the_gaze_that_is_shown():
    row = looking(4.0)
    turn(row, np.radians([[6.0, 0.0], [2.0, 0.0]]), FULL_RAD)
    shown = looked(lambda t: row, 0.5)
    assert np.degrees(directions(shown[-1, 0], FULL_RAD))[:, 0] == pytest.approx([6.0, 2.0], abs=1e-4)
    head = load_head("face28")
    lid = list(head.joints).index("lid_left")
    shown = looked(lambda t: looking(0.0, pitch=-0.2 if t > 0.5 else 0.0), 1.0)  # nose up: the eyes go down
    before, after = (np.degrees(ChannelMapping(head).angles(row[0]))[lid] for row in (shown[0], shown[-1]))
    assert before == pytest.approx(0, abs=1e-6) and after > 5


METRES = st.tuples(*[st.floats(-3, 3)] * 3)
POSES = st.tuples(*[st.floats(-1, 1)] * 3, *[st.floats(-0.1, 0.1)] * 3).map(np.array)
MOUNTS = st.builds(
    CameraMount, on=st.sampled_from(["head", "base"]), at_m=METRES, rpy_deg=st.tuples(*[st.floats(-170, 170)] * 3)
)


def from_base(mount, place_m, pose):
    """The inverse of `Camera.to_base`."""
    mounted = np.array(place_m)
    if mount.on == "head":
        mounted = (mounted - pose[3:]) @ rotation(pose[:3])
    return (mounted - mount.at_m) @ rotation(np.radians(mount.rpy_deg))


@given(MOUNTS, METRES, POSES)
def test_there_and_back(mount, place_m, pose):
    camera = Camera(mount)
    assert camera.to_base(from_base(mount, place_m, pose), pose) == pytest.approx(np.array(place_m), abs=1e-9)
    assert from_base(mount, camera.to_base(place_m, pose), pose) == pytest.approx(np.array(place_m), abs=1e-9)


def test_a_camera_sees_a_person_from_a_turned_head_or_from_above_in_the_bases_axes():
    mount = CameraMount(on="head")
    camera, turned = Camera(mount), np.array([0, 0, np.radians(30), 0, 0, 0])
    assert np.degrees(direction_to(from_base(mount, (2.0, 0.0, 0.0), turned))) == pytest.approx([-30, 0])
    assert np.degrees(direction_to(camera.to_base((2.0, 0.0, 0.0), turned))) == pytest.approx([30, 0])
    camera = Camera(CameraMount(on="base", at_m=(0, 0, 0.3), rpy_deg=(0, 20, 0)))
    assert camera.to_base((1.0, 0.0, 0.0), np.zeros(6)) == pytest.approx([0.9397, 0, 0.3 - 0.342], abs=1e-3)
    assert np.degrees(direction_to(np.array([1.0, 1.0, 0.0]))) == pytest.approx([45, 0])
    assert np.degrees(direction_to(np.array([1.0, 0.0, -1.0]))) == pytest.approx([0, 45])  # below: nose down
