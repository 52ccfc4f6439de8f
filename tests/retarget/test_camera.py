"""Where a person is does not depend on where the neck has turned the camera."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import CameraMount
from sfms_robot.retarget.gaze import Camera
from sfms_robot.signals.gaze_kinematics import direction_to

METRES = st.tuples(*[st.floats(-3, 3)] * 3)
POSES = st.tuples(*[st.floats(-1, 1)] * 3, *[st.floats(-0.1, 0.1)] * 3).map(np.array)
MOUNTS = st.builds(
    CameraMount, on=st.sampled_from(["head", "base"]), at_m=METRES, rpy_deg=st.tuples(*[st.floats(-170, 170)] * 3)
)


@given(MOUNTS, METRES, POSES)
def test_there_and_back(mount, place_m, pose):
    camera = Camera(mount)
    assert camera.to_base(camera.from_base(place_m, pose), pose) == pytest.approx(np.array(place_m), abs=1e-9)
    assert camera.from_base(camera.to_base(place_m, pose), pose) == pytest.approx(np.array(place_m), abs=1e-9)


@given(MOUNTS, METRES, POSES, POSES)
def test_a_moving_neck_moves_no_person(mount, place_m, one, other):
    camera = Camera(mount)
    places = [camera.to_base(camera.from_base(place_m, pose), pose) for pose in (one, other)]
    assert places[0] == pytest.approx(places[1], abs=1e-9)
    if mount.on == "base":
        assert camera.from_base(place_m, one) == pytest.approx(camera.from_base(place_m, other))


def test_a_head_that_has_turned_left_sees_who_was_ahead_on_its_right():
    camera = Camera(CameraMount(on="head"))
    turned = np.array([0, 0, np.radians(30), 0, 0, 0])
    seen = camera.from_base((2.0, 0.0, 0.0), turned)
    assert np.degrees(direction_to(seen)) == pytest.approx([-30, 0])
    assert np.degrees(direction_to(camera.to_base((2.0, 0.0, 0.0), turned))) == pytest.approx([30, 0])


def test_a_camera_that_looks_down_from_above_sees_who_is_ahead_above_its_axis():
    camera = Camera(CameraMount(on="base", at_m=(0, 0, 0.3), rpy_deg=(0, 20, 0)))
    assert camera.to_base((1.0, 0.0, 0.0), np.zeros(6)) == pytest.approx([0.9397, 0, 0.3 - 0.342], abs=1e-3)


def test_directions_are_those_of_eyes_and_neck():
    assert np.degrees(direction_to(np.array([1.0, 1.0, 0.0]))) == pytest.approx([45, 0])
    assert np.degrees(direction_to(np.array([1.0, 0.0, -1.0]))) == pytest.approx([0, 45])  # below: nose down
