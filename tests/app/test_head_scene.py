"""`head show --urdf` and `head list --urdf`."""

import pytest

from sfms_robot.app.head.head_scene import draw_scene, draw_shipped_heads

pytest.importorskip("vtkmodules")


def test_a_platform_is_told_apart_from_what_follows_by_name(tmp_path):
    told = draw_scene("reachy_mini", tmp_path / "a.png")
    assert told["follows"]["stewart_1"] == "stewart_1" and told["undriven"] == []
    assert {"pose_x", "pose_yaw", "stewart_6_rod_lean"} <= set(told["by_kinematics"])
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_a_head_without_a_urdf_is_drawn_from_its_joints(tmp_path):
    (tmp_path / "head.yaml").write_text(
        "name: owl\ndescription: ''\nbuses: {main: {family: dynamixel2, baud: 1000000}}\n"
        "limits: {any: {speed_deg_s: 1, acceleration_deg_s2: 1, jerk_deg_s3: 1}}\n"
        "joints: {jaw: {bus: main, id: 1, model: xl330-m288, zero_ticks: 0, min_deg: -1, max_deg: 1, limits: any}}\n"
    )
    drawn = draw_scene(str(tmp_path), tmp_path / "a.png")
    assert drawn["follows"] == {"jaw": "jaw"} and (tmp_path / "a.png").stat().st_size > 1000


@pytest.mark.slow
def test_all_heads_are_drawn_side_by_side(tmp_path):
    draw_shipped_heads(tmp_path / "all.png")
    data = (tmp_path / "all.png").read_bytes()
    assert int.from_bytes(data[16:20], "big") == 900 and len(data) > 50_000
