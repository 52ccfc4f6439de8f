"""The eyes take back what the neck shows, not what it was asked to show."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.config import Gaze, Life, load_head
from sfms_robot.config.calibrate_first import held_back
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM
from sfms_robot.retarget import spontaneous
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.signals.eye_angles import directions

FULL_RAD = np.radians([30.0, 20.0])
HEADS = {name: load_head(name) for name in ("face28", "inmoov2_ssc32", "reachy_mini", "op3_head")}
HEADS |= {f"{name}, cautious": held_back(head) for name, head in list(HEADS.items())}
RETARGETERS = {name: HeadRetargeter(head) for name, head in HEADS.items() if head.kinematics}


@pytest.mark.parametrize("name", RETARGETERS)
@settings(max_examples=6, deadline=None)
@given(
    intensity=st.floats(0, 2), style=st.floats(0, 2), yaw=st.floats(-0.5, 0.5), pitch=st.floats(-0.4, 0.4),
    roll=st.floats(-0.4, 0.4), hz=st.floats(0.2, 2.0),
)  # fmt: skip
def test_the_gaze_of_the_head_that_is_shown_stands_still(name, intensity, style, yaw, pitch, roll, hz):
    retargeter = RETARGETERS[name]
    region = "neck" in HEADS[name].regions
    knobs = retargeter.mapping.knobs({"neck": intensity} if region else {}, {"neck": style} if region else {})
    alive = spontaneous.Life(Life(gaze=Gaze(recentre_deg=90.0)), seed=0)
    state, rows = alive.start(), []
    for now_s in np.arange(0.0, 0.6, 0.03):
        times_s = now_s + np.array([0.0, 0.05])
        motion = np.zeros((2, MOTION_DIM), np.float32)
        for channel, size in (("yaw", yaw), ("pitch", pitch), ("roll", roll)):
            motion[:, CHANNEL_INDEX[channel]] = size * np.sin(2 * np.pi * hz * times_s)
        motion, state = alive.step(motion, times_s, now_s, state, lambda face: retargeter.shown_pose(face, knobs))
        rows.append(motion[0])
    motion = np.array(rows)
    poses = motion[:, :6].astype(float)
    solved = np.array([retargeter.angles(row, knobs)[retargeter.neck_columns] for row in motion])
    shown = retargeter.neck.forward(solved, 0 * poses)[:, [2, 1]]
    eyes = directions(motion, FULL_RAD).mean(axis=1)
    free = (np.abs(eyes) < 0.99 * FULL_RAD).all(axis=1)  # the eyes can turn so far
    assert not free.any() or np.ptp((eyes + shown)[free], axis=0).max() < 1e-3


def test_a_neck_that_is_switched_off_moves_no_eye():
    retargeter = RETARGETERS["face28"]
    knobs = retargeter.mapping.knobs({"neck": 0.0})
    alive = spontaneous.Life(Life(gaze=Gaze()), seed=0)
    state, times_s = alive.start(), np.zeros(2)
    for pitch in (0.0, 0.15):
        motion = np.zeros((2, MOTION_DIM), np.float32)
        motion[:, CHANNEL_INDEX["pitch"]] = pitch
        motion, state = alive.step(motion, times_s, 0.0, state, lambda face: retargeter.shown_pose(face, knobs))
    assert not directions(motion, FULL_RAD).any()


@pytest.mark.parametrize("name", RETARGETERS)
def test_a_pose_within_reach_is_shown_to_the_bit(name):
    motion = np.zeros((5, MOTION_DIM), np.float32)
    motion[:, :3] = np.random.default_rng(0).uniform(-0.02, 0.02, (5, 3))
    retargeter = RETARGETERS[name]
    if {"roll", "pitch", "yaw"} <= set(retargeter.neck.axes):
        assert np.array_equal(retargeter.shown_pose(motion)[:, :3], motion[:, :3].astype(float))
