"""Every head that is shipped listens on emulated servos, in virtual time."""

import pytest

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.config import load_head
from sfms_robot.data import head_names

HEADS = head_names()


@pytest.mark.parametrize("name", HEADS)
def test_it_listens_for_three_seconds_without_a_violation(name):
    head = load_head(name)
    report = run(RunOptions(head=name, duration_s=3.0, fast=True))
    assert (report["exit"], report["head"], report["frames"]) == ("done", name, 75)
    assert report["limits"]["violations"] == 0
    assert (report["bus"]["errors"], report["bus"]["silent"], report["bus"]["faults"]) == (0, [], [])
    assert set(report["wire"]) == set(head.buses) and all(wire["bytes"] for wire in report["wire"].values())
    if head.kinematics is not None:
        neck = [report["joints"][joint]["travel_rad"] for joint in head.kinematics.joints()]
        assert sum(neck) > 0.05
