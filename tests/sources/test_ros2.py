"""A person in a graph of ROS 2: two sessions of zenoh and their router, in this process."""

import time
from contextlib import closing

import numpy as np
import pytest
from ros2_graph import client, free_endpoint, serving, until

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX
from sfms_robot.network import Ros2Node, ros_domain
from sfms_robot.signals.ros2_messages import ACTION_UNITS, AUDIO, NO_HASH, STRING, to_cdr, units_of, wire_name
from sfms_robot.sources.registry import open_source
from sfms_robot.sources.ros2 import Ros2Sight, Ros2Voice

FACS = "/humans/faces/23bd5/facs"
SMILE = CHANNEL_INDEX["mouthSmileLeft"]


def face(**shapes):
    motion = np.zeros(58, np.float32)
    for name, value in shapes.items():
        motion[CHANNEL_INDEX[name]] = value
    return motion


def send(part, router, topic, wire, data, count="received", domain=0):
    """Publish a message, and wait until the part has counted it."""
    before = part.statistics()[count]
    with closing(Ros2Node("tester", domain, router, sends={topic: wire})) as node:
        until(lambda: node.matched(topic))
        node.publish(topic, data, 0)
        until(lambda: part.statistics()[count] > before)


def test_a_voice_is_heard_at_the_rate_and_the_channels_that_are_given(router):
    tone = np.rint(16_000 * np.sin(np.arange(48_000) / 20)).astype("<i2")
    sound = {"audio": {"data": np.stack([tone, tone], axis=1).tobytes()}}
    with closing(Ros2Voice("mic/audio,rate=48000,channels=2", router)) as voice:
        voice.start(time.monotonic())
        send(voice, router, "/mic/audio", wire_name(AUDIO), to_cdr(AUDIO, sound))
        assert voice.statistics()["rate_hz"] == 48_000 and not voice.statistics()["refused"]
        frames = [voice.take(index) for index in range(20)]
        assert max(np.abs(frame).max() for frame in frames if frame is not None) == pytest.approx(0.49, abs=0.02)
        assert not voice.lost
        voice.take(100)
        assert voice.lost


@pytest.mark.parametrize("argument", ["23bd5", f"{FACS},flip=yaw,domain=0"])
@pytest.mark.parametrize("hashed", [True, False], ids=["jazzy", "humble"])
def test_a_face_is_seen_through_its_action_units(router, argument, hashed):
    with closing(Ros2Sight(argument, router)) as sight:
        sight.start(time.monotonic())
        for motion in (face(), face(mouthSmileLeft=0.75, mouthSmileRight=0.75, jawOpen=0.25)):
            send(sight, router, FACS, wire_name(ACTION_UNITS, hashed), to_cdr(ACTION_UNITS, units_of(motion)))
            seen = sight.at(1000.0)
        assert seen.face.blendshapes[SMILE - 6] == pytest.approx(0.75) and not sight.lost
        sight.at(1001.0)
        assert sight.lost


UNITS, WIRE = to_cdr(ACTION_UNITS, units_of(face(jawOpen=0.5))), wire_name(ACTION_UNITS)
KIND, _, HASH = WIRE.partition("/")
BROKEN = units_of(face(jawOpen=0.5)) | {"intensity": np.full(99, np.nan)}
BAD = {
    "another type": (wire_name(STRING), to_cdr(STRING, {"data": "smile"}), f"expected {ACTION_UNITS}, got {STRING}"),
    "another version": (WIRE.replace("RIHS01_", "RIHS01_f"), UNITS, f"{ACTION_UNITS}: expected {HASH}, got RIHS01_f"),
    "cut off": (WIRE, UNITS[:-40], f"{ACTION_UNITS}: confidence: expected 396 bytes, got 356"),
    "no CDR": (f"{KIND}/{NO_HASH}", b"{}", "expected CDR, little-endian"),
    "not finite": (WIRE, to_cdr(ACTION_UNITS, BROKEN), "roll is not finite"),
    "too large": (WIRE, to_cdr(ACTION_UNITS, {"intensity": [100] * 99, "confidence": [1] * 99}), "100"),
}


@pytest.mark.parametrize(("wire", "data", "problem"), BAD.values(), ids=BAD)
def test_a_message_that_cannot_be_used_is_one_line_and_the_next_one_is_seen(router, caplog, wire, data, problem):
    with closing(Ros2Sight("23bd5", router)) as sight:
        sight.start(time.monotonic())
        for _ in range(2):
            send(sight, router, FACS, wire, data, "refused")
        send(sight, router, FACS, WIRE, UNITS)
        assert sight.at(1000.0) is not None
    (line,) = [line for line in caplog.messages if "left out" in line]
    assert line.startswith(f"sfms_robot_face: {FACS}: left out: ") and problem in line and "\n" not in line


@pytest.mark.parametrize("data", [b"RIFF" + bytes(40), bytes(417)])
def test_sound_that_is_not_samples_is_refused_by_what_it_is(router, caplog, data):
    with closing(Ros2Voice("mic", router)) as voice:
        send(voice, router, "/mic", wire_name(AUDIO), to_cdr(AUDIO, {"audio": {"data": data}}), "refused")
    (line,) = [line for line in caplog.messages if "left out" in line]
    assert "data: expected 16-bit samples of 1 channels (format wave), got" in line


def test_where_nothing_comes_one_line_says_why(router, tmp_path, caplog):
    nowhere = tmp_path / "nowhere"
    nowhere.mkdir()
    with closing(Ros2Sight("23bd5", client(nowhere, free_endpoint()))) as sight:
        sight.start(time.monotonic())
        for time_s in (4.0, 6.0, 8.0):
            assert sight.at(time_s) is None and not sight.lost
    (line,) = [line for line in caplog.messages if "nothing came" in line]
    assert line.startswith("--face ros2: nothing came yet: no router at the endpoints of")
    with closing(Ros2Node("here", 0, router, takes={"/mic": wire_name(AUDIO)})) as here:
        assert here.wait(10.0) and here.absence("/mic") == "no publisher of /mic in domain 0"
        with closing(Ros2Node("there", 7, router, sends={"/mic": wire_name(AUDIO)})):
            until(lambda: "domain 7" in here.absence("/mic"))
            assert here.absence("/mic").endswith("in domain 0; one is in domain 7 (,domain=N or ROS_DOMAIN_ID)")
            with closing(Ros2Node("too", 0, router, sends={"/mic": wire_name(AUDIO)})):
                until(lambda: "sends nothing" in here.absence("/mic"))


def test_a_router_that_comes_late_goes_and_comes_back_is_found_again(tmp_path):
    endpoint = free_endpoint()
    router = client(tmp_path, endpoint)
    with closing(Ros2Sight("23bd5", router)) as sight:
        for _ in range(2):
            with serving(endpoint):
                send(sight, router, FACS, WIRE, UNITS)
        assert sight.statistics() == {"sent": 0, "received": 2, "refused": 0}


TOPIC = "expected a topic such as /audio (letters, digits, '_', '/'), got"


@pytest.mark.parametrize(
    ("kind", "argument", "named", "problem"),
    [
        ("audio", "", "", f"{TOPIC} ''"),
        ("audio", ":/a b", "", f"{TOPIC} '/a b'"),
        ("audio", ":/mic,rate=fast", ":/mic,rate=fast", "expected a whole number of up to 20 digits, got fast"),
        ("audio", ":/mic,rate=100", ":/mic,rate=100", "rate_hz = 100: expected a rate of speech (4000 to "),
        ("audio", ":/mic,channels=0", "", "channels: expected 1 to 8, got 0"),
        ("audio", ":/mic,flip=yaw", "", "option 'flip' is not known (domain, rate, channels)"),
        ("face", ":a,domain=233", "", "domain: expected 0 to 232, got '233'"),
        ("face", ":a,flip=nose", "", "flip = 'nose': expected a pose channel"),
    ],
)
def test_arguments_that_cannot_be_used_are_one_line(kind, argument, named, problem):
    with pytest.raises(ConfigError) as error:
        open_source(**{"audio": "none", kind: f"ros2{argument}"})
    assert str(error.value).startswith(f"--{kind} ros2{named}: {problem}")


def test_the_domain_is_that_of_ros_domain_id_unless_one_is_given(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert ros_domain("", "--audio ros2") == 42 and ros_domain("7", "--audio ros2") == 7
    monkeypatch.setenv("ROS_DOMAIN_ID", "mine")
    with pytest.raises(ConfigError, match="^--audio ros2: ROS_DOMAIN_ID: expected 0 to 232, got 'mine'$"):
        ros_domain("", "--audio ros2")
