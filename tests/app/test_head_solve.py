"""A file of poses in, a table of joints out."""

import csv

import numpy as np
import pytest

from sfms_robot.app.head.head_solve import solve_poses
from sfms_robot.errors import ConfigError

HEADER = "x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad"


@pytest.fixture
def poses(tmp_path):
    """A pose file with this text in it."""

    def write(text: str):
        file = tmp_path / "poses.csv"
        file.write_text(text)
        return file

    return write


def test_columns_stand_in_any_order_and_a_body_yaw_is_that_of_its_column_or_of_the_heads_rule(poses):
    one = solve_poses("reachy_mini", poses(f"{HEADER}\n0.005,0,0,0,0.1,0.2\n"))
    other = solve_poses("reachy_mini", poses("name,yaw_rad,pitch_rad,roll_rad,z_m,y_m,x_m\nnod,0.2,0.1,0,0,0,0.005\n"))
    assert one["poses"] == other["poses"] and all(pose["reached"] for pose in one["poses"])
    assert one["joints"] == ["body_rotation", *(f"stewart_{leg}" for leg in range(1, 7))]
    given = solve_poses("reachy_mini", poses(f"{HEADER},body_yaw_rad\n0,0,0,0,0,0.5,0.5\n"))
    ruled = solve_poses("reachy_mini", poses(f"{HEADER}\n0,0,0,0,0,0.5\n0,0,0,0,0,1.0\n"))
    assert given["poses"][0]["angles_rad"][0] == 0.5
    assert [pose["angles_rad"][0] for pose in ruled["poses"]] == pytest.approx([0.0, 1.0 - np.radians(40)])


def test_the_neck_of_the_face_takes_the_pose_as_it_is_but_no_shift(poses):
    table = solve_poses("face28", poses(f"{HEADER}\n0,0,0,0.1,0.2,0.3\n0.01,0,0,0.1,0.2,0.3\n"))
    assert table["joints"] == ["neck_yaw", "neck_pitch", "neck_roll"]
    assert [pose["angles_rad"] for pose in table["poses"]] == [pytest.approx([0.3, 0.2, 0.1])] * 2
    assert [pose["reached"] for pose in table["poses"]] == [True, False]


def test_the_command_prints_a_column_per_joint_in_rad_and_whether_it_got_there_and_so_does_json(poses, command_line):
    file = poses(f"{HEADER}\n0,0,0,0,0.2618,0\n0,0,0.1,0,0,0\n")
    ended = command_line("head", "solve", "reachy_mini", "--poses", file, "--residual")
    rows = list(csv.DictReader(ended.out.splitlines()))
    assert ended.code == 0 and [row["reached"] for row in rows] == ["1", "0"]
    legs = [f"stewart_{i}" for i in range(1, 7)]
    assert list(rows[0]) == ["body_rotation", *legs, "reached", "residual_rad", "residual_m"]
    assert float(rows[0]["stewart_1"]) == pytest.approx(0.512924522559, abs=1e-6)
    assert float(rows[1]["residual_m"]) == pytest.approx(0.077, abs=1e-3)
    ended = command_line("head", "solve", "reachy_mini", "--poses", file, "--json")
    assert ended.code == 0 and ended.told == solve_poses("reachy_mini", file) and ended.told["head"] == "reachy_mini"
    near, far = ended.told["poses"]
    assert near["reached"] is True and far["reached"] is False
    assert near["residual_m"] < 1e-6 and far["residual_m"] == pytest.approx(0.077, abs=1e-3)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "poses.csv: holds no rows: the file is empty"),
        ("x_m,y_m,z_m,roll_rad,pitch_rad\n0,0,0,0,0\n", r"poses.csv: no column yaw_rad \(has x_m, y_m"),
        (f"{HEADER}\n", "poses.csv: holds no rows: only a header"),
        (f"{HEADER}\n0,0,0,0,0,0\n0,0,0,0,0,left\n", "poses.csv: row 3, column yaw_rad = 'left' is not a number"),
        (f"{HEADER}\n0,0,0,0,0\n", "poses.csv: row 2: expected 6 cells"),
        (f"{HEADER}\n0,0,0,0,0,0,7\n", "poses.csv: row 2: expected 6 cells"),
        (f"x_m,{HEADER}\n0,0,0,0,0,0,0\n", "poses.csv: column x_m is there twice"),
        (f"{HEADER}\n1e300,0,0,0,0,0\n", "poses.csv: a number is out of all bounds"),
        (f"{HEADER}\n0,0,0,nan,0,0\n", "poses.csv: row 2, column roll_rad = 'nan' is not a number"),
    ],
)
def test_a_file_that_holds_no_poses_is_told_with_line_and_column(poses, text, told):
    with pytest.raises(ConfigError, match=told):
        solve_poses("reachy_mini", poses(text))


def test_a_missing_file_and_a_head_whose_body_cannot_turn_are_told(poses, tmp_path):
    with pytest.raises(ConfigError, match="absent.csv: no such file"):
        solve_poses("reachy_mini", tmp_path / "absent.csv")
    with pytest.raises(ConfigError, match="body_yaw_rad: head 'face28' has no joint that turns its body"):
        solve_poses("face28", poses(f"{HEADER},body_yaw_rad\n0,0,0,0,0,0,0.1\n"))


def test_a_head_without_kinematics_and_a_neck_of_joints_it_lacks_are_told(poses, tmp_path):
    head = """
name: stalk
description: one joint
buses: {main: {family: dynamixel2, baud: 1000000}}
limits: {slow: {speed_deg_s: 60, acceleration_deg_s2: 600, jerk_deg_s3: 6000}}
joints:
  pan: {bus: main, id: 1, model: xl330-m288, zero_ticks: 2048, min_deg: 10, rest_deg: 10, max_deg: 60, limits: slow}
"""
    (tmp_path / "head.yaml").write_text(head)
    file = poses(f"{HEADER}\n0,0,0,0,0,0\n")
    with pytest.raises(ConfigError, match=r"name = 'stalk' has no kinematics \(face28, .*reachy_mini"):
        solve_poses(str(tmp_path), file)
    neck = "kinematics: {kind: serial, order: [yaw], axes: {yaw: JOINT}}\n"
    (tmp_path / "head.yaml").write_text(head + neck.replace("JOINT", "turn"))
    with pytest.raises(ConfigError, match=r"head.yaml: kinematics: 'turn' is not a joint of this head \(pan\)"):
        solve_poses(str(tmp_path), file)
    (tmp_path / "head.yaml").write_text(head + neck.replace("JOINT", "pan"))
    with pytest.raises(ConfigError, match="joints.pan: its range leaves out 0"):
        solve_poses(str(tmp_path), file)
