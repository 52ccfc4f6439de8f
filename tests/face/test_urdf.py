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


def test_links_are_where_joints_put_them(tmp_path):
    robot = read_urdf(written(tmp_path, TWO))
    places = robot.link_places({"turn": np.pi / 2})
    np.testing.assert_allclose(places["arm"][:3, 3], [1, 0, 0], atol=1e-12)
    along_y = 0.5 * np.pi / 2 + 0.1  # what mimics the quarter turn slides along the arm's x, which points to +y then
    np.testing.assert_allclose(places["slide"][:3, 3], [1, along_y, 0], atol=1e-12)


def test_shapes_sizes_and_colours(tmp_path):
    robot = read_urdf(written(tmp_path, TWO))
    box, ball = robot.visuals
    assert (box.shape, box.size, box.color) == ("box", (1, 2, 3), (1, 0, 0, 1))
    assert (ball.shape, ball.size, ball.place[2, 3]) == ("sphere", (0.5,), 1)


@pytest.mark.parametrize(
    "old, new, told",
    [
        ("</robot>", "", "not XML: no element found"),
        ('<robot name="two">', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:a/>', "a xacro file"),
        ('<link name="slide"/>', "", "joint 'push' has as its child 'slide', which is not a link of this file"),
        ('type="revolute"', 'type="floating"', "joint 'turn' has the type 'floating'; one of revolute, continuous"),
        ('xyz="0 0 2"', 'xyz="0 0 up"', "joint turn: xyz = '0 0 up' is not 3 finite numbers"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "joint 'turn' has an axis of length 0"),
        ('lower="-1"', 'lower="nan"', "joint turn: lower = 'nan' is not a finite number"),
        ('joint="turn" m', 'joint="jaw" m', "joint 'push' mimics 'jaw', which is not a joint of this file"),
        ('joint="turn" m', 'joint="push" m', "joint 'push' mimics itself"),
        ('<parent link="arm"/>', '<parent link="slide"/>', "joint 'push' does not hang on the robot's first link"),
        ('<child link="slide"/>', '<child link="arm"/>', "joint 'push' has the child 'arm', which is that of turn too"),
        ('<sphere radius="0.5"/>', "<capsule/>", "link 'arm' has the shape <capsule>"),
        ('<sphere radius="0.5"/>', "<sphere/>", "link arm: radius = '' is not a finite number"),
        ('<link name="slide"/>', '<link name="slide"/><link name="loose"/>', "link 'loose' hangs on nothing"),
    ],
)
def test_a_broken_file_is_one_line_that_names_what_is_wrong(tmp_path, old, new, told):
    file = written(tmp_path, TWO.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        read_urdf(file)
    assert str(caught.value).startswith(f"{file}: ") and told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_told(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_urdf(tmp_path / "none.urdf")
