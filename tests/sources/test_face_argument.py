import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS
from sfms_robot.sources.live_face import FaceArgument, parse_endpoint, parse_face_argument
from sfms_robot.sources.registry import split_kind


@pytest.mark.parametrize(
    ("face", "kind", "argument"),
    [
        ("live-link", "live-link", ""),
        ("live-link:11111", "live-link", "11111"),
        ("live-link,flip=yaw", "live-link", ",flip=yaw"),
        ("vmc:0.0.0.0:39539,flip=yaw", "vmc", "0.0.0.0:39539,flip=yaw"),
        ("webcam:C:\\a,b.mp4", "webcam", "C:\\a,b.mp4"),
    ],
)
def test_kind_and_argument(face, kind, argument):
    assert split_kind(face) == (kind, argument)


@pytest.mark.parametrize(
    ("argument", "place", "flip"),
    [
        ("", "", ()),
        ("11111", "11111", ()),
        (",flip=yaw", "", ("yaw",)),
        ("11111,flip=yaw+roll", "11111", ("yaw", "roll")),
        ("a,b.mp4,flip=x", "a,b.mp4", ("x",)),
        ("0,flip=yaw,flip=roll", "0", ("yaw", "roll")),
    ],
)
def test_place_and_flips(argument, place, flip):
    assert parse_face_argument("webcam", argument) == FaceArgument(place, flip)


@given(st.sets(st.sampled_from(POSE_CHANNELS), min_size=1))
def test_signs_are_those_of_the_flipped_channels(names):
    signs = parse_face_argument("vmc", ",flip=" + "+".join(names)).signs
    assert {name for name, sign in zip(POSE_CHANNELS, signs, strict=True) if sign == -1} == names
    assert set(signs) <= {1, -1}


@pytest.mark.parametrize(
    ("argument", "text"),
    [
        ("1,flip=jaw", "flip = 'jaw': expected a pose channel .*roll, pitch, yaw, x, y, z"),
        ("1,flip=", "flip = '': expected a pose channel"),
        ("1,mirror=yes", "option 'mirror' is not known .flip."),
    ],
)
def test_what_cannot_be_used_is_one_line_with_choices(argument, text):
    with pytest.raises(ConfigError, match=text):
        parse_face_argument("live-link", argument)


def test_a_place_that_does_not_say_where_is_this_machine_alone():
    assert parse_endpoint("vmc", "", 39539) == ("127.0.0.1", 39539)
    assert parse_endpoint("vmc", "1234", 39539) == ("127.0.0.1", 1234)
    assert parse_endpoint("vmc", "0.0.0.0", 39539) == ("0.0.0.0", 39539)
    assert parse_endpoint("vmc", "[::]", 39539) == ("::", 39539)
    assert parse_endpoint("vmc", "0.0.0.0:1234", 39539) == ("0.0.0.0", 1234)
    assert parse_endpoint("vmc", "[::1]:1234", 39539) == ("::1", 1234)


@pytest.mark.parametrize("place", ["x", "0", "65536", "-1", ":1234", "host:", "host", "1.5", "²"])
def test_a_port_that_is_none_is_one_line(place):
    with pytest.raises(ConfigError, match="expected a UDP port .valid: live-link, live-link:PORT, live-link:HOST:PORT"):
        parse_endpoint("live-link", place, 11111)
