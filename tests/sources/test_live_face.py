"""A live face: its flag, the person's rest, and one UDP sender at a time, in bounded time, whose times go forward."""

import logging
import socket
import sys

import numpy as np
import pytest
from free_ports import free_udp_port
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import ConfigError, PacketError, PortError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, POSE, POSE_CHANNELS, SHAPES
from sfms_robot.signals.rotations import angles_of, rotation
from sfms_robot.sources import live_face as live
from sfms_robot.sources.registry import split_kind

SMILE, JAW = CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["jawOpen"]
HZ = 10
FIRST, SECOND = ("192.0.2.1", 1), ("192.0.2.2", 2)


@pytest.mark.parametrize(
    ("face", "kind", "place", "flips"),
    [
        ("live-link", "live-link", "", ()),
        ("live-link:11111", "live-link", "11111", ()),
        ("live-link,flip=yaw", "live-link", "", ("yaw",)),
        ("vmc:0.0.0.0:39539,flip=yaw+roll", "vmc", "0.0.0.0:39539", ("yaw", "roll")),
        ("webcam:C:\\a,b.mp4,flip=x", "webcam", "C:\\a,b.mp4", ("x",)),
        ("webcam:0,flip=yaw,flip=roll", "webcam", "0", ("yaw", "roll")),
    ],
)
def test_a_flag_is_a_kind_a_place_and_flips(face, kind, place, flips):
    given_kind, argument = split_kind(face)
    given_place, signs = live.parse_face_argument(kind, argument)
    assert (given_kind, given_place) == (kind, place)
    assert signs.tolist() == [-1 if name in flips else 1 for name in POSE_CHANNELS]


@pytest.mark.parametrize(
    ("argument", "text"),
    [
        ("1,flip=jaw", "flip = 'jaw': expected a pose channel .*roll, pitch, yaw, x, y, z"),
        ("1,flip=", "flip = '': expected a pose channel"),
        ("1,mirror=yes", "option 'mirror' is not known .flip."),
    ],
)
def test_an_option_that_cannot_be_used_is_one_line_with_choices(argument, text):
    with pytest.raises(ConfigError, match=text):
        live.parse_face_argument("live-link", argument)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("", ("127.0.0.1", 39539)),
        ("1234", ("127.0.0.1", 1234)),
        ("0.0.0.0", ("0.0.0.0", 39539)),
        ("[::]", ("::", 39539)),
        ("0.0.0.0:1234", ("0.0.0.0", 1234)),
        ("[::1]:1234", ("::1", 1234)),
    ],
)
def test_a_place_without_a_host_is_this_machine_alone(place, expected):
    assert live.parse_endpoint("vmc", place) == expected


@pytest.mark.parametrize("place", ["x", "0", "65536", "-1", ":1234", "host:", "host", "1.5", "²"])
def test_a_port_that_is_none_is_one_line(place):
    with pytest.raises(ConfigError, match="expected a UDP port .valid: live-link, live-link:PORT, live-link:HOST:PORT"):
        live.parse_endpoint("live-link", place)


def motion(pose=(0, 0, 0), **shapes):
    out = np.zeros(MOTION_DIM, np.float32)
    out[:3] = pose
    for name, value in shapes.items():
        out[CHANNEL_INDEX[name]] = value
    return out


def follow(faces, start_s=0.0, state=None):
    """Return what comes of faces at `HZ`, and the memory."""
    state = state or live.RestingFace()
    return np.array([state.relative(face, start_s + i / HZ) for i, face in enumerate(faces)]), state


angles = st.floats(-0.8, 0.8)


@given(st.tuples(angles, angles, angles), st.floats(0, 0.5))
def test_a_face_that_never_moves_is_at_rest_from_the_first_frame_on(pose, smile):
    out, _ = follow([motion(pose, mouthSmileLeft=smile)] * 20)
    assert np.abs(out).max() < 1e-5


@given(st.tuples(angles, angles, angles), st.integers(0, 2**32 - 1))
def test_the_offset_is_gone_after_3_s_whatever_the_first_face_did(pose, seed):
    """A person around some pose, seen in mid-turn, with a smile, at the start."""
    random = np.random.default_rng(seed)
    faces = [motion(np.add(pose, random.normal(0, 0.01, 3)), jawOpen=0.1) for _ in range(60)]
    faces[0] = motion(np.add(pose, 0.4), jawOpen=0.1, mouthSmileLeft=0.9)
    out, _ = follow(faces)
    assert np.abs(out[30:, :3]).max() < 0.08 and out[30:, JAW].max() < 0.02


def test_straight_ahead_is_found_again_after_the_camera_was_moved():
    _, state = follow([motion((0, 0, 0))] * 200 * HZ)
    assert state.samples.shape == (240, MOTION_DIM)  # the memory is bounded
    out, _ = follow([motion((0, 0.2, 0.5))] * 80 * HZ, 200, state)
    assert abs(out[0][2]) > 0.4 and np.abs(out[-1][:3]).max() < 0.01


@pytest.mark.parametrize("seconds", [1, 10, 50])
def test_less_than_a_minute_of_an_expression_stays_one(seconds):
    _, state = follow([motion((0.1, 0, 0), mouthSmileLeft=0.1)] * 120 * HZ)
    out, _ = follow([motion((0.1, 0, 0.5), mouthSmileLeft=0.6)] * seconds * HZ, 120, state)
    assert out[:, SMILE] == pytest.approx((0.6 - 0.1) / 0.9, abs=1e-5) and out[:, 2].min() > 0.45


def test_a_held_expression_never_vanishes():
    out, _ = follow([motion(mouthSmileLeft=0.9)] * 300 * HZ)
    assert out[:, SMILE].min() > 0.75


def test_pose_and_place_are_seen_from_the_resting_ones():
    at_rest, turn = np.array([0.1, -0.2, 0.6]), np.array([0.0, 0.3, 0.0])
    rest_matrix, turn_matrix = rotation(np.stack([at_rest, turn]))
    face = motion(at_rest)
    face[3:6] = (1.0, 2.0, 3.0)
    _, state = follow([face] * 10 * HZ)
    turned = motion(angles_of((rest_matrix @ turn_matrix)[None])[0])
    turned[3:6] = face[3:6] + rest_matrix @ [0.1, 0.0, 0.0]  # towards where the resting face looks
    (out,), _ = follow([turned], 10, state)
    assert out[:6] == pytest.approx([*turn, 0.1, 0, 0], abs=1e-5)


@pytest.mark.parametrize(("away_s", "yaw"), [(live.AWAY_S, 0.0), (live.AWAY_S / 2, 0.5)])
def test_a_face_that_comes_back_is_known_unless_it_was_away_for_10_s(away_s, yaw):
    _, state = follow([motion((0, 0, 0))] * 60 * HZ)
    out, state = follow([motion((0, 0, 0.5))] * 10, 60 + away_s, state)
    assert out[0][2] == pytest.approx(yaw, abs=1e-4) and (len(state.samples) < 5) == (yaw == 0.0)


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(0, 1), st.floats(0, 30)), min_size=1, max_size=40))
def test_the_result_is_a_face(faces):
    state, time_s = live.RestingFace(), 0.0
    for angle, value, pause_s in faces:
        time_s += pause_s
        given_face = np.full(MOTION_DIM, value, np.float32)
        given_face[POSE] = angle
        out = state.relative(given_face, time_s)
        assert np.isfinite(out).all() and out[SHAPES].min() >= 0 and out[SHAPES].max() <= 1


def test_the_strongest_blink_since_the_last_question_is_seen():
    face = live.LiveFace()
    for i, blink in enumerate((0.0, 0.0, 1.0, 0.2)):
        face.put(i / 60, motion(eyeBlinkLeft=blink))
        if i == 0:
            face.at(0.0)
    assert face.at(1.0).face.motion[CHANNEL_INDEX["eyeBlinkLeft"]] == 1.0
    assert face.at(1.0).face.time_s == pytest.approx(3 / 60)


class Bytes(live.Decoder):
    """A protocol of one byte: the first pose channel in percent; 255 is none of it."""

    def __init__(self):
        self.times_s = []

    def decode(self, data, time_s):
        self.times_s.append(time_s)
        if data == b"\xff":
            raise PacketError("255 percent")
        out = np.zeros(MOTION_DIM, np.float32)
        out[0] = data[0] / 100
        return out


def opened(place=None, decoder=None):
    return live.UdpSight("vmc", str(place or free_udp_port()), decoder or Bytes(), lambda *_: "call 42")


@pytest.fixture
def sight(caplog):
    sight = opened()
    caplog.clear()
    yield sight
    sight.close()


def feed(sight, sender, *times_s, data=b"\x0a"):
    for time_s in times_s:
        sight.feed(data, sender, time_s)


def counts(sight):
    return {name: sight.statistics()[name] for name in ("faces", "refused", "malformed")}


def test_a_second_sender_is_refused_once_in_the_log_until_the_first_is_silent(sight, caplog):
    feed(sight, FIRST, 0.0)
    feed(sight, SECOND, 0.1, 0.2, live.SILENT_S - 0.01)
    assert counts(sight) == {"faces": 1, "refused": 3, "malformed": 0}
    (said,) = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert "192.0.2.2:2 sends too and is refused until 192.0.2.1:1 is silent" in said
    feed(sight, SECOND, live.SILENT_S)
    feed(sight, FIRST, live.SILENT_S + 0.1)
    assert counts(sight) == {"faces": 2, "refused": 4, "malformed": 0}
    assert sight.statistics()["sender"] == "192.0.2.2:2"


def test_a_new_port_for_each_packet_is_one_sender_and_two_programs_of_one_machine_are_two(sight):
    for number in range(10):
        feed(sight, ("192.0.2.1", 100 + number), number / 30)
    assert counts(sight) == {"faces": 10, "refused": 0, "malformed": 0}
    for number in range(10, 20):
        feed(sight, ("192.0.2.1", 109 + number % 2), number / 30)
    assert counts(sight) == {"faces": 16, "refused": 4, "malformed": 0}
    assert sight.statistics()["sender"] == "192.0.2.1:109"


def test_the_rest_of_another_sender_is_learned_from_its_first_face_on(sight):
    for i in range(20):
        feed(sight, FIRST, i / 10)
        sight.at(i / 10)
    feed(sight, SECOND, 5.0, data=b"\x1e")
    assert sight.at(5.0).face.pose[0] == pytest.approx(0, abs=1e-6)


def test_noise_takes_no_senders_place_and_its_reason_is_logged_once(sight, caplog):
    feed(sight, SECOND, 0.0, 0.1, data=b"\xff")
    feed(sight, FIRST, 0.2)
    assert counts(sight) == {"faces": 1, "refused": 0, "malformed": 2}
    (said,) = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert said == "vmc: packets of 192.0.2.2:2 are left out: 255 percent (said once)"


def test_without_packets_the_log_says_once_what_to_do_and_no_sender_is_lost(sight, caplog):
    sight.at(live.UNHEARD_S)
    assert not caplog.records
    sight.at(live.UNHEARD_S + 1)
    sight.at(1e6)
    assert [record.message for record in caplog.records] == ["vmc: no packets yet: call 42"]
    assert not sight.lost


def test_a_silent_sender_is_lost_after_half_a_second_until_it_is_back(sight):
    feed(sight, FIRST, *np.arange(21) * 0.05)
    lost = []
    for frame in range(25, 51):
        sight.at(frame * 0.04)
        lost.append(sight.lost)
    assert lost == [frame * 0.04 - 1.0 > live.LOST_S for frame in range(25, 51)] and 0.5 <= live.LOST_S <= 0.6
    feed(sight, FIRST, 2.05)
    sight.at(2.08)
    assert not sight.lost


@given(late_s=st.lists(st.floats(0, 0.08), min_size=60, max_size=60), gaps=st.sets(st.integers(1, 19)))
def test_two_missing_packets_of_ten_a_second_are_no_loss(late_s, gaps):
    sight = opened()
    due_s = [(n, n * 0.1 + late) for n, late in enumerate(late_s) if n // 3 not in gaps or n % 3 == 0]
    for frame in range(1, 148):
        time_s = frame * 0.04
        feed(sight, FIRST, *[at for _, at in due_s if time_s - 0.04 < at <= time_s])
        sight.at(time_s)
        assert not sight.lost
    sight.close()


def test_the_newest_face_of_an_instant_or_before_is_seen(sight):
    sight.start(10.0)
    for place, data in enumerate((b"\x00", b"\x0a", b"\x14")):
        feed(sight, FIRST, 10.0 + place * 0.01, data=data)
    assert sight.at(-0.1) is None and sight.at(0.012).face.time_s == pytest.approx(0.01)
    assert sight.at(9.0).face.time_s == pytest.approx(0.02)


def test_times_go_forward_whatever_the_wall_clock_does(sight):
    feed(sight, FIRST, 1.0, 0.5)
    assert sight.at(0.9) is None and sight.at(1.0).face.time_s == 1.0


def test_a_flood_is_read_in_parts_and_the_newest_faces_are_kept(sight):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for _ in range(2 * live.PACKETS_PER_CALL):
            out.sendto(b"\x01", sight.address)
    counts = [0]
    while counts[-1] < 2 * live.PACKETS_PER_CALL:
        sight.at(0.0)
        counts.append(sight.statistics()["packets"])
    assert all(0 < after - before <= live.PACKETS_PER_CALL for before, after in zip(counts, counts[1:], strict=False))
    sender, first_s = sight._sender, sight._heard_s + 1.0
    feed(sight, sender, *(first_s + np.arange(1000) * 0.02))
    assert sight.at(first_s + (999 - 256) * 0.02) is None and sight.at(first_s + (999 - 255) * 0.02) is not None


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says when a datagram came in")
def test_a_datagram_has_the_time_it_came_in_not_the_time_it_was_read():
    decoder = Bytes()
    sight = opened(decoder=decoder)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for _ in range(3):
            out.sendto(b"\x01", sight.address)
    while len(decoder.times_s) < 3:
        sight.at(0.0)
    assert decoder.times_s == sorted(set(decoder.times_s))
    sight.close()


def test_a_port_is_one_runs_until_it_is_closed(sight):
    place = sight.address[1]
    with pytest.raises(PortError, match=r"vmc: UDP port \d+ on 127.0.0.1 is used by another program"):
        opened(place)
    sight.close()
    sight.close()
    opened(place).close()


@pytest.mark.parametrize("host", ["a..b", "203.0.113.7"])
def test_an_address_of_another_machine_is_one_line(host):
    with pytest.raises(PortError, match=f"vmc: UDP port 11111 on {host}: ") as raised:
        opened(f"{host}:11111")
    assert "\n" not in str(raised.value)
