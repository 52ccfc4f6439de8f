"""Events that are in motion are seen there, in time, and nothing else is; what a detector misses is known by size."""

import numpy as np
import pytest

from sfms_robot.data import data_dir
from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, ListenerEvent
from sfms_robot.lab.evaluation.detection import Detected, DetectorCalibration, Sightings, asked_and_seen, paired, seen
from sfms_robot.signals import gaze_kinematics
from sfms_robot.signals.events import find_nods
from sfms_robot.signals.motion_primitives import read_motions

FRAMES = 60 * FRAME_HZ
WHEN_S = (1 + np.arange(FRAMES)) / FRAME_HZ


def nodding(starts_s, late_s=0.0):
    """Events asked for, and motion (N, 58) that does them, `late_s` late."""
    size_rad = np.radians(6)
    asked = [ListenerEvent("nod", start, 0.6, size_rad) for start in starts_s]
    motion = np.zeros((FRAMES, 58), np.float32)
    for start in starts_s:
        over = (WHEN_S - start - late_s) / 0.6
        motion[:, 1] += np.where((over > 0) & (over < 1), size_rad * np.sin(np.pi * over) ** 2, 0)
    return asked, motion


STARTS = np.arange(3.0, 55.0, 4.0)


def sightings(asked, motion, lag_s=None):
    return asked_and_seen(asked, Detected.of(motion), lag_s)


def test_what_was_asked_for_is_seen():
    asked, motion = nodding(STARTS)
    lag = asked_and_seen(asked, Detected.of(motion))["nod"].offset_s
    found = asked_and_seen(asked, Detected.of(motion), {"nod": lag})["nod"]
    assert (found.recall, found.precision) == (1.0, 1.0) and abs(lag) <= 0.12


def looking_down(starts_s, deg):
    """Motion (N, 58) of somebody who looks down for 0.6 s, eyes first, and nods never."""
    targets = np.zeros((FRAMES, 2))
    for start in starts_s:
        targets[(WHEN_S > start) & (WHEN_S < start + 0.6), 1] = np.radians(deg)
    motion, state = np.zeros((FRAMES, 58), np.float32), gaze_kinematics.start(3)
    motion[:, :3], motion[:, list(gaze_kinematics.EYE_CHANNELS)], _ = gaze_kinematics.follow(targets, motion, state)
    return motion


def test_a_look_down_is_no_nod_hides_none_and_eyes_that_nobody_tracked_change_no_size():
    looks = looking_down(STARTS, 16)
    assert len(find_nods(looks[:, 1], FRAME_HZ)) > len(STARTS) / 2 and not seen(looks, "nod")
    asked, nods = nodding(STARTS + 2)
    both = looks + nods
    assert len(seen(both, "nod")) == len(asked)
    np.testing.assert_allclose([size for *_, size in seen(both, "nod")], np.radians(6), rtol=0.2)
    _, motion = nodding(STARTS)
    assert seen(motion, "nod") == find_nods(motion[:, 1], FRAME_HZ) and len(seen(motion, "nod")) == len(STARTS)


def test_lateness_is_told_and_what_is_late_is_not_in_time():
    on_time = sightings(*nodding(STARTS))["nod"].offset_s
    late = sightings(*nodding(STARTS, late_s=0.24), {"nod": on_time})["nod"]
    assert late.offset_s - on_time == pytest.approx(0.24, abs=0.045) and late.recall == late.precision == 0


def test_what_nobody_asked_for_costs_precision_and_what_is_not_there_recall():
    asked, motion = nodding(STARTS)
    lag = {"nod": asked_and_seen(asked, Detected.of(motion))["nod"].offset_s}
    found = asked_and_seen(asked[::2], Detected.of(motion), lag)["nod"]
    assert found.precision == pytest.approx(len(asked[::2]) / len(asked)) and found.recall == 1
    still = asked_and_seen(asked, Detected.of(np.zeros_like(motion)))["nod"]
    assert still.recall == 0 and np.isnan(still.precision) and np.isnan(still.offset_s)


def test_blinks_and_smiles_are_seen_too():
    motion = np.zeros((FRAMES, 58), np.float32)
    asked = [ListenerEvent("blink", start, 0.2, 1.0) for start in STARTS]
    asked += [ListenerEvent("smile", start, 2.0, 0.5) for start in STARTS[::3] + 1]
    for event in asked:
        over = (WHEN_S - event.start_s) / event.duration_s
        names = ("eyeBlinkLeft", "eyeBlinkRight") if event.kind == "blink" else ("mouthSmileLeft", "mouthSmileRight")
        for name in names:
            motion[:, CHANNEL_INDEX[name]] += np.where((over > 0) & (over < 1), event.size * np.sin(np.pi * over), 0)
    known = DetectorCalibration.on([(asked, motion)])
    for kind in ("blink", "smile"):
        assert (known.known[kind].recall, known.known[kind].precision) == (1.0, 1.0)


def test_each_is_in_one_pair_and_recall_for_other_sizes_goes_by_that_at_each_size():
    assert paired(np.array([1.0, 1.3]), np.array([1.25]), 0.5) == [(1, pytest.approx(-0.05))]
    assert paired(np.array([1.0, 5.0]), np.array([1.1, 1.2, 9.0]), 0.5) == [(0, pytest.approx(0.1))]
    assert paired(np.zeros(0), np.array([1.0]), 0.5) == []
    known = Sightings(np.array([1.0, 1, 1, 1, 5, 5]), np.array([1.0, 0, 0, 0, 1, 1]), 3, np.zeros(3))
    assert known.recall_at(np.full(9, 1.2), (0, 3, 9)) == 0.25
    assert known.recall_at(np.array([1.0, 5.0]), (0, 3, 9)) == pytest.approx(0.625)
    assert np.isnan(known.recall_at(np.zeros(0), (0, 3, 9)))


@pytest.mark.slow
def test_composed_listeners_are_seen_through():
    """The detector finds nods of every size, and next to nothing else."""
    motions = read_motions(data_dir("sim") / "listeners" / "motions.npz")["validation"]
    known = DetectorCalibration.of(motions, listeners=30)
    report = known.report()
    assert report["nod"]["recall"] > 0.9 and report["nod"]["precision"] > 0.95
    assert min(row["recall"] for row in report["nod"]["by_size"] if row["asked"] >= 20) > 0.85
    assert 0.5 < known.nods_per_seen_nod < 2 and report["blink"]["recall"] > 0.8
