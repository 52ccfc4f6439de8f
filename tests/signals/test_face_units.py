"""Names and units of faces that come from elsewhere."""

import numpy as np
import pytest

from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX
from sfms_robot.signals import face_units


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("brow_inner_up", "browInnerUp"),
        ("jawL", "jawLeft"),
        ("tongueOut", "tongueOut"),
        ("HeadYaw", "yaw"),
        ("pitch [degrees]", "pitch"),
        ("headX_cm", "x"),
        ("AU12_r", None),
        ("eyeBlink", None),
    ],
)
def test_a_channel_goes_by_every_spelling(name, channel):
    assert face_units.channel_of(name) == channel


def test_every_shape_has_its_short_name_and_what_is_left_out_is_counted_and_named():
    for name in BLENDSHAPES:
        short = name.replace("Left", "_L").replace("Right", "_R")
        assert face_units.channel_of(f"ARKit.{short}") == face_units.channel_of(name.upper()) == name
    assert face_units.used_line(["jawOpen", "yaw"], ["b", "a"]) == "1 of 52 channels used; not known: a, b"
    assert face_units.used_line(BLENDSHAPES, []) == "52 of 52 channels used"


TURN = np.sin(np.arange(90) / 30)


def face_of(**channels):
    motion = np.zeros((90, 58), dtype=np.float32)
    for name, values in channels.items():
        motion[:, CHANNEL_INDEX[name]] = values
    return motion


@pytest.mark.parametrize(
    ("motion", "line"),
    [
        (face_of(yaw=1.2 * TURN, jawOpen=1.1), ""),
        (face_of(yaw=5.5 * TURN), "angles are taken as degrees"),
        (face_of(yaw=np.random.default_rng(0).normal(0, 0.3, 90)), "angles are taken as degrees"),  # trembles at 30 Hz
        (face_of(jawOpen=40 * np.abs(TURN)), "blendshapes are taken as percent"),
        (face_of(yaw=np.where(np.arange(90) == 50, 3.1, 0.1)), ""),  # a tracker lost its way once
    ],
)
def test_units_are_decided_by_what_a_head_can_do_in_a_file_and_live(motion, line):
    times_s, live = np.arange(90) / 30, face_units.LiveUnits()
    units = face_units.units_of(motion, times_s)
    assert units.line == line
    taken = [live.take(row, time_s) for row, time_s in zip(motion, times_s, strict=True)]
    assert live.units == units and all(each is None for each in taken[:30])
    for each, row in zip(taken[31:], units.ours(motion)[31:], strict=True):
        assert each is None or np.array_equal(each, row)


def test_a_face_beyond_a_head_is_named():
    row = np.zeros(58)
    assert face_units.beyond(row) is None
    for name, value, line in [
        ("yaw", 20.0, "yaw: expected radians (in degrees?), got 20"),
        ("z", -600.0, "z: expected metres (in cm or mm?), got -600"),
        ("jawOpen", 80.0, "jawOpen: expected 0 to 1 (in percent?), got 80"),
        ("jawOpen", np.nan, "jawOpen is not finite"),
    ]:
        wrong = row.copy()
        wrong[CHANNEL_INDEX[name]] = value
        assert face_units.beyond(wrong) == line
