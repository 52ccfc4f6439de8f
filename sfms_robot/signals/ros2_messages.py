"""The messages of ROS 2 that this program exchanges: definitions, type hashes, CDR, and faces as action units.

The definitions are the fields of the `.msg` files without constants and comments, which are not part of the hash:

    builtin_interfaces      github.com/ros2/rcl_interfaces, Apache-2.0
    std_msgs, sensor_msgs, geometry_msgs, diagnostic_msgs
                            github.com/ros2/common_interfaces c0c0bc5, Apache-2.0
    hri_msgs                github.com/ros4hri/hri_msgs 4e7c176 (2.0.0, BSD-3-Clause; Apache-2.0 since 2.3)
    audio_common_msgs       github.com/ros-drivers/audio_common 06c280a, BSD-3-Clause

CDR (OMG formal/02-06-51, as plain XCDR1): four bytes 00 01 00 00, then the fields in order, little-endian. A number
begins at a multiple of its size, counted from the end of the four bytes. A text is its length including the final 0,
then the text and the 0; a list is a count, then the items. An empty list of 8-byte numbers has no padding.

A message is a dictionary by field name; missing fields are 0, empty, or a message of such fields.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import PacketError
from sfms_robot.frames import CHANNEL_INDEX, NEUTRAL, Floats
from sfms_robot.signals.face_tables import SHAPES_OF_UNIT

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
ACTION_UNITS: Final = "hri_msgs/msg/FacialActionUnits"
EXPRESSION: Final = "hri_msgs/msg/Expression"
STRING: Final = "std_msgs/msg/String"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
AUDIO: Final = "audio_common_msgs/msg/AudioDataStamped"
POINT: Final = "geometry_msgs/msg/PointStamped"

# Topics that a run publishes in ROS's own types, live and in recordings, and their types.
TYPED_TOPICS: Final[Mapping[str, str]] = {
    "/joint_states": JOINT_STATE,
    "/robot_face/action_units": ACTION_UNITS,
    "/robot_face/expression": EXPRESSION,
    "/diagnostics": DIAGNOSTICS,
}
NO_HASH: Final = "TypeHashNotSupported"

_RULE: Final = "=" * 80  # between the definitions of an MCAP schema `ros2msg`
_DEFINITIONS: Final = """
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec

MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id

MSG: std_msgs/String
string data

MSG: sensor_msgs/JointState
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort

MSG: hri_msgs/FacialActionUnits
std_msgs/Header header
float32[99] intensity
float32[99] confidence

MSG: hri_msgs/Expression
std_msgs/Header header
string expression
float32 valence
float32 arousal
float32 confidence

MSG: diagnostic_msgs/KeyValue
string key
string value

MSG: diagnostic_msgs/DiagnosticStatus
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values

MSG: diagnostic_msgs/DiagnosticArray
std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status

MSG: audio_common_msgs/AudioData
uint8[] data

MSG: audio_common_msgs/AudioDataStamped
std_msgs/Header header
audio_common_msgs/AudioData audio

MSG: geometry_msgs/Point
float64 x
float64 y
float64 z

MSG: geometry_msgs/PointStamped
std_msgs/Header header
geometry_msgs/Point point
"""
# numpy's type and REP 2016's number of each primitive type; a text has the number 17, a message 1.
_NUMBERS: Final[Mapping[str, tuple[str, int]]] = {
    "uint8": ("u1", 3),
    "int32": ("<i4", 6),
    "uint32": ("<u4", 7),
    "float32": ("<f4", 10),
    "float64": ("<f8", 11),
    "byte": ("u1", 16),
}
_TEXT: Final = "string"
_BEGIN: Final = b"\x00\x01\x00\x00"
_LEAST_TEXT: Final = 4  # bytes of the shortest text
_PADDING: Final = 3  # bytes that some writers add at the end

Message = dict[str, Any]


class MessageField(NamedTuple):
    """One field of a message. `size`: None for a single value, 0 for a list of any length."""

    name: str
    part: str
    size: int | None


@cache
def _texts() -> Mapping[str, str]:
    """Return the definition of each message by its full name."""
    parts = (each.strip().partition("\n") for each in _DEFINITIONS.split("MSG: ")[1:])
    return {_full(head): body + "\n" for head, _, body in parts}


def _full(short: str) -> str:
    return "/msg/".join(short.split("/"))


@cache
def fields_of(kind: str) -> tuple[MessageField, ...]:
    """Return the fields of a message by its full name."""
    found = []
    for line in _texts()[kind].splitlines():
        part, name = line.split()
        part, listed, count = part.partition("[")
        found.append(MessageField(name, _full(part), int(count[:-1] or 0) if listed else None))
    return tuple(found)


@cache
def _inner(kind: str) -> tuple[str, ...]:
    """Return the messages inside a message, at any depth, each once, in order of their names."""
    parts = {field.part for field in fields_of(kind) if field.part in _texts()}
    return tuple(sorted(parts.union(*map(_inner, parts))))


def schema_text(kind: str) -> str:
    """Return the definition of a message and of those inside it, in the format of an MCAP schema `ros2msg`."""
    inner = (f"{_RULE}\nMSG: {name.replace('/msg/', '/')}\n{_texts()[name]}" for name in _inner(kind))
    return _texts()[kind] + "".join(inner)


@cache
def type_hash(kind: str) -> str:
    """Return RIHS01, the hash of a message's definition (REP 2016)."""
    inner = [_description(name) for name in _inner(kind)]
    text = json.dumps({"type_description": _description(kind), "referenced_type_descriptions": inner})
    return f"RIHS01_{sha256(text.encode()).hexdigest()}"


def _description(kind: str) -> Message:
    fields = []
    for name, part, count in fields_of(kind):
        number = 17 if part == _TEXT else _NUMBERS[part][1] if part in _NUMBERS else 1
        number += 0 if count is None else 48 if count else 144  # an array, a list
        nested = part if part in _texts() else ""
        sort = {"type_id": number, "capacity": count or 0, "string_capacity": 0, "nested_type_name": nested}
        fields.append({"name": name, "type": sort})
    return {"type_name": kind, "fields": fields}


def wire_name(kind: str, hashed: bool = True) -> str:
    """Return type and hash in the form of the keys of rmw_zenoh; ROS 2 Humble has no hashes."""
    return f"{kind.replace('/msg/', '::msg::dds_::')}_/{type_hash(kind) if hashed else NO_HASH}"


def read_message(kind: str, wire: str, data: bytes) -> Message:
    """Parse a message of this kind. Raises PacketError for another type or hash, and as `from_cdr`."""
    sort, _, found = wire.partition("/")
    if not wire_name(kind).startswith(f"{sort}/"):
        raise PacketError(f"expected {kind}, got {sort.replace('::msg::dds_::', '/msg/').rstrip('_')}")
    if found not in (type_hash(kind), NO_HASH):
        raise PacketError(f"{kind}: expected {type_hash(kind)}, got {found}: another version of the message")
    return from_cdr(kind, data)


# --- CDR --------------------------------------------------------------------------------------------------------------


def to_cdr(kind: str, message: Message) -> bytes:
    """Return a message as CDR. Raises ValueError for an array of the wrong length."""
    out = bytearray()
    _write(out, kind, message)
    return _BEGIN + bytes(out)


def _write(out: bytearray, kind: str, message: Message) -> None:
    for name, part, count in fields_of(kind):
        if count is None:
            _write_one(out, part, message.get(name))
            continue
        items = message.get(name, ())
        if count and len(items) != count:
            raise ValueError(f"{kind}: {name}: expected {count} items, got {len(items)}")
        if not count:
            _write_numbers(out, "<u4", [len(items)])
        if part not in _NUMBERS:
            for item in items:
                _write_one(out, part, item)
        elif len(items):
            _write_numbers(out, _NUMBERS[part][0], items)


def _write_one(out: bytearray, part: str, value: Any) -> None:
    if part in _NUMBERS:
        _write_numbers(out, _NUMBERS[part][0], [value or 0])
    elif part == _TEXT:
        text = (value or "").encode() + b"\0"
        _write_numbers(out, "<u4", [len(text)])
        out += text
    else:
        _write(out, part, value or {})


def _write_numbers(out: bytearray, dtype: str, values: Any) -> None:
    numbers = np.frombuffer(values, dtype) if isinstance(values, bytes) else np.asarray(values, dtype)
    out += bytes(-len(out) % numbers.itemsize) + numbers.tobytes()


def from_cdr(kind: str, data: bytes) -> Message:
    """Parse a message in CDR; lists of numbers become arrays. Raises PacketError, in one line, for other bytes.

    A count that needs more bytes than there are is refused.
    """
    if data[: len(_BEGIN)] != _BEGIN:
        raise PacketError(
            f"{kind}: expected CDR, little-endian ({_BEGIN.hex(' ')}), got {data[:4].hex(' ') or 'nothing'}"
        )
    reader = CdrReader(kind, memoryview(data)[len(_BEGIN) :])
    message = reader.message(kind)
    if (left := len(reader.data) - reader.at) > _PADDING:
        raise PacketError(f"{kind}: expected {reader.at + len(_BEGIN)} bytes, got {left} more")
    return message


@dataclass
class CdrReader:
    """A reader with a position in the bytes of a message after the first four."""

    kind: str
    data: memoryview
    at: int = 0

    def message(self, kind: str) -> Message:
        return {name: self._value(name, part, count) for name, part, count in fields_of(kind)}

    def _value(self, name: str, part: str, count: int | None) -> Any:
        if count is None:
            return self._one(name, part)
        if not count:
            count = self._count(name)
        if part in _NUMBERS:
            return self._numbers(name, _NUMBERS[part][0], count)
        if count * _LEAST_TEXT > len(self.data) - self.at:  # items are texts, or messages that contain a text
            raise PacketError(f"{self.kind}: {name}: expected {count} items, got {len(self.data) - self.at} bytes")
        return [self._one(name, part) for _ in range(count)]

    def _one(self, name: str, part: str) -> Any:
        if part in _NUMBERS:
            return self._numbers(name, _NUMBERS[part][0], 1)[0].item()
        if part != _TEXT:
            return self.message(part)
        return self._numbers(name, "u1", self._count(name)).tobytes().rstrip(b"\0").decode("utf-8", "replace")

    def _count(self, name: str) -> int:
        return int(self._numbers(name, "<u4", 1)[0])

    def _numbers(self, name: str, dtype: str, count: int) -> NDArray[Any]:
        size = np.dtype(dtype).itemsize
        begin = self.at + (-self.at % size if count else 0)
        if begin + size * count > len(self.data):
            raise PacketError(
                f"{self.kind}: {name}: expected {size * count} bytes, got {max(0, len(self.data) - begin)}"
            )
        self.at = begin + size * count
        return np.frombuffer(self.data[begin : self.at], dtype)


def header(time_s: float, frame: str = "") -> Message:
    """Return a `std_msgs/Header` of a time in seconds."""
    whole, part = divmod(time_s, 1.0)
    return {"stamp": {"sec": int(whole), "nanosec": min(round(part * 1e9), 999_999_999)}, "frame_id": frame}


_LEVELS: Final = {"degraded": 1, "halted": 1, "fault": 2}  # WARN, ERROR; 0 is OK


def diagnostics(head: Message, state: str, values: Mapping[str, Any]) -> Message:
    """Return the state of a run and its figures as a DiagnosticArray."""
    pairs = [{"key": key, "value": str(value)} for key, value in values.items()]
    status = {"level": _LEVELS.get(state, 0), "name": "sfms_robot: run", "message": state, "values": pairs}
    return {"header": head, "status": [status]}


# --- Faces as action units --------------------------------------------------------------------------------------------

UNITS: Final = 99
HEAD_FULL_RAD: Final = math.pi / 4  # our choice: FACS gives no angle for a unit of full intensity
# Units of the head for the positive and the negative direction of a channel.
_HEAD_UNITS: Final = {"yaw": (51, 52), "pitch": (54, 53), "roll": (56, 55)}
_PLACES: Final = {unit: [CHANNEL_INDEX[name] for name in names] for unit, names in SHAPES_OF_UNIT.items()}
_KNOWN: Final = [*_PLACES, *(unit for both in _HEAD_UNITS.values() for unit in both)]


def units_of(motion: Floats) -> Message:
    """Return intensity and confidence (99,) of the action units of a face (58,), 0..1; the stronger side counts.

    The confidence is 1 for units that this program computes, else 0: not detected.
    """
    intensity, confidence = np.zeros((2, UNITS), np.float32)
    for unit, places in _PLACES.items():
        intensity[unit] = motion[places].max()
    for channel, (positive, negative) in _HEAD_UNITS.items():
        turn = float(motion[CHANNEL_INDEX[channel]]) / HEAD_FULL_RAD
        intensity[positive], intensity[negative] = max(turn, 0.0), max(-turn, 0.0)
    confidence[_KNOWN] = 1.0
    return {"intensity": np.clip(intensity, 0.0, 1.0), "confidence": confidence}


def face_of(message: Message) -> Floats:
    """Return the face (58,) of action units whose confidence is above 0; values that are not finite stay so."""
    motion = NEUTRAL.copy()
    intensity = np.where(message["confidence"] > 0, message["intensity"], np.float32(0))
    for unit, places in _PLACES.items():
        motion[places] = np.maximum(motion[places], intensity[unit])
    for channel, (positive, negative) in _HEAD_UNITS.items():
        motion[CHANNEL_INDEX[channel]] = (intensity[positive] - intensity[negative]) * HEAD_FULL_RAD
    return motion


_SHOWN: Final = 0.25  # mean intensity of its units from which on an expression is named
# Units of each expression (EMFACS), and its valence and arousal (Russell 1980; rounded).
_EXPRESSIONS: Final[Mapping[str, tuple[tuple[int, ...], float, float]]] = {
    "happy": ((12,), 0.8, 0.4),
    "surprised": ((1, 2, 5, 26), 0.2, 0.8),
    "sad": ((1, 15), -0.7, -0.4),
    "angry": ((4, 7, 24), -0.6, 0.7),
    "disgusted": ((9, 10), -0.7, 0.3),
    "scared": ((1, 4, 5, 20), -0.6, 0.7),
}


def expression_of(intensity: Floats) -> Message:
    """Return the expression nearest to action units (99,), "neutral" if none is strong."""
    scores = {name: float(intensity[list(units)].mean()) for name, (units, _, _) in _EXPRESSIONS.items()}
    name = max(scores, key=lambda each: scores[each])
    score = scores[name]
    if score < _SHOWN:
        return {"expression": "neutral", "confidence": 1.0 - score}
    _, valence, arousal = _EXPRESSIONS[name]
    return {"expression": name, "valence": score * valence, "arousal": score * arousal, "confidence": score}
