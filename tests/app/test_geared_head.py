"""A head whose yaw is geared so far down that its servo makes more than one turn, from its file to the wire."""

import re

import numpy as np
import pytest

from sfms_robot.app.head.head_check import check as check_head
from sfms_robot.app.open_head import build_bus, check_safety
from sfms_robot.app.servo.doctor import examine
from sfms_robot.app.wiring import calibration_of, emulated
from sfms_robot.config import load_firmware_map, load_head
from sfms_robot.data import data_dir
from sfms_robot.emulator.launch import launch
from sfms_robot.errors import ConfigError
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.servo.stored_settings import JointNeeds, unique_ticks

GEAR = "ratio: 3.0\n    min_deg: -80\n    max_deg: 80"  # 2048 +- 2731 ticks


def geared(tmp_path, gear=GEAR, model="xm430-w350"):
    text = (data_dir("configs") / "heads" / "interbotix_wxxms" / "head.yaml").read_text(encoding="utf-8")
    text = text.replace("min_deg: -179.9\n    max_deg: 179.9", gear, 1).replace("xm430-w350", model)
    text = re.sub(r"    safety: .*\n", "", text).replace(
        "zero_ticks: 2048", f"zero_ticks: {load_firmware_map(model).center_ticks}"
    )
    folder = tmp_path / "geared"
    folder.mkdir()
    (folder / "head.yaml").write_text(text, encoding="utf-8")
    return load_head(str(folder))


def checked(head):
    check_safety(head, head.joints)


def test_its_whole_range_is_reached_on_the_wire(tmp_path):
    head = geared(tmp_path)
    checked(head)
    clock = VirtualClock()
    (servos,) = emulated(head).values()
    with launch(servos, virtual=True) as chain:
        bus = build_bus(head, {next(iter(head.buses)): chain}, clock)
        try:
            bus.connect()
            goals = bus.enable(bus.joints)
            for end_rad in (head.joints["pan"].max_rad, head.joints["pan"].min_rad):
                while abs(end_rad - goals[0]) > 1e-9:
                    goals[0] += np.clip(end_rad - goals[0], -0.01, 0.01)
                    clock.wait_until(clock.now_s() + 0.02)
                    bus.write(goals, clock.now_s())
                    readings = bus.poll(clock.now_s())
                for _ in range(50):
                    clock.wait_until(clock.now_s() + 0.02)
                    bus.write(goals, clock.now_s())
                    readings = bus.poll(clock.now_s())
                assert readings["pan"].position_rad == pytest.approx(end_rad, abs=0.005)
            assert chain.state(1)["position"] < 0
        finally:
            bus.stop("release")
            bus.close()


def test_a_range_of_more_than_one_turn_without_a_gear_is_still_a_mistake(tmp_path):
    with pytest.raises(ConfigError, match="outside the servo's 0..4095"):
        calibration_of(geared(tmp_path, "min_deg: -200\n    max_deg: 200").joints)


def test_a_servo_that_makes_one_turn_only_is_refused(tmp_path):
    head = geared(tmp_path, GEAR.replace("80", "170"), "xl-320")
    with pytest.raises(ConfigError, match="joints.pan.ratio.*xl-320, which makes one turn"):
        checked(head)


def test_a_head_that_could_never_be_driven_is_told_by_head_check(tmp_path):
    head = geared(tmp_path, "ratio: 8.0\n    min_deg: -80\n    max_deg: 80")
    (problem,) = check_head(str(tmp_path / "geared"))["problems"]
    with pytest.raises(ConfigError, match="joints.pan.zero_ticks.*less than two turns") as refused:
        checked(head)
    assert problem == str(refused.value)


@pytest.mark.parametrize("end_deg", [80, 110, 118])
def test_its_emulated_servo_hangs_where_its_turn_is_certain(tmp_path, end_deg):
    head = geared(tmp_path, GEAR.replace("80", str(end_deg)))
    checked(head)
    conversion = calibration_of(head.joints)
    needs = JointNeeds(int(conversion.low_ticks[0]), int(conversion.high_ticks[0]))
    pan = next(servo for servo in emulated(head)["main"] if servo.id == head.joints["pan"].id)
    low, high = unique_ticks(4096, needs)
    assert low <= pan.start_ticks <= high


def test_the_doctor_wants_its_mode(tmp_path):
    geared(tmp_path)
    report = examine("sim", str(tmp_path / "geared"), None, None)
    assert any("operating_mode is 3, wanted 4" in each["problem"] for each in report["findings"])
