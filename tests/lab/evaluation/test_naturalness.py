import numpy as np
import pytest

from sfms_robot.frames import FRAME_HZ, MOTION_DIM
from sfms_robot.lab.evaluation.naturalness import _NOISE, REGIONS, WINDOW, levelled, separability, windows

DYADS = 10


def sway(rng, hz, frames=20 * FRAME_HZ, size=0.05):
    """A head that turns at one pace, from somewhere in its swing."""
    motion = np.zeros((frames, MOTION_DIM), np.float32)
    phase = rng.uniform(0, 2 * np.pi)
    motion[:, 1] = size * np.sin(2 * np.pi * hz * np.arange(frames) / FRAME_HZ + phase)
    return motion


def cut(motions, seed=0):
    rng = np.random.default_rng(seed)
    return [windows(motion, rng) for motion in motions]


@pytest.mark.slow
def test_the_same_motion_cannot_be_told_apart_and_another_pace_can():
    rng = np.random.default_rng(3)
    slow, as_slow = ([sway(rng, 0.6) for _ in range(DYADS)] for _ in range(2))
    fast = [sway(rng, 2.0) for _ in range(DYADS)]
    auc, low, high = separability(cut(slow), cut(as_slow, 1), "head")
    assert low <= 0.5 <= high and 0.3 < auc < 0.7
    auc, low, _ = separability(cut(fast), cut(slow, 1), "head")
    assert auc > 0.95 and low > 0.9


@pytest.mark.slow
def test_rounding_and_what_no_tracker_sees_is_not_judged():
    """Steps of a hundredth of a degree and a buzz of 10 Hz are gone behind the low-pass and the noise."""
    rng = np.random.default_rng(5)
    smooth = [sway(rng, 0.5) for _ in range(DYADS)]
    buzz = 0.002 * np.sin(2 * np.pi * 10 * np.arange(20 * FRAME_HZ) / FRAME_HZ)[:, None]
    rough = [(np.round(sway(rng, 0.5) / 2e-4) * 2e-4 + buzz).astype(np.float32) for _ in range(DYADS)]
    assert separability(cut(rough), cut(smooth, 1), "head")[1] < 0.6


@pytest.mark.slow
def test_a_wider_swing_from_another_rest_is_told_apart_but_not_once_it_is_levelled():
    rng = np.random.default_rng(6)
    small, wide = [sway(rng, 0.8) for _ in range(DYADS)], [2 * sway(rng, 0.8) + 0.1 for _ in range(DYADS)]
    raw, level = (cut(wide), cut(small, 1)), ([*map(levelled, cut(wide))], [*map(levelled, cut(small, 1))])
    assert separability(*raw, "head")[1] > 0.95 and separability(*level, "head")[1] < 0.65
    fast = [*map(levelled, cut([sway(rng, 2.0) for _ in range(DYADS)]))]
    assert separability(fast, level[1], "head")[1] > 0.9, "another pace is another pace"
    assert levelled(np.zeros((0, WINDOW, MOTION_DIM), np.float32)).shape == (0, WINDOW, MOTION_DIM)


def test_windows_lie_side_by_side_short_motion_gives_none_and_those_not_judged_are_left_out():
    rng = np.random.default_rng(0)
    assert windows(np.zeros((2 * WINDOW + 7, MOTION_DIM), np.float32), rng).shape == (2, WINDOW, MOTION_DIM)
    assert windows(np.zeros((WINDOW - 1, MOTION_DIM), np.float32), rng).shape == (0, WINDOW, MOTION_DIM)
    still = windows(np.zeros((60 * FRAME_HZ, MOTION_DIM), np.float32), rng)
    assert still.reshape(-1, MOTION_DIM).std(axis=0) == pytest.approx(_NOISE, rel=0.1)
    motion = sway(np.random.default_rng(0), 0.6, frames=4 * WINDOW + 7)
    judged = np.ones(len(motion), bool)
    judged[[WINDOW, 4 * WINDOW + 3]] = False
    every, some = (windows(motion, np.random.default_rng(1), which) for which in (None, judged))
    np.testing.assert_array_equal(some, every[[0, 2, 3]])


def test_regions_hold_every_channel_once_and_too_few_dyads_are_refused():
    assert sorted(index for channels in REGIONS.values() for index in channels) == list(range(MOTION_DIM))
    part = [np.zeros((3, WINDOW, MOTION_DIM), np.float32)] * 3
    with pytest.raises(ValueError, match="got 3 and 3"):
        separability(part, part, "head")
