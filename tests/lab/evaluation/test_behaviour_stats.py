from dataclasses import replace

import numpy as np
import pytest

from sfms_robot.data import data_dir
from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, MOTION_DIM
from sfms_robot.lab.corpora.compose.render_events import nod_curve
from sfms_robot.lab.evaluation import detection
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.signals.motion_primitives import read_motions


def still(seconds):
    return np.zeros((seconds * FRAME_HZ, MOTION_DIM), np.float32)


def test_nods_are_counted_with_their_size_length_and_swings():
    motion, times_s = still(20), np.arange(20 * FRAME_HZ) / FRAME_HZ
    for at_s, swings in ((4.0, 1), (12.0, 3)):
        inside = (times_s >= at_s) & (times_s < at_s + 0.5 * swings)
        motion[inside, CHANNEL_INDEX["pitch"]] = 0.05 * (1 - np.cos(2 * np.pi * (times_s[inside] - at_s) / 0.5)) / 2
    sizes, lengths, cycles, swings = detection.nods_of([motion]).T
    assert sizes == pytest.approx([0.05, 0.05], rel=0.1) and swings.tolist() == [1, 3]
    assert lengths == pytest.approx([0.25, 1.25], abs=0.02) and cycles == pytest.approx([0.25, 0.25], abs=0.02)
    found = detection.movement([motion], [np.ones(len(motion), bool)])
    assert (found["nod_swings"], found["nod_cycle_s"]) == (2, pytest.approx(0.25, abs=0.02))


@pytest.mark.parametrize(("swings", "swing_s"), [(1, 0.34), (1, 0.66), (2, 0.42), (3, 0.55), (4, 0.36)])
def test_a_nod_is_as_long_as_it_is_half_as_deep_as_it_gets(swings, swing_s):
    """Of n swings of T: n T less half a swing, up or down, dying away, on a head that leans slowly; a cycle: T / 2."""
    for way, fall in ((1, 1.0), (-1, 0.8)):
        motion, swing = still(12), (np.arange(12 * FRAME_HZ) / FRAME_HZ - 5) / swing_s
        deep = 0.08 * fall ** np.floor(swing) * np.sin(np.pi * swing) ** 2
        motion[:, CHANNEL_INDEX["pitch"]] = np.where((swing > 0) & (swing < swings), way * deep, 0) + 0.002 * swing
        ((_, length_s, cycle_s, count),) = detection.nods_of([motion])
        assert length_s == pytest.approx((swings - 0.5) * swing_s, abs=0.03) and count == swings
        assert cycle_s == pytest.approx(swing_s / 2, rel=0.12)


def test_nods_that_a_listener_draws_are_as_long_as_peoples():
    """Shapes of events.yaml on heads of training, beside the people of `evaluate naturalness --split validation`."""
    model, drawn = EventModel.load(), []
    nods = read_motions(data_dir("sim") / "listeners" / "motions.npz")["train"].nods
    for seed in range(200):
        event, motion = model.shaped("nod", 100, seed), still(9)
        curve = nod_curve(replace(event, start_s=2.0), 0.8, nods[seed % len(nods)], len(motion))
        motion[:, CHANNEL_INDEX["pitch"]] = curve
        drawn.append(motion)
    _, length_s, cycle_s, _ = np.median(detection.nods_of(drawn), axis=0)
    assert 0.8 < length_s / 0.50 < 1.25 and 0.8 < cycle_s / 0.20 < 1.25


def test_gaze_is_head_and_eyes_and_its_looks_end_with_shifts():
    motion = still(10)
    motion[5 * FRAME_HZ :, CHANNEL_INDEX["yaw"]] = np.deg2rad(5)
    motion[5 * FRAME_HZ :, CHANNEL_INDEX["eyeLookOutLeft"]] = 0.5
    motion[5 * FRAME_HZ :, CHANNEL_INDEX["eyeLookInRight"]] = 0.5
    gaze = detection.gaze_rad(motion)
    assert np.degrees(gaze[-1]) == pytest.approx([20, 0]) and detection.shifts(gaze) == 1
    assert detection.looks_s(gaze) == pytest.approx([5.0])
    found = detection.movement([motion], [np.ones(len(motion), bool)])
    assert found["gaze_on_person"] == pytest.approx(0.5) and found["gaze_shifts_per_minute"] == pytest.approx(6.0)
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
