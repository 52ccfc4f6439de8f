"""The eyes take back what the neck shows, not what it was asked to show."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from life_rig import FULL_RAD, NOBODY

from sfms_robot.config import Gaze, Life, load_head
from sfms_robot.config.head import held_back
from sfms_robot.data import head_names
from sfms_robot.frames import MOTION_DIM
from sfms_robot.retarget import spontaneous
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.signals.gaze_kinematics import directions
from sfms_robot.signals.rotations import rotation

HEADS = {name: load_head(name) for name in head_names()}
HEADS |= {f"{name}, cautious": held_back(head, head.joints) for name, head in list(HEADS.items())}
RECENTRE_DEG = 400.0  # they never jump back to where the face has them
RETARGETERS = {name: HeadRetargeter(head) for name, head in HEADS.items() if head.kinematics}


turns = st.tuples(st.floats(-1.2, 1.2), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0))  # roll, pitch, yaw
shifts = st.tuples(*[st.floats(-0.05, 0.05)] * 3)
knobs = {"intensity": st.floats(0, 2), "style": st.floats(0, 2)}


def turned(name, intensity, style):
    retargeter = RETARGETERS[name]
    if "neck" not in HEADS[name].regions:
        return retargeter, retargeter.mapping.knobs()
    return retargeter, retargeter.mapping.knobs({"neck": intensity}, {"neck": style})


@pytest.mark.parametrize("name", RETARGETERS)
@settings(max_examples=10)
@given(**knobs, turn=turns, shift=shifts)
@example(intensity=2.0, style=1.0, turn=(0.0, 0.5, 1.0), shift=(0.0, 0.0, 0.0))
@example(intensity=2.0, style=0.0, turn=(0.0, 0.875, 0.0), shift=(0.0, 0.0, 0.0))
def test_the_pose_that_is_said_to_be_shown_is_the_one_that_the_joints_give(name, intensity, style, turn, shift):
    retargeter, knobs = turned(name, intensity, style)
    motion = np.zeros((1, MOTION_DIM), np.float32)
    motion[0, :6] = [*turn, *shift]
    shown = retargeter.shown_pose(motion, knobs)
    given_rad = retargeter.angles(motion[0], knobs)[retargeter.neck_columns]
    forward = retargeter.neck.forward(given_rad[None], shown)
    assert rotation(shown[:, :3]) == pytest.approx(rotation(forward[:, :3]), abs=1e-6)  # past 90 degrees of pitch too
    assert shown[:, 3:] == pytest.approx(forward[:, 3:], abs=1e-6)


@pytest.mark.parametrize("name", RETARGETERS)
@settings(max_examples=10)
@given(**knobs, turn=turns, shift=shifts, hz=st.floats(0.2, 2.0))
@example(intensity=0.0, style=1.0, turn=(0.1, 0.15, 0.2), shift=(0.0, 0.0, 0.0), hz=1.0)  # switched off
def test_the_gaze_of_the_head_that_is_shown_stands_still(name, intensity, style, turn, shift, hz):
    retargeter, knobs = turned(name, intensity, style)
    alive = spontaneous.HeadLife(Life(gaze=Gaze(recentre_deg=RECENTRE_DEG)), seed=0)
    state, rows = spontaneous.LifeState(), []
    for now_s in np.arange(0.0, 0.6, 0.03):
        times_s = now_s + np.array([0.0, 0.05])
        motion = np.zeros((2, MOTION_DIM), np.float32)
        motion[:, :6] = np.sin(2 * np.pi * hz * times_s)[:, None] * [*turn, *shift]
        motion, state = alive.step(motion, times_s, now_s, state, lambda f: retargeter.shown_pose(f, knobs), NOBODY)
        rows.append(motion[0])
    motion = np.array(rows)
    solved = np.array([retargeter.angles(row, knobs)[retargeter.neck_columns] for row in motion])
    shown = retargeter.neck.forward(solved, retargeter.shown_pose(motion, knobs))[:, [2, 1]]
    eyes = directions(motion, FULL_RAD).mean(axis=1)
    assert np.isfinite(eyes).all()
    free = (np.abs(eyes) < 0.99 * FULL_RAD).all(axis=1)  # the eyes can turn so far
    assert not free.any() or np.ptp((eyes + shown)[free], axis=0).max() < 1e-3


@pytest.mark.parametrize("name", RETARGETERS)
def test_a_pose_within_reach_is_shown_to_the_bit(name):
    motion = np.zeros((5, MOTION_DIM), np.float32)
    motion[:, :3] = np.random.default_rng(0).uniform(-0.02, 0.02, (5, 3))
    retargeter = RETARGETERS[name]
    if {"roll", "pitch", "yaw"} <= set(retargeter.neck.axes):
        assert np.array_equal(retargeter.shown_pose(motion)[:, :3], motion[:, :3].astype(float))
