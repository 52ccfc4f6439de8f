"""MediaPipe's matrix and names in our axes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, ORDERS
from sfms_robot.sources.webcam import seen_face

angles = st.tuples(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(-3.0, 3.0))


def matrix_of(roll, pitch, yaw, right_up_near_cm=(0.0, 0.0, -60.0)):
    """Face -> camera as MediaPipe gives it: our Rz(yaw) Ry(pitch) Rx(roll) with x = left, y = up, z = forward."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(a), np.cos(a)) for a in (roll, pitch, yaw))
    ours = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    axes = [1, 2, 0]  # theirs, among ours
    matrix = np.eye(4)
    matrix[:3, :3] = ours[np.ix_(axes, axes)]
    matrix[:3, 3] = right_up_near_cm
    return matrix


@given(angles)
def test_the_rotation_is_ours_signs_included(turn):
    pose = seen_face(matrix_of(*turn), {}).motion[:3]
    np.testing.assert_allclose(matrix_of(*pose), matrix_of(*turn), atol=1e-5)


def test_to_the_pictures_right_is_the_persons_left_and_the_cameras_right():
    seen = seen_face(matrix_of(0, 0, 0, (10.0, 5.0, -60.0)), {})
    np.testing.assert_allclose(seen.motion[3:6], (-0.6, 0.1, 0.05), atol=1e-6)
    np.testing.assert_allclose(seen.place_m, (0.6 - 0.0347, -0.1, 0.05 + 0.0262), atol=1e-6)


def test_the_eyes_are_where_the_turned_head_has_them():
    seen = seen_face(matrix_of(0, 0, np.pi / 2), {})  # towards their own left, the picture's right
    np.testing.assert_allclose(seen.place_m, (0.6, -0.0347, 0.0262), atol=1e-6)


def test_blendshapes_go_by_name_and_the_tongue_is_not_seen():
    told = {name: place / 100 for place, name in enumerate(ORDERS["mediapipe"])}
    seen = seen_face(matrix_of(0, 0, 0), told)
    for name in BLENDSHAPES:
        assert seen.motion[CHANNEL_INDEX[name]] == np.float32(told.get(name, 0.0))
    assert seen.motion[CHANNEL_INDEX["tongueOut"]] == 0.0
