"""A head's URDF follows the angles that its servos read."""

import json

import numpy as np
import pytest

from sfms_robot.app.catalogue import shipped_heads
from sfms_robot.app.head.head_check import check
from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError
from sfms_robot.face.drawing import render_robots
from sfms_robot.face.robot_scene import MOST_MESH_BYTES, RobotScene
from sfms_robot.retarget.head_retargeter import HeadRetargeter, build_neck

HEADS = [head["name"] for head in shipped_heads()]

OWL = """
name: owl
description: a jaw and a neck
urdf: {urdf}
buses: {{main: {{family: dynamixel2, baud: 1000000}}}}
limits: {{any: {{speed_deg_s: 100, acceleration_deg_s2: 1000, jerk_deg_s3: 10000}}}}
joint_defaults: {{bus: main, model: xl330-m288, zero_ticks: 2048, min_deg: -20, max_deg: 20, limits: any}}
joints: {{jaw: {{id: 1, drive: jawOpen}}, neck: {{id: 2, drive: yaw}}}}
"""
URDF = """<robot name="owl"><link name="base"/><link name="beak"/><link name="head">
  <visual><geometry><mesh filename="package://owl/head.stl"/></geometry></visual></link>
  <joint name="BeakJoint" type="prismatic"><parent link="head"/><child link="beak"/><axis xyz="0 0 1"/></joint>
  <joint name="neck" type="revolute"><parent link="base"/><child link="head"/><axis xyz="0 0 1"/></joint>
  <joint name="stiff" type="fixed"><parent link="base"/><child link="foot"/></joint><link name="foot"/></robot>"""
TRIANGLE = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid"
)


def owl(tmp_path, urdf="{file: owl.urdf, packages: {owl: parts}, joints: {jaw: {joint: BeakJoint, scale: -0.1}}}"):
    (tmp_path / "head.yaml").write_text(OWL.format(urdf=urdf))
    (tmp_path / "owl.urdf").write_text(URDF)
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "head.stl").write_text(TRIANGLE)
    return load_head(str(tmp_path))


@pytest.mark.parametrize("name", HEADS)
def test_every_joint_of_a_shipped_head_moves_something_that_is_drawn(name):
    head = load_head(name)
    scene = scene_of(head)
    assert scene is not None and scene.undriven == () and not scene.meshes
    assert (scene.urdf.parent / "SOURCE.md").is_file()
    before = pictures(scene, scene.rest())
    for column, joint in enumerate(head.joints.values()):
        angles = np.array([each.rest_rad for each in head.joints.values()])
        angles[column] += 0.1 * (joint.max_rad - joint.rest_rad or joint.min_rad - joint.rest_rad)
        after = pictures(scene, scene.values(angles))
        scene.rest()
        assert max(np.abs(a - b).max() for a, b in zip(after, before, strict=True)) > 1e-4, list(head.joints)[column]


def pictures(scene, values):
    places = scene.robot.link_places(dict(zip(scene.joints, values, strict=True)))
    return [places[visual.link] @ visual.place for visual in scene.robot.visuals]


@pytest.mark.parametrize("name", HEADS)
def test_the_drawn_head_turns_as_the_pose_says(name):
    head = load_head(name)
    retargeter, scene = HeadRetargeter(head), scene_of(head)
    for channel, axis, sign in (("yaw", 1, 1), ("pitch", 2, -1)):
        if channel in retargeter.blind_channels:
            continue
        motion = np.zeros(58, np.float32)
        motion[("roll", "pitch", "yaw").index(channel)] = 0.2
        places = [
            scene.robot.link_places(dict(zip(scene.joints, scene.values(angles), strict=True)))["head"]
            for angles in (retargeter.angles(np.zeros(58, np.float32)), retargeter.angles(motion))
        ]
        nose = places[0][:3, :3].T @ [1.0, 0.0, 0.0]  # what points ahead at home, in the head's own axes
        assert sign * (places[1][:3, :3] @ nose)[axis] == pytest.approx(np.sin(0.2), abs=1e-6)


def test_the_rods_of_the_platform_end_on_the_head():
    head = load_head("reachy_mini")
    scene, retargeter = scene_of(head), HeadRetargeter(head)
    motion = np.zeros(58, np.float32)
    motion[:6] = [0.1, -0.15, 0.8, 0.01, -0.005, 0.008]
    values = scene.values(retargeter.angles(motion))
    places = scene.robot.link_places(dict(zip(scene.joints, values, strict=True)))
    for number, leg in enumerate(head.kinematics.legs, start=1):
        tip = places[f"rod_{number}"] @ [head.kinematics.rod_m, 0, 0, 1]
        np.testing.assert_allclose(tip, places["head"] @ [*leg.rod_end_m, 1], atol=2e-5)


def test_what_is_drawn_is_of_what_is_read_whatever_was_before():
    """A platform has several poses for the same legs; after a head that hung the next reading leads to no other."""
    scene = scene_of(load_head("reachy_mini"))
    rest = scene.rest()
    hangs = scene.values(np.array([-0.84, 0.19, -0.86, 0.19, -0.86, 0.07, -0.86, -0.38, -0.04]))  # sunk, each by itself
    assert np.abs(hangs - rest).max() > 1.0 and scene.rest() == pytest.approx(rest, abs=1e-9)


def test_an_angle_that_was_never_read_stays_at_rest():
    scene = scene_of(load_head("op3_head"))
    assert scene.values(np.array([np.nan, 0.2])).tolist() == [0.0, 0.2]
    assert scene.values(np.array([0.1, np.nan])).tolist() == [0.1, 0.2]
    with pytest.raises(ValueError, match=r"angles are \(2,\), not \(3,\)"):
        scene.values(np.zeros(3))


def test_a_urdf_of_ones_own_follows_by_name_and_by_table(tmp_path):
    scene = scene_of(owl(tmp_path))
    values = dict(zip(scene.joints, scene.values(np.array([0.2, 0.3])), strict=True))
    assert values == {"BeakJoint": pytest.approx(-0.02), "neck": 0.3}
    assert scene.meshes == {"package://owl/head.stl": tmp_path / "parts" / "head.stl"}


def test_a_head_may_look_like_a_shipped_one(tmp_path):
    assert scene_of(owl(tmp_path)) is not None
    (tmp_path / "head.yaml").write_text(OWL.format(urdf="reachy_mini").replace("neck:", "body_rotation:"))
    scene = scene_of(load_head(str(tmp_path)))
    assert scene.joints == ("body_rotation",) and scene.undriven == ("jaw",)


@pytest.mark.parametrize("name", HEADS)
def test_a_head_without_a_urdf_is_drawn_from_its_joints(name):
    head = load_head(name)
    unnamed = head.model_copy(update={"name": "unnamed", "urdf": None})
    neck = build_neck(head.kinematics, head.joints) if head.kinematics else None
    scene = RobotScene.of(unnamed, neck)
    assert scene.generic and not scene.undriven
    at_rest = scene.robot.link_places(dict(zip(scene.joints, scene.rest(), strict=True)))
    moved = scene.values(np.array([joint.rest_rad + 0.05 for joint in head.joints.values()]))
    places = scene.robot.link_places(dict(zip(scene.joints, moved, strict=True)))
    for joint in scene.robot.joints.values():
        assert joint.kind == "fixed" or not np.allclose(places[joint.child], at_rest[joint.child]), joint.name


@pytest.mark.parametrize(
    "urdf, told",
    [
        ("owl2.urdf", "urdf.file = 'owl2.urdf' is neither a file nor a shipped head (face24_maestro, "),
        ("{file: owl.urdf, packages: {owl: parts}, joints: {jaw: Beak}}", "joints.jaw.joint = 'Beak' is not a joint"),
        ("{file: owl.urdf, packages: {owl: parts}, joints: {jaw: stiff}}", "'stiff' does not move by itself"),
        ("{file: owl.urdf, joints: {tail: neck}}", "urdf.joints: 'tail' is not a joint of this head (jaw, neck)"),
        ("{file: owl.urdf, joints: {jaw: neck, neck: neck}}", "'neck' already follows jaw"),
        ("{file: owl.urdf, joints: {jaw: {joint: neck, scale: .nan}}}", "scale"),
    ],
)
def test_what_is_wrong_with_it_is_one_line(tmp_path, urdf, told):
    with pytest.raises(ConfigError) as caught:
        scene_of(owl(tmp_path, urdf))
    assert all(part in str(caught.value) for part in told.split(".*")) and "\n" not in str(caught.value)


OUTSIDE = "expected a file in FOLDER (--package names another folder), got"


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        ("../beside/a.stl", OUTSIDE),
        ("BESIDE/a.stl", OUTSIDE),
        ("file://BESIDE/a.stl", OUTSIDE),
        ("/etc/passwd", OUTSIDE),
        ("package://beside/a.stl", OUTSIDE),
        ("package://owl//etc/passwd", OUTSIDE),
        ("link.stl", OUTSIDE),
        ("linked/a.stl", OUTSIDE),
        ("parts/none.stl", "expected a file ("),
        ("package://eagle/head.stl", "is not there; urdf.packages says where packages lie), got"),
        ("", "is not there"),
        ("x" * 5000, "is not there"),
        ("round.stl", "is not there"),
        ("notes.txt", "expected one of .stl, .obj, .ply, .dae, of at most 64 MiB, got"),
        ("notes.stl", "expected one of .stl, .obj, .ply, .dae, of at most 64 MiB, got"),
        ("large.stl", "of at most 64 MiB, got"),
        ("lfs.stl", "expected a mesh, not a pointer of git-LFS (git lfs pull gets the file), got 'lfs.stl': not drawn"),
    ],
)
def test_a_mesh_that_may_not_be_public_is_left_out_and_named(tmp_path, command_line, mesh, expected):
    folder, beside = tmp_path / "owl", tmp_path / "beside"
    folder.mkdir()
    beside.mkdir()
    (beside / "a.stl").write_text(TRIANGLE)
    owl(folder, "{file: owl.urdf, packages: {owl: parts, beside: ../beside}, joints: {jaw: BeakJoint}}")
    (folder / "link.stl").symlink_to(beside / "a.stl")
    (folder / "linked").symlink_to(beside)
    (folder / "round.stl").symlink_to(folder / "round.stl")
    (folder / "notes.txt").write_text("secret")
    (folder / "notes.stl").symlink_to(folder / "notes.txt")
    (folder / "lfs.stl").write_bytes(LFS)
    with (folder / "large.stl").open("wb") as large:
        large.truncate(MOST_MESH_BYTES + 1)
    mesh = mesh.replace("BESIDE", str(beside))
    (folder / "owl.urdf").write_text(
        URDF.replace(
            "<link", f'<link name="x"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link><link', 1
        ).replace("</robot>", '<joint name="x" type="fixed"><parent link="base"/><child link="x"/></joint></robot>')
    )
    scene = scene_of(load_head(str(folder)))
    assert list(scene.meshes) == ["package://owl/head.stl"] and [each.link for each in scene.robot.visuals] == ["head"]
    (line,) = scene.left_out
    assert line.startswith(f"{folder}/owl.urdf: link x: mesh filename: expected ") and "\n" not in line
    assert expected.replace("FOLDER", str(folder)) in line
    checked = check(str(folder))
    assert not checked["problems"] and line in checked["remarks"]
    if len(mesh) < 100:
        ended = command_line("head", "check", folder, "--json")
        assert ended.code == 0 and line in json.loads(ended.out)["remarks"]


def test_meshes_may_come_from_folders_of_the_command_line(tmp_path, command_line):
    parts = tmp_path / "parts"
    owl(tmp_path)
    (tmp_path / "owl").mkdir()
    for name in ("head.yaml", "owl.urdf"):
        (tmp_path / name).rename(tmp_path / "owl" / name)
    head = tmp_path / "owl" / "head.yaml"
    head.write_text(head.read_text().replace("owl: parts", "owl: ../parts"))
    assert scene_of(load_head(str(tmp_path / "owl"))).meshes == {}
    given = scene_of(load_head(str(tmp_path / "owl")), [str(parts)])
    assert given.meshes == {"package://owl/head.stl": parts / "head.stl"} and not given.left_out
    assert "--package names another folder" in command_line("head", "check", tmp_path / "owl").out
    assert "--package" not in command_line("head", "check", tmp_path / "owl", "--package", parts, "--json").out


@pytest.mark.parametrize(
    ("name", "mesh"), [("owl", "owl/head.stl"), ("head", "head/owl/head.stl"), ("head", "head/urdf/owl/head.stl")]
)
def test_a_package_is_found_beside_the_urdf_and_among_the_folders_above(tmp_path, name, mesh):
    """The head is the package itself, or the package lies beside the URDF's folder, or that of the URDF is inside."""
    folder = tmp_path / name
    folder.mkdir()
    owl(folder, "{file: urdf/owl.urdf, joints: {jaw: BeakJoint}}")
    (folder / "urdf").mkdir()
    (folder / "owl.urdf").rename(folder / "urdf" / "owl.urdf")
    inside = tmp_path / mesh
    inside.parent.mkdir(exist_ok=True)
    inside.write_text(TRIANGLE)
    scene = scene_of(load_head(str(folder)))
    assert scene.meshes == {"package://owl/head.stl": inside} and not scene.left_out


def test_a_package_folder_of_the_command_line_is_known_by_its_name(tmp_path):
    owl(tmp_path, "{file: owl.urdf, joints: {jaw: BeakJoint}}")
    (tmp_path / "elsewhere" / "owl").mkdir(parents=True)
    (tmp_path / "parts" / "head.stl").rename(tmp_path / "elsewhere" / "owl" / "head.stl")
    assert scene_of(load_head(str(tmp_path)), [str(tmp_path / "elsewhere" / "owl")]).meshes


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize(
    "content", [b"", LFS, b"solid a\nfacet normal 0 0 1\nouter loop\nvertex x", bytes(80) + b"\2\0\0\0" + bytes(60)]
)
@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".step"])
def test_a_broken_mesh_is_one_line_of_ours_and_none_of_vtk(tmp_path, capfd, suffix, content):
    pytest.importorskip("vtkmodules")
    scene = scene_of(owl(tmp_path))
    scene.meshes["package://owl/head.stl"] = file = tmp_path / f"a{suffix}"
    file.write_bytes(content)
    said = "a picture needs one of .stl, .obj, .ply" if suffix == ".step" else "not a mesh that can be read"
    render_robots(tmp_path / "a.png", [("", scene, scene.rest())], size_px=(64, 48))
    assert scene.left_out == [f"{scene.urdf}: link head: mesh filename: {file}: {said}: not drawn"]
    assert (tmp_path / "a.png").stat().st_size
    assert capfd.readouterr() == ("", "")
