"""Live Link Face: what a packet holds, what becomes of those that hold none, and the order of those that do."""

import csv
import gzip
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from free_ports import free_udp_port
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.emulator.phone import EmulatedPhone, recorded_packets, renumbered
from sfms_robot.errors import PacketError
from sfms_robot.frames import CHANNEL_INDEX, ORDERS, SHAPES
from sfms_robot.sources.live_link import LiveLinkDecoder, motion_of, open_live_link, parse_packet

PACKETS = recorded_packets()
DECODED = Path(__file__).parents[1] / "assets" / "live_link_llv.csv.gz"
REAL_HEAD = bytes.fromhex(  # of an iPhone, by name: kaffeeklatsch's test of the same protocol
    "06 00 00 00 24 35 39 30 34 41 41 34 42 2d 41 44 39 44 2d 34 33 45 35 2d 39 38 41 42 2d 38 39 41"
    "41 45 42 38 41 42 32 37 37 00 00 00 06 69 50 68 6f 6e 65 00 0a 3f d9 3f 07 02 80 00 00 00 3c 00 00 00 01 3d"
)


def decoded():
    with gzip.open(DECODED, "rt") as file:
        return list(csv.DictReader(file))


def packet(number=100, values=(0.25,) * 61, version=6, device=b"id", subject=b"phone", rate=(60, 1)):
    """As the app writes one."""
    names = b"".join(struct.pack(">i", len(name)) + name for name in (device, subject))
    frame = struct.pack(">ifii", number, 0.5, *rate)
    return bytes([version]) + names + frame + struct.pack(f">B{len(values)}f", len(values), *values)


def test_every_recorded_packet_says_what_another_program_read_in_it_and_is_motion_by_name():
    rows = decoded()
    assert len(rows) == len(PACKETS) == 180
    for data, row in zip(PACKETS, rows, strict=True):
        parsed = parse_packet(data)
        told = {name: float(value) for name, value in row.items() if name != "t_s"}
        assert parsed.values == pytest.approx(list(told.values()), abs=1e-6)
        assert (parsed.subject, parsed.rate_hz) == ("LLV Default Device", 60)
        motion = motion_of(parsed.values)
        shapes = [min(max(told[name[0].upper() + name[1:]], 0), 1) for name in ORDERS["apple"]]
        assert motion[[CHANNEL_INDEX[name] for name in ORDERS["apple"]]] == pytest.approx(shapes, abs=1e-6)
        angles = [told[name] for name in ("HeadRoll", "HeadPitch", "HeadYaw")]
        assert motion[:6] == pytest.approx([*angles, 0.0, 0.0, 0.0], abs=1e-6)  # radians, as they are


def test_the_head_of_a_packet_of_an_iphone_and_what_is_not_used_of_a_sender_are_told():
    parsed = parse_packet(REAL_HEAD + bytes(61 * 4))
    assert (parsed.subject, parsed.number, parsed.rate_hz) == ("iPhone", 0x0A3FD9, 60)
    decoder = LiveLinkDecoder()
    for count, said in ((52, "52 values, not 61: no head angles"), (68, "68 values, not 61: the first 55 are used")):
        decoder.decode(packet(count, (0.0,) * count), count)
        assert decoder.remark() == said


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty"),
        (packet()[:-1], "cut off"),
        (packet()[:3], "cut off"),
        (packet(values=(0.0,) * 51), "51 values, of which the first 52 have to be blendshapes"),
        (packet(values=(float("nan"),) * 61), "not finite"),
        (packet(version=5)[:-1], "version 5, not 6.*update"),
        (b"mouthSmile_R-42|jawOpen-12|=head#-21,-6,-6|", "iFacialMocap's own format"),
        (b"/VMC/Ext/OK\0,i\0\0\0\0\0\1", "--face vmc takes it"),
        (packet(subject=b"x" * 600), "longer than its packet"),
        (b"\x06\x7f\xff\xff\xff", "longer than its packet"),
        (b"GET / HTTP/1.1\r\n\r\n", "no packets of Live Link Face"),
        (struct.pack(">HH", 1, 5) + b"phone" + bytes(16) + struct.pack(">H", 130) + bytes(284), "MetaHuman Animator"),
        (struct.pack("<HH", 1, 5) + b"phone" + bytes(16) + struct.pack("<H", 130) + bytes(284), "MetaHuman Animator"),
    ],
)
def test_what_is_no_packet_is_refused_in_one_line(data, reason):
    with pytest.raises(PacketError, match=reason) as told:
        parse_packet(data)
    assert "\n" not in str(told.value)


FACE = tuple(n / 100 for n in range(52))


@pytest.mark.parametrize(
    ("data", "rate_hz"),
    [
        (packet(values=(*FACE, 0.3, 0.2, 0.1, *[0.0] * 6), rate=(30, 0)), 30),  # int(30 / 60) of a library
        (packet(values=(*FACE, 0.3, 0.2, 0.1), rate=(0, 1)), 60),
        (packet(values=(*FACE, 0.3, 0.2, 0.1, *[float("nan")] * 6)), 60),  # eyes
        (packet(values=(*FACE, 0.3, 0.2, 0.1, *[9.0] * 13)), 60),  # 68
        (packet(values=(*FACE, 0.3, 0.2, 0.1), version=7), 60),
        (packet(values=(*FACE, 0.3, 0.2, 0.1)) + b"more", 60),
    ],
)
def test_what_a_face_does_not_need_refuses_no_packet(data, rate_hz):
    parsed = parse_packet(data)
    assert parsed.rate_hz == rate_hz and np.isfinite(parsed.values).all()
    motion = motion_of(parsed.values)
    assert motion[:3] == pytest.approx([0.1, 0.2, 0.3])
    assert motion[CHANNEL_INDEX["eyeLookDownLeft"]] == pytest.approx(0.01)


@pytest.mark.parametrize("name", ["Jürgens 📱", "電話"])
@pytest.mark.parametrize("code", ["utf-8", "utf-16-be"])
def test_a_names_length_may_be_in_characters(name, code):
    data, plain = name.encode(code), packet(subject=b"")
    length = len(name) if code == "utf-8" else -len(name)
    assert parse_packet(packet(subject=name.encode())).subject == name
    parsed = parse_packet(plain[:7] + struct.pack(">i", length) + data + plain[11:])
    assert (parsed.subject, parsed.number, parsed.values[0]) == (name, 100, 0.25)


def damaged(which, damage, kept):
    """A recorded packet with other bytes at some places, cut off after so many."""
    data = bytearray(PACKETS[which])
    for place, value in damage:
        data[place] = value
    return bytes(data[:kept])


DAMAGE = st.lists(st.tuples(st.integers(0, 319), st.integers(0, 255)), max_size=20)


@given(st.binary(max_size=600) | st.builds(damaged, st.integers(0, 179), DAMAGE, st.just(320) | st.integers(0, 320)))
def test_any_bytes_are_refused_or_finite(data):
    try:
        values = parse_packet(data).values
    except PacketError:
        return
    assert values is None or (np.isfinite(values).all() and np.isfinite(motion_of(values)).all())


def decode(numbers, decoder=None, start_s=0.0, step_s=1 / 60):
    """Which of these frame numbers become faces, and what is counted."""
    decoder = decoder or LiveLinkDecoder()
    seen = [n for i, n in enumerate(numbers) if decoder.decode(packet(n), start_s + i * step_s) is not None]
    return seen, {name: count for name, count in decoder.statistics().items() if count and name != "subject"}


@pytest.mark.parametrize(
    ("numbers", "seen", "counts"),
    [
        ([1, 2, 3], [1, 2, 3], {}),
        ([1, 2, 5], [1, 2, 5], {"lost": 2}),
        ([1, 2, 2, 3], [1, 2, 3], {"doubled": 1}),
        ([1, 3, 2, 4], [1, 3, 4], {"late": 1, "lost": 0}),
        ([2, 4, 6, 8], [2, 4, 6, 8], {}),  # 30 a second, counted at 60
        ([5183998, 5183999, 0, 1], [5183998, 5183999, 0, 1], {"recounted": 1}),  # midnight
        ([2**31 - 1, -(2**31), 1 - 2**31], [2**31 - 1, -(2**31), 1 - 2**31], {"recounted": 1}),
        ([900, 901, 0, 1], [900, 901, 0, 1], {"recounted": 1}),  # the app was started again
        ([1, 2, 70000, 3, 4], [1, 2, 70000, 3, 4], {"recounted": 1}),  # one number that was wrong
    ],
)
def test_frame_numbers_tell_what_was_lost(numbers, seen, counts):
    got, counted = decode(numbers)
    assert got == seen
    assert counted == {name: count for name, count in counts.items() if count}


def test_after_a_silence_any_number_will_do():
    decoder = LiveLinkDecoder()
    decode([100, 101], decoder)
    assert decode([95, 96], decoder, start_s=1.0) == ([95, 96], {"recounted": 1})


@given(st.permutations(range(12)))
def test_faces_are_always_in_order_whatever_the_network_does(numbers):
    seen, _ = decode(numbers)
    assert seen == sorted(seen) and seen[-1] == 11


@pytest.mark.parametrize("values", [(0.1, 0.2, 0.3), (0.25,) * 30], ids=["moves", "is still"])
def test_a_program_that_does_not_count_is_seen_and_a_packet_without_a_face_shows_none(values):
    decoder = LiveLinkDecoder()
    for number, value in enumerate(values):
        assert decoder.decode(packet(0, (value,) * 61), number / 60) is not None
    assert decoder.remark() is None and decoder.decode(packet(1, values=()), 1.0) is None
    counted = decoder.statistics()
    assert (counted["doubled"], counted["lost"], counted["no_face"]) == (0, 0, 1)


@pytest.fixture
def sight():
    opened = open_live_link("127.0.0.1:" + str(free_udp_port()))
    opened.start(0.0)
    yield opened
    opened.close()


def test_an_emulated_phone_is_seen(sight):
    assert sight.at(1e9) is None
    with closing(EmulatedPhone(*sight.address)) as phone:
        phone.send_until(10 / 60)
    while sight.statistics()["packets"] < 11:  # a slow call leaves some to the next
        sight.at(1e9)
    assert sight.statistics()["faces"] == 0  # its units are not decided yet
    sight.feed(renumbered(PACKETS[10], 2**20), sight._sender, sight._heard_s + 1.0)
    face = sight.at(1e9).face
    assert face.time_s > 0 and face.blendshapes.max() <= motion_of(parse_packet(PACKETS[10]).values)[SHAPES].max()
    assert sight.statistics()["faces"] == 1 and sight.statistics()["lost"] == 0


def test_pose_channels_are_flipped_on_request():
    values, poses = np.zeros(61, np.float32), {}
    for flip in ("", ",flip=yaw+roll"):
        opened = open_live_link(f"127.0.0.1:{free_udp_port()}{flip}")
        opened.feed(packet(1, values), ("192.0.2.1", 1), 0.0)
        opened.feed(packet(61, values), ("192.0.2.1", 1), 1.0)  # straight ahead
        assert opened.at(1.0).face.pose[:3] == pytest.approx([0, 0, 0])
        opened.feed(packet(62, (*values[:52], 0.3, 0.2, 0.1, *values[55:])), ("192.0.2.1", 1), 1.02)
        poses[flip] = opened.at(1.02).face.pose[:3]
        opened.close()
    assert poses[""] == pytest.approx([0.1, 0.2, 0.3], abs=0.02)
    assert poses[",flip=yaw+roll"] == pytest.approx([-0.1, 0.2, -0.3], abs=0.02)
