"""`head show --urdf` and `head list --urdf`."""

import pytest

from sfms_robot.app.head.head_scene import draw_scene, draw_shipped_heads

pytest.importorskip("vtkmodules")


def test_a_platform_is_told_apart_from_what_follows_by_name(tmp_path):
    told = draw_scene("reachy_mini", tmp_path / "a.png")
    assert told["follows"]["stewart_1"] == "stewart_1" and told["undriven"] == []
    assert {"pose_x", "pose_yaw", "stewart_6_rod_lean"} <= set(told["by_kinematics"])
    assert (tmp_path / "a.png").stat().st_size > 1000


@pytest.mark.slow
def test_all_heads_are_drawn_side_by_side(tmp_path):
    draw_shipped_heads(tmp_path / "all.png")
    data = (tmp_path / "all.png").read_bytes()
    assert int.from_bytes(data[16:20], "big") == 900 and len(data) > 50_000
