import numpy as np
import pytest

from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, MOTION_DIM
from sfms_robot.lab.evaluation import detection


def still(seconds):
    return np.zeros((seconds * FRAME_HZ, MOTION_DIM), np.float32)


def test_nods_are_counted_with_their_size_length_and_swings():
    motion, times_s = still(20), np.arange(20 * FRAME_HZ) / FRAME_HZ
    for at_s, swings in ((4.0, 1), (12.0, 3)):
        inside = (times_s >= at_s) & (times_s < at_s + 0.5 * swings)
        motion[inside, CHANNEL_INDEX["pitch"]] = 0.05 * (1 - np.cos(2 * np.pi * (times_s[inside] - at_s) / 0.5)) / 2
    sizes, lengths, swings = detection.nods_of([motion]).T
    assert sizes == pytest.approx([0.05, 0.05], rel=0.1)
    assert lengths == pytest.approx([0.5, 1.5], abs=0.2) and swings.tolist() == [1, 3]
    assert detection.movement([motion], [np.ones(len(motion), bool)])["nod_swings"] == 2


def test_gaze_is_head_and_eyes_and_its_looks_end_with_shifts():
    motion = still(10)
    motion[5 * FRAME_HZ :, CHANNEL_INDEX["yaw"]] = np.deg2rad(5)
    motion[5 * FRAME_HZ :, CHANNEL_INDEX["eyeLookOutLeft"]] = 0.5
    motion[5 * FRAME_HZ :, CHANNEL_INDEX["eyeLookInRight"]] = 0.5
    gaze = detection.gaze_rad(motion)
    assert np.degrees(gaze[-1]) == pytest.approx([20, 0]) and detection.shifts(gaze) == 1
    assert detection.looks_s(gaze) == pytest.approx([5.0])
    found = detection.movement([motion], [np.ones(len(motion), bool)])
    assert found["gaze_on_person"] == pytest.approx(0.5)
    assert found["gaze_shifts_per_minute"] == pytest.approx(6.0)
    assert np.isnan(detection.movement([motion], [np.zeros(len(motion), bool)])["gaze_on_person"])


def test_sway_lies_in_its_band():
    times_s = np.arange(120 * FRAME_HZ) / FRAME_HZ
    for number, (low, high) in enumerate(detection.SWAY_BANDS_HZ):
        motion = still(120)
        motion[:, 2] = 0.02 * np.sin(2 * np.pi * np.sqrt(low * high) * times_s)
        assert np.argmax(detection.sway_db([motion])) == number
    assert np.isnan(detection.sway_db([still(5)])).all()


def test_a_slow_pose_is_the_median_of_ten_seconds_and_who_does_nothing_has_no_lengths():
    motion = still(20)
    motion[: 2 * FRAME_HZ, 2] = 1.0
    motion[10 * FRAME_HZ :, 2] = np.deg2rad(3)
    assert detection.slow_poses_deg([motion])[:, 2] == pytest.approx([0, 3])
    found = detection.movement([still(30)], [np.ones(30 * FRAME_HZ, bool)])
    assert np.isnan([found[name] for name in ("nod_deg", "blink_s", "smile_s", "look_s")]).all()
    assert found["gaze_on_person"] == 1.0
