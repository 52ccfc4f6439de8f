"""`--without JOINT`: its servo is never addressed, the others go on."""

import pytest

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.errors import ConfigError


def test_a_joint_left_out_is_named_and_the_others_move():
    report = run(RunOptions(duration_s=2.0, fast=True, seed=3, without=("jaw", "neck_roll")))
    assert report["exit"] == "done" and report["limits"]["violations"] == 0
    assert report["bus"]["buses"]["main"]["silent"] == []
    assert report["joints"]["neck_pitch"]["travel_rad"] > 0


def test_a_bus_of_joints_that_are_all_left_out_is_not_opened():
    without = ("antenna_left", "antenna_right")
    options = RunOptions(head="open_duck_mini_v2_head", duration_s=1.0, fast=True, without=without)
    report = run(options)
    assert report["exit"] == "done" and set(report["bus"]["buses"]) == {"neck", "left out"}


def test_a_joint_that_is_none_is_refused_by_name():
    with pytest.raises(ConfigError, match="--without: expected a joint of head 'face28', got 'tail'"):
        run(RunOptions(duration_s=1.0, fast=True, without=("tail",)))
