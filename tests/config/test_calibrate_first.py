"""Calibrate first: less of everything, and nothing else changed."""

import pytest

from sfms_robot.app.open_head import ready
from sfms_robot.config import load_head
from sfms_robot.config.head import PACE, TRAVEL, held_back
from sfms_robot.data import head_names
from sfms_robot.retarget.head_retargeter import HeadRetargeter

HEADS = head_names()


@pytest.mark.parametrize("name", HEADS)
def test_every_joint_keeps_its_rest_and_a_fifth_of_its_travel_at_less_than_a_third_of_its_pace(name):
    head = load_head(name)
    held = held_back(head, head.joints)
    for joint, before in head.joints.items():
        after, limit, was = held.joints[joint], held.limit(joint), head.limit(joint)
        assert after.rest_deg == before.rest_deg
        assert after.max_deg - after.min_deg == pytest.approx(TRAVEL * (before.max_deg - before.min_deg))
        assert after.min_deg <= after.rest_deg <= after.max_deg
        assert limit.speed_deg_s == pytest.approx(PACE * was.speed_deg_s)
        assert limit.jerk_deg_s3 == pytest.approx(PACE * was.jerk_deg_s3)
    HeadRetargeter(held)  # also a neck still has its home in reach


def test_joints_that_are_calibrated_go_on_as_they_were():
    head = load_head("face28")
    held = held_back(head, ["jaw"])
    assert held.joints["jaw"] != head.joints["jaw"]
    assert {n: j for n, j in held.joints.items() if n != "jaw"} == {n: j for n, j in head.joints.items() if n != "jaw"}
    assert held.limit("lip_upper_left") == head.limit("lip_upper_left")


def test_only_an_uncalibrated_head_on_real_servos_holds_back(caplog):
    face, turret = load_head("face28"), load_head("op3_head")
    assert ready(face, real=False) is face and ready(face, real=True, calibrated=face.joints) is face
    assert ready(turret, real=True) is turret
    assert not caplog.records
    assert ready(face, real=True) == held_back(face, face.joints)
    assert "face28 is not calibrated: 20 %" in caplog.text


def test_a_joint_whose_measurement_does_not_hold_holds_back_on_any_head(caplog):
    turret, face = load_head("op3_head"), load_head("face28")
    joint = next(iter(turret.joints))
    assert ready(turret, real=True, refused=[joint]) == held_back(turret, [joint])
    assert f"not calibrated in {joint}" in caplog.text
    others = [name for name in face.joints if name != "jaw"]
    assert ready(face, real=True, calibrated=others, refused=["jaw"]) == held_back(face, ["jaw"])
