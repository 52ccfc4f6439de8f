"""A head that was switched off: necks lie on their stops, a little outside the range of the head's file."""

import pytest

from sfms_robot.app.wiring import BEYOND_RAD, calibration_of, emulated, sagged_rad, sagging_joints
from sfms_robot.config import load_firmware_map, load_head
from sfms_robot.data import head_names

HEADS = head_names()
PITCHES = {
    "face28": {"neck_pitch"},
    "op3_head": {"head_tilt"},
    "open_duck_mini_v2_head": {"neck_pitch", "head_pitch"},
    "reachy_mini": set(),  # a platform on six legs
}


@pytest.mark.parametrize("name", HEADS)
def test_joints_are_found_where_a_head_without_torque_comes_to_rest(name):
    head = load_head(name)
    sagging, conversion = sagging_joints(head), calibration_of(head.joints)
    assert sagging == PITCHES.get(name, sagging)
    servos = {(bus, servo.id): servo for bus, each in emulated(head).items() for servo in each}
    for index, (joint_name, joint) in enumerate(head.joints.items()):
        servo = servos[joint.bus, joint.id]
        highest = 2 * load_firmware_map(joint.model).center_ticks - 1
        assert 0 <= servo.start_ticks <= highest
        angle = (servo.start_ticks - conversion.zero_ticks[index]) / conversion.ticks_per_rad[index]
        tick = 1.0 / abs(conversion.ticks_per_rad[index])
        if joint_name not in sagging:
            assert joint.min_rad - tick <= angle <= joint.max_rad + tick
        elif 0 < servo.start_ticks < highest:
            assert angle == pytest.approx(joint.max_rad + BEYOND_RAD, abs=tick)
        assert angle == pytest.approx(sagged_rad(joint, joint_name in sagging), abs=BEYOND_RAD + tick)
