"""Head folders from the files of other software: values in our terms, and a remark for what has no place."""

import json

import pytest
import yaml

from sfms_robot.app.head.head_check import check
from sfms_robot.app.head.head_import import import_head
from sfms_robot.config.head import load_head
from sfms_robot.errors import ConfigError

LEROBOT = {
    "base_yaw": {"id": 1, "drive_mode": 0, "homing_offset": -612, "range_min": 1100, "range_max": 3050},
    "base_pitch": {"id": 2, "drive_mode": 0, "homing_offset": 1390, "range_min": 960, "range_max": 3040},
    "jaw": {"id": 3, "drive_mode": 1, "homing_offset": 212, "range_min": 1980, "range_max": 2410},
}
STRAIGHT = {"orientation": "direct", "offset": 0.0}
PYPOT = {
    "controllers": {
        "upper": {"sync_read": True, "attached_motors": ["head", "r_elbow_y", "lamp"], "port": "/dev/ttyACM0"},
        "legs": {"attached_motors": ["knee"], "port": "auto"},
    },
    "motorgroups": {"head": ["head_z", "head_y"]},
    "motors": {
        "head_z": {"id": 36, "type": "AX-12", "orientation": "direct", "offset": 0.0, "angle_limit": [-90, 90]},
        "head_y": {"id": 37, "type": "AX-12", "orientation": "indirect", "offset": 20.0, "angle_limit": [-45, 6]},
        "r_elbow_y": {"id": 54, "type": "MX-28", "orientation": "direct", "offset": 0.0, "angle_limit": [-1, 148]},
        "lamp": {"id": 55, "type": "SR-99", "orientation": "direct", "offset": 0.0, "angle_limit": [-1, 1]},
        "knee": {"id": 7, "type": "MX-64", "broken": True, "angle_limit": [-1, 1]} | STRAIGHT,
    },
}
MOTOR = {"return_delay_time": 0, "shutdown_error": 52, "pid": [400, 0, 0]}
REACHY = {
    "version": "beta",
    "serial": {"baudrate": 1_000_000},
    "motors": [
        {"body_rotation": {"id": 10, "offset": 0, "lower_limit": 0, "upper_limit": 4095, **MOTOR}},
        {"stewart_1": {"id": 11, "offset": 1024, "lower_limit": 1502, "upper_limit": 2800, **MOTOR}},
    ],
}


def imported(tmp_path, name, content, **options):
    file = tmp_path / name
    file.write_text(json.dumps(content) if name.endswith("json") else yaml.safe_dump(content))
    done = import_head(file, tmp_path / "made", **options)
    assert check(done["folder"])["problems"] == []
    return load_head(done["folder"]), done["remarks"]


def test_lerobot_ticks_become_degrees_around_its_half_turn(tmp_path):
    head, remarks = imported(tmp_path, "lamp.json", LEROBOT)
    yaw, jaw = head.joints["base_yaw"], head.joints["jaw"]
    assert (head.buses["main"].family, yaw.model, yaw.zero_ticks) == ("feetech", "sts3215", 2047)
    assert (yaw.min_deg, yaw.max_deg) == pytest.approx((-947 * 360 / 4096, 1003 * 360 / 4096), abs=0.01)
    assert head.safety_of("base_yaw").stored == {"homing_offset": -612}
    assert jaw.sign == -1 and jaw.drive.gain == -1  # LeRobot negates it; it opens to its longer side
    assert head.calibrate_first and any("sts3215 is assumed" in remark for remark in remarks)


def test_lerobot_on_dynamixel_keeps_the_direction_in_the_servo(tmp_path):
    head, remarks = imported(tmp_path, "lamp.json", LEROBOT, model="xl330-m288")
    assert head.buses["main"].family == "dynamixel2" and head.joints["jaw"].sign == 1
    assert head.safety_of("jaw").stored == {"homing_offset": 212, "drive_mode": 1}
    assert not any("assumed (another" in remark for remark in remarks)


def test_pypot_limits_are_the_servos_and_its_offset_moves_zero(tmp_path):
    head, remarks = imported(tmp_path, "poppy.json", PYPOT)
    tilt = head.joints["head_y"]
    assert (head.buses.keys(), head.buses["upper"].family) == ({"upper"}, "dynamixel1")
    assert (tilt.model, tilt.sign, tilt.zero_ticks) == ("ax-12a", -1, round(512 - 20 * 1024 / 300))
    assert (tilt.min_deg, tilt.max_deg) == pytest.approx((-26, 25), abs=0.3)
    assert (tilt.drive.channel, head.joints["r_elbow_y"].drive) == ("pitch", None)
    assert {"lamp: left out, servo SR-99 has no map here", "knee: left out, it is marked as broken"} <= set(remarks)


def test_reachy_mini_keeps_its_joints_with_the_narrower_range(tmp_path):
    head, remarks = imported(tmp_path, "hardware_config.yaml", REACHY)
    leg, body = head.joints["stewart_1"], head.joints["body_rotation"]
    assert (leg.max_deg, body.max_deg) == ((2800 - 2048) * 360 / 4096, 160)
    assert head.safety_of("stewart_1").registers == {"position_p_gain": 400}
    assert head.kinematics is None and any(remark.startswith("kinematics: left out") for remark in remarks)


@pytest.mark.parametrize(
    "content, line",
    [
        ({"a": 1}, "expected a calibration of LeRobot (JSON), a robot of pypot (JSON) or Reachy Mini's"),
        ([], "expected a calibration of LeRobot"),
        ({"a": {**LEROBOT["jaw"], "id": "one"}, "b": LEROBOT["jaw"]}, "a.id = 'one'"),
        ({"a": {**LEROBOT["jaw"], "id": 400}}, "joints.a.id = 400"),
        ({"a": {**LEROBOT["jaw"], "range_max": 1}}, "limits reversed"),
        ({**PYPOT, "motorgroups": {"head": ["head"]}}, "attached_motors = 'head' is neither a motor nor a group"),
        ({**PYPOT, "motors": {"head_z": {"id": 1}}}, "motors.head_z.type"),
    ],
)
def test_what_makes_no_head_is_one_line_and_writes_nothing(tmp_path, content, line):
    (tmp_path / "file.json").write_text(json.dumps(content))
    with pytest.raises(ConfigError) as refused:
        import_head(tmp_path / "file.json", tmp_path / "made")
    assert line in str(refused.value) and "\n" not in str(refused.value) and not (tmp_path / "made").exists()


def test_a_folder_that_exists_is_kept_and_one_that_cannot_be_made_names_the_option(tmp_path):
    (tmp_path / "file.json").write_text(json.dumps(LEROBOT))
    with pytest.raises(ConfigError, match="exists already"):
        import_head(tmp_path / "file.json", tmp_path)
    with pytest.raises(ConfigError, match="--to .*made: cannot be written to"):
        import_head(tmp_path / "file.json", tmp_path / "file.json" / "made")
