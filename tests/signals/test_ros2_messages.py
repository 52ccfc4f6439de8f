"""Messages of ROS 2 against rosbags, an independent writer and reader of them, and faces as action units."""

import struct

import numpy as np
import pytest

from sfms_robot.errors import PacketError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, POSE
from sfms_robot.signals.ros2_messages import (
    ACTION_UNITS,
    AUDIO,
    DIAGNOSTICS,
    EXPRESSION,
    JOINT_STATE,
    POINT,
    STRING,
    face_of,
    fields_of,
    from_cdr,
    header,
    schema_text,
    to_cdr,
    type_hash,
    units_of,
)

rosbags = pytest.importorskip("rosbags.typesys", reason="needs rosbags, of the extra [dev]")

AT = header(1_700_000_000.25, "head")
WIDE = np.linspace(0, 1, 99, dtype=np.float32)
PAIRS = [{"key": "state", "value": "idle"}, {"key": "", "value": "äöü"}]
STATUS = {"level": 2, "name": "sfms_robot: run", "message": "fault", "hardware_id": "face28", "values": PAIRS}
MESSAGES = {
    "joints": (JOINT_STATE, {"header": AT, "name": ["neck_yaw", "jaw", ""], "position": np.array([0.5, -1e-9, 3.0])}),
    "joints moving": (JOINT_STATE, {"header": AT, "name": ["a"], "position": [1.0], "velocity": [2.0], "effort": [3]}),
    "no joints": (JOINT_STATE, {}),
    "units": (ACTION_UNITS, {"header": AT, "intensity": WIDE, "confidence": 1 - WIDE}),
    "expression": (EXPRESSION, {"header": AT, "expression": "happy", "valence": 0.8, "arousal": 0.5, "confidence": 1}),
    "text": (STRING, {"data": '{"kind": "nod"}'}),
    "diagnostics": (DIAGNOSTICS, {"header": AT, "status": [STATUS, {**STATUS, "values": []}]}),
    "no diagnostics": (DIAGNOSTICS, {"header": AT, "status": []}),
    "sound": (AUDIO, {"header": AT, "audio": {"data": bytes(range(256))}}),
    "point": (POINT, {"header": AT, "point": {"x": 1.0, "y": -0.25, "z": 0.5}}),
}


@pytest.fixture(scope="module")
def store():
    """Return rosbags' own types of ROS 2 Jazzy, and those that it does not have, from our definitions."""
    store = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    for kind in (ACTION_UNITS, EXPRESSION, AUDIO):
        found = rosbags.get_types_from_msg(schema_text(kind), kind)
        store.register({name: each for name, each in found.items() if name not in store.types})
    return store


def theirs(store, kind, message):
    """Return rosbags' object of a message, made from the same values."""

    def field(name, part, size):
        value = message.get(name)
        if size is None:
            missing = "" if part == "string" else 0
            return theirs(store, part, value or {}) if "/" in part else value or missing
        if "/" in part or part == "string":
            return [theirs(store, part, each) if "/" in part else each for each in value or ()]
        return np.array(() if value is None else list(value), part)

    return store.types[kind](*(field(*each) for each in fields_of(kind)))


@pytest.mark.parametrize(("kind", "message"), MESSAGES.values(), ids=MESSAGES)
def test_a_message_is_byte_for_byte_what_rosbags_writes_and_is_read_back_whole(store, kind, message):
    data = to_cdr(kind, message)
    assert data == bytes(store.serialize_cdr(theirs(store, kind, message), kind, little_endian=True))
    assert data == to_cdr(kind, from_cdr(kind, data))


@pytest.mark.parametrize("kind", sorted({kind for kind, _ in MESSAGES.values()}))
def test_the_hash_of_a_type_is_the_one_that_rosbags_computes(store, kind):
    assert type_hash(kind) == store.hash_rihs01(kind)


@pytest.mark.parametrize(("kind", "message"), MESSAGES.values(), ids=MESSAGES)
def test_a_message_that_is_cut_off_anywhere_is_refused_in_one_line(kind, message):
    data = to_cdr(kind, message)
    for length in range(len(data)):
        with pytest.raises(PacketError, match=rf"^{kind}: .*expected .*, got .*$"):
            from_cdr(kind, data[:length])


def lying(kind, count):
    return to_cdr(kind, {})[:-4] + struct.pack("<I", count)


@pytest.mark.parametrize(
    ("kind", "data", "problem"),
    [
        (STRING, b"\0\0\0\0\0\0\0\1\0", "expected CDR, little-endian .00 01 00 00., got 00 00 00 00"),
        (STRING, b'{"data": 1}', "got 7b 22 64 61"),
        (STRING, b"", "got nothing"),
        (STRING, b"\0\1\0\0\xff\xff\xff\xffa\0", "data: expected 4294967295 bytes, got 2"),
        (STRING, to_cdr(STRING, {"data": "ab"}) + b"more", "expected 11 bytes, got 4 more"),
        (AUDIO, lying(AUDIO, 2**31), "data: expected 2147483648 bytes, got 0"),
        (JOINT_STATE, lying(JOINT_STATE, 2**30), "effort: expected 8589934592 bytes, got 0"),
        (DIAGNOSTICS, lying(DIAGNOSTICS, 2**24), "status: expected 16777216 items, got 0 bytes"),
    ],
)
def test_bytes_that_are_not_the_message_and_counts_that_lie_are_refused_in_one_line(kind, data, problem):
    with pytest.raises(PacketError, match=f"^{kind}: .*{problem}"):
        from_cdr(kind, data)


def test_a_face_goes_to_action_units_and_back_by_one_table():
    face = np.zeros(58, np.float32)
    for place, name in enumerate(("mouthSmileLeft", "mouthSmileRight", "jawOpen", "browInnerUp", "eyeLookUpLeft")):
        face[CHANNEL_INDEX[name]] = 0.1 + 0.2 * place
    face[CHANNEL_INDEX["mouthSmileRight"]], face[CHANNEL_INDEX["eyeLookUpRight"]] = 0.1, 0.9
    face[POSE][:3] = 0.25, -0.125, 0.5
    units = units_of(face)
    assert units["intensity"][[12, 26, 1, 63]] == pytest.approx([0.1, 0.5, 0.7, 0.9])
    assert units["intensity"][51:57] == pytest.approx(np.array([0.5, 0, 0.125, 0, 0, 0.25]) * 4 / np.pi)
    assert (units["confidence"] > 0).sum() == 34 and not units["intensity"][units["confidence"] == 0].any()
    np.testing.assert_allclose(face_of(from_cdr(ACTION_UNITS, to_cdr(ACTION_UNITS, units))), face, atol=1e-6)
    lost = {
        name for name in BLENDSHAPES if not face_of(units_of(np.eye(58, dtype=np.float32)[CHANNEL_INDEX[name]])).any()
    }
    assert lost == {"jawLeft", "jawRight", "mouthClose", "mouthLeft", "mouthRight", "mouthShrugUpper"}


def test_units_that_were_not_detected_are_no_face():
    units = {"intensity": np.full(99, np.nan, np.float32), "confidence": np.zeros(99, np.float32)}
    assert not face_of(units).any()
    units["confidence"][12] = 0.9
    assert np.isnan(face_of(units)).sum() == 2
