"""One sender at a time, a bounded number of packets a call, and times that go forward."""

import logging
import socket
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import PacketError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM
from sfms_robot.sources.live_face import (
    LOST_S,
    PACKETS_PER_CALL,
    SILENT_S,
    UNHEARD_S,
    Datagram,
    DatagramSocket,
    FaceArgument,
    LiveFace,
    UdpSight,
)

FIRST, SECOND = ("192.0.2.1", 1), ("192.0.2.2", 2)


class Bytes:
    """A protocol of one byte: jawOpen in percent; 255 is none of it."""

    def __init__(self):
        self.restarts = 0

    def restart(self):
        self.restarts += 1

    def decode(self, data, time_s):
        if data == b"\xff":
            raise PacketError("255 percent")
        motion = np.zeros(MOTION_DIM, np.float32)
        motion[0] = data[0] / 100
        return motion

    def statistics(self):
        return {"restarts": self.restarts}


@pytest.fixture
def sight():
    opened = UdpSight(
        "test", DatagramSocket("test", "127.0.0.1", 0), Bytes(), LiveFace(FaceArgument("").signs), "call 42"
    )
    yield opened
    opened.close()


def feed(sight, sender, *times_s, data=b"\x0a"):
    for time_s in times_s:
        sight.feed(Datagram(data, sender, time_s))


def counts(sight):
    return {name: sight.statistics()[name] for name in ("faces", "refused", "malformed")}


def test_a_second_sender_is_refused_and_said_once(sight, caplog):
    feed(sight, FIRST, 0.0)
    feed(sight, SECOND, 0.1, 0.2, 0.3)
    assert counts(sight) == {"faces": 1, "refused": 3, "malformed": 0}
    (said,) = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert "192.0.2.2:2 sends too and is refused until 192.0.2.1:1 is silent" in said


def test_a_second_sender_takes_over_when_the_first_is_silent(sight):
    feed(sight, FIRST, 0.0)
    feed(sight, SECOND, SILENT_S - 0.01, SILENT_S)
    feed(sight, FIRST, SILENT_S + 0.1)
    assert counts(sight) == {"faces": 2, "refused": 2, "malformed": 0}
    assert sight.statistics()["sender"] == "192.0.2.2:2"


def test_of_another_sender_rest_is_learned_anew(sight):
    for i in range(20):
        feed(sight, FIRST, i / 10)
        sight.at(i / 10)
    feed(sight, SECOND, 5.0, data=b"\x1e")
    assert sight.at(5.0).face.pose[0] == pytest.approx(0, abs=1e-6)


def test_noise_takes_no_senders_place(sight):
    feed(sight, SECOND, 0.0, 0.1, data=b"\xff")
    feed(sight, FIRST, 0.2)
    assert counts(sight) == {"faces": 1, "refused": 0, "malformed": 2}


def test_a_reason_is_said_once(sight, caplog):
    feed(sight, FIRST, 0.0, 0.1, 0.2, data=b"\xff")
    assert [r.message for r in caplog.records] == ["test: packets of 192.0.2.1:1 are left out: 255 percent (said once)"]


def test_what_to_do_is_said_when_nobody_sends(sight, caplog):
    sight.at(UNHEARD_S)
    assert not caplog.records
    sight.at(UNHEARD_S + 1)
    sight.at(UNHEARD_S + 2)
    assert [record.message for record in caplog.records] == ["test: no packets yet: call 42"]


def test_a_sender_that_falls_silent_is_lost_after_half_a_second_until_it_is_back(sight):
    feed(sight, FIRST, *np.arange(21) * 0.05)
    lost = []
    for frame in range(25, 51):
        sight.at(frame * 0.04)
        lost.append(sight.lost)
    assert lost == [frame * 0.04 - 1.0 > LOST_S for frame in range(25, 51)]
    assert 0.5 <= LOST_S <= 0.6
    feed(sight, FIRST, 2.05)
    sight.at(2.08)
    assert not sight.lost


@given(late_s=st.lists(st.floats(0, 0.08), min_size=60, max_size=60), gaps=st.sets(st.integers(1, 19)))
def test_one_that_sends_ten_a_second_is_not_lost_for_two_packets_in_a_row(late_s, gaps):
    sight = UdpSight("test", DatagramSocket("test", "127.0.0.1", 0), Bytes(), LiveFace(FaceArgument("").signs), "call")
    due_s = [(n, n * 0.1 + late) for n, late in enumerate(late_s) if n // 3 not in gaps or n % 3 == 0]
    for frame in range(1, 148):
        time_s = frame * 0.04
        feed(sight, FIRST, *[at for _, at in due_s if time_s - 0.04 < at <= time_s])
        sight.at(time_s)
        assert not sight.lost
    sight.close()


def test_nobody_who_never_sent_is_lost(sight):
    sight.at(1e6)
    assert not sight.lost


def test_the_newest_face_of_an_instant_or_before_is_seen(sight):
    sight.start(10.0)
    for place, data in enumerate((b"\x00", b"\x0a", b"\x14")):
        feed(sight, FIRST, 10.0 + place * 0.01, data=data)
    assert sight.at(-0.1) is None
    assert sight.at(0.012).face.time_s == pytest.approx(0.01)
    assert sight.at(0.013).face.time_s == pytest.approx(0.01)
    assert sight.at(9.0).face.time_s == pytest.approx(0.02)


def test_times_go_forward_whatever_the_wall_clock_does(sight):
    feed(sight, FIRST, 1.0, 0.5)
    assert sight.at(0.9) is None
    assert sight.at(1.0).face.time_s == 1.0


def test_a_flood_is_read_in_parts(sight):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for _ in range(2 * PACKETS_PER_CALL):
            out.sendto(b"\x01", sight.address)
    counts = [0]
    while counts[-1] < 2 * PACKETS_PER_CALL:
        sight.at(1e9)
        counts.append(sight.statistics()["packets"])
    assert all(0 < after - before <= PACKETS_PER_CALL for before, after in zip(counts, counts[1:], strict=False))


def test_of_faces_nobody_asks_for_the_newest_are_kept(sight):
    feed(sight, FIRST, *np.arange(1000) * 0.02)
    assert sight.at((999 - 256) * 0.02) is None
    assert sight.at((999 - 255) * 0.02) is not None


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells when a datagram came in")
def test_a_datagram_has_the_time_it_came_in_not_the_time_it_was_read():
    opened = DatagramSocket("test", "127.0.0.1", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for _ in range(3):
            out.sendto(b"\x01", opened.address)
        times_s = []
        while len(times_s) < 3:
            times_s += [packet.time_s for packet in opened.waiting()]
        assert times_s == sorted(set(times_s)) and len(times_s) == 3
    opened.close()


def test_the_strongest_blink_since_the_last_question_is_seen():
    face = LiveFace(FaceArgument("").signs)
    for i, blink in enumerate((0.0, 0.0, 1.0, 0.2)):
        motion = np.zeros(MOTION_DIM, np.float32)
        motion[CHANNEL_INDEX["eyeBlinkLeft"]] = blink
        face.put(i / 60, motion)
        if i == 0:
            face.at(0.0)
    assert face.at(1.0).face.motion[CHANNEL_INDEX["eyeBlinkLeft"]] == 1.0
    assert face.at(1.0).face.time_s == pytest.approx(3 / 60)
