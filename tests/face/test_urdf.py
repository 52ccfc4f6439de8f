import numpy as np
import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.face.urdf import read_urdf

TWO = """<robot name="two">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="base"><visual><geometry><box size="1 2 3"/></geometry><material name="red"/></visual></link>
  <link name="arm"><visual><origin xyz="0 0 1" rpy="0 0 0"/><geometry><sphere radius="0.5"/></geometry></visual></link>
  <link name="slide"/>
  <joint name="turn" type="revolute">
    <origin xyz="1 0 0"/><parent link="base"/><child link="arm"/><axis xyz="0 0 2"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="push" type="prismatic">
    <parent link="arm"/><child link="slide"/><axis xyz="1 0 0"/><mimic joint="turn" multiplier="0.5" offset="0.1"/>
  </joint>
</robot>"""


def written(tmp_path, text):
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    return file


def test_links_shapes_sizes_and_colours_are_those_of_the_file(tmp_path):
    robot = read_urdf(written(tmp_path, TWO))
    places = robot.link_places({"turn": np.pi / 2})
    np.testing.assert_allclose(places["arm"][:3, 3], [1, 0, 0], atol=1e-12)
    along_y = 0.5 * np.pi / 2 + 0.1  # what mimics the quarter turn slides along the arm's x, which points to +y then
    np.testing.assert_allclose(places["slide"][:3, 3], [1, along_y, 0], atol=1e-12)
    box, ball = robot.visuals
    assert (box.shape, box.size, box.color) == ("box", (1, 2, 3), (1, 0, 0, 1))
    assert (ball.shape, ball.size, ball.place[2, 3]) == ("sphere", (0.5,), 1)


@pytest.mark.parametrize(
    "old, new, told",
    [
        ("</robot>", "", "not XML: no element found"),
        ('<robot name="two">', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:a/>', "file with <xacro:a>"),
        ('<robot name="two">', '<robot xmlns:x="http://wiki.ros.org/xacro"><x:if/>', "a xacro file with <xacro:if>: "),
        ('<robot name="two">', '<robot xmlns:xacro="urn:any"><xacro:a/>', "a URDF of it (xacro robot.urdf > resolved"),
        ('<robot name="two">', "<robot><xacro:a/>", "line 1, column 7; it is a xacro file without xmlns:"),
        ('xyz="1 0 0"', 'xyz="1 0 ${height}"', "a xacro file with 1 0 ${height}: "),
        ('<robot name="two">', '<machine xmlns="urn:any"/>', "not XML: "),
        ('<link name="slide"/>', "", "joint 'push' has as its child 'slide', which is not a link of this file"),
        ('type="revolute"', 'type="ball"', "joint 'turn' has the type 'ball'; one of revolute, continuous"),
        ('xyz="0 0 2"', 'xyz="0 0 up"', "joint turn: xyz = '0 0 up' is not 3 finite numbers"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "joint 'turn' has an axis of length 0"),
        ('lower="-1"', 'lower="nan"', "joint turn: lower = 'nan' is not a finite number"),
        ('joint="turn" m', 'joint="jaw" m', "joint 'push' mimics 'jaw', which is not a joint of this file"),
        ('joint="turn" m', 'joint="push" m', "joint 'push' mimics itself"),
        ('<parent link="arm"/>', '<parent link="slide"/>', "joint 'push' does not hang on the robot's first link"),
        ('<child link="slide"/>', '<child link="arm"/>', "joint 'push' has the child 'arm', which is that of turn too"),
        ('<link name="slide"/>', '<link name="slide"/><link name="loose"/>', "link 'loose' has no parent joint"),
    ],
)
def test_a_broken_file_is_one_line_that_names_what_is_wrong(tmp_path, old, new, told):
    file = written(tmp_path, TWO.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        read_urdf(file)
    assert str(caught.value).startswith(f"{file}: ") and told in str(caught.value) and "\n" not in str(caught.value)


ODD = [
    ('<sphere radius="0.5"/>', '<capsule radius="1" length="2"/>', "link 'arm' has the shape <capsule>, not box, "),
    ('<sphere radius="0.5"/>', "<sphere/>", "link arm: radius = '' is not a finite number: not drawn"),
    ('<sphere radius="0.5"/>', "", "link 'arm' has a visual without a geometry: not drawn"),
    ('<geometry><sphere radius="0.5"/></geometry>', "", "link 'arm' has a visual without a geometry: not drawn"),
    ('xyz="0 0 1" rpy', 'xyz="0 1" rpy', "link arm: xyz = '0 1' is not 3 finite numbers: not drawn"),
    ('"1 0 0 1"', '"red"', "material red: rgba = 'red' is not 4 finite numbers: drawn grey"),
    ('<origin xyz="1', '<origin rpy="0 0 90" xyz="1', "joint turn: rpy: expected radians, got '0 0 90' (degrees?)"),
]


@pytest.mark.parametrize("old, new, told", ODD)
def test_one_odd_part_of_the_picture_is_left_out_and_named(tmp_path, old, new, told):
    robot = read_urdf(written(tmp_path, TWO.replace(old, new)))
    (line,) = robot.left_out
    assert line.startswith(f"{tmp_path}/robot.urdf: {told}") and "\n" not in line
    assert len(robot.visuals) == 1 + line.endswith(("grey", "as radians")) and len(robot.joints) == 2
    cleaned = read_urdf(tmp_path / "robot.urdf", robot.text)  # what the page draws
    assert cleaned.left_out == (line,) * line.endswith("as radians") and len(cleaned.visuals) == len(robot.visuals)


def test_angles_beyond_a_turn_are_named_once_for_a_file(tmp_path):
    text = TWO.replace('<origin xyz="1 0 0"/>', '<origin rpy="0 0 90"/>').replace('rpy="0 0 0"', 'rpy="180 0 0"')
    assert ["in 2 elements (degrees?)" in line for line in read_urdf(written(tmp_path, text)).left_out] == [True]
    assert not read_urdf(written(tmp_path, TWO.replace('rpy="0 0 0"', f'rpy="0 0 {np.pi}"'))).left_out


FLOATING = '<joint name="a" type="floating"><parent link="sky"/><child link="base"/></joint>'


@pytest.mark.parametrize(
    "old, new",
    [
        ('<robot name="two">', '<robot name="two" xmlns="http://www.ros.org">'),
        ('<robot name="two">', '<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro">'),  # nothing of it left
        ('"1 0 0 1"', '"1 0 0"'),
        ('<link name="base">', f'<link name="sky"/>{FLOATING}<link name="base">'),
    ],
)
def test_what_other_programs_read_is_read(tmp_path, old, new):
    robot = read_urdf(written(tmp_path, TWO.replace(old, new)))
    box, ball = robot.visuals
    assert not robot.left_out and box.color == (1, 0, 0, 1) and ball.shape == "sphere" and "turn" in robot.joints
    again = read_urdf(tmp_path / "robot.urdf", robot.text)
    np.testing.assert_array_equal(again.link_places({"turn": 1.0})["slide"], robot.link_places({"turn": 1.0})["slide"])
