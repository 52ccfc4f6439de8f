"""Looks aside last and go as far as those of people who listened, and either way alike."""

import numpy as np
import pytest

from sfms_robot.data import data_dir
from sfms_robot.frames import ListenerEvent
from sfms_robot.lab.corpora.compose import render_events
from sfms_robot.signals import event_sizes as sizes
from sfms_robot.signals.motion_primitives import read_motions


def test_looks_aside_are_peoples_as_often_to_either_side_and_as_far_as_asked():
    shares = np.random.default_rng(0).random(4000)
    assert np.mean([sizes.aside_s(share) for share in shares]) == pytest.approx(sizes.ASIDE_MEAN_S, rel=0.05)
    assert np.degrees(np.median([*map(sizes.aside_rad, shares)])) == pytest.approx(sizes.ASIDE_DEG[1][2], rel=0.05)
    rng = np.random.default_rng(1)
    found = np.array([sizes.aside(0.2, *rng.random(2)) for _ in range(4000)])
    np.testing.assert_allclose(np.hypot(*found.T), 0.2)
    assert abs((found[:, 0] > 0).mean() - 0.5) < 0.03
    assert 0.7 < (found[:, 1] < 0).mean() < 0.8  # up


@pytest.mark.parametrize("length_s", [0.0, 0.3, 1.0, 5.0])
def test_a_swing_is_never_faster_nor_slower_than_a_neck_goes(length_s):
    count, lasts_s = sizes.swings(length_s, 2.4)
    assert 1 <= count <= 4 and sizes.SWING_S[0] <= lasts_s / count <= sizes.SWING_S[1]


def test_a_swing_reaches_as_far_as_recorded_ones_do_in_that_time():
    nods = read_motions(data_dir("sim") / "listeners" / "motions.npz")["train"].nods
    for swing_s in sizes.SWING_REACH[0]:
        nod = ListenerEvent("nod", 0.4, swing_s, np.deg2rad(sizes.NOD_DEG[2]))
        reached = np.median([np.ptp(render_events.nod_curve(nod, 1.0, shape, 50)) for shape in nods])
        assert np.degrees(sizes.swing_reach_rad(swing_s)) == pytest.approx(np.degrees(reached), rel=0.1)
