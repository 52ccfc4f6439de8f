"""Messages between a robot and the programs it works with: values in, bytes out, and back. Opens no socket.

A message that begins with "{" is JSON (UTF-8), any other is binary, little-endian:

    uint8    kind: 1 voice, 2 face, 3 speech to the robot; 4 microphone from it
    uint8    version, 1
    uint16   0
    uint32   samples a second; 0 for a face
    float64  sent [s]: when it was sent, by the sender's clock, whatever its origin
    float64  at [s]: by the same clock, when its newest sample was heard, the face was seen, or the first sample of
             speech will be played; 0: as it arrives, speech behind what still waits
    rest     int16 mono PCM; of a face 58 float32 (pose 6, blendshapes 52) or 59 (attention), or nothing: it is lost

A WebSocket carries one message in each of its own. Over TCP each goes behind its length, uint32. docs/protocol.md
says it for people who write the other side.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import PacketError
from sfms_robot.frames import MOTION_DIM, Floats
from sfms_robot.signals.audio import HIGHEST_RATE_HZ, LOWEST_RATE_HZ

VERSION: Final = 1
VOICE, FACE, SPEECH, MICROPHONE = 1, 2, 3, 4
FEEDS: Final = {"voice": VOICE, "face": FACE, "speech": SPEECH}
WANTS: Final = ("microphone", "events")
LONGEST: Final = 262_144  # bytes: 2.7 s at 48 kHz
LONGEST_JSON: Final = 4096

_HEADER: Final = struct.Struct("<BBHIdd")
_LENGTH: Final = struct.Struct("<I")
_LONGEST_NAME: Final = 64


@dataclass(frozen=True)
class Hello:
    """The first message: what a program will send, and what it wants to be sent. `name` is what logs call it."""

    feeds: frozenset[str]
    wants: frozenset[str]
    token: str
    name: str


@dataclass(frozen=True)
class Hush:
    """The robot's remaining speech will not be played."""

    kind: ClassVar[int] = SPEECH


@dataclass(frozen=True)
class Sound:
    """Voice, speech or microphone, by `kind`. `samples` (n,) int16; times in seconds of the sender, `at_s` 0: none."""

    kind: int
    rate_hz: int
    sent_s: float
    at_s: float
    samples: NDArray[np.int16]


@dataclass(frozen=True)
class Seen:
    """A person's face, motion (58,), None: lost; times as of `Sound`."""

    kind: ClassVar[int] = FACE
    sent_s: float
    at_s: float
    motion: Floats | None
    attention: float | None = None


Message = Hello | Hush | Sound | Seen


def parse_message(data: bytes) -> Message:
    """What a program sent. Raises PacketError, in one line, for everything else than a whole message."""
    if len(data) > LONGEST:
        raise PacketError(f"a message of more than {LONGEST} bytes")
    if data[:1] == b"{":
        return _parse_json(data)
    if len(data) < _HEADER.size:
        raise PacketError(f"a message of {len(data)} bytes, shorter than a header")
    kind, version, zero, rate_hz, sent_s, at_s = _HEADER.unpack_from(data)
    if version != VERSION:
        raise PacketError(f"a message of version {version}, not {VERSION}")
    if kind not in FEEDS.values() or zero:
        raise PacketError(f"a message of kind {kind}, which a robot is not sent ({', '.join(FEEDS)})")
    if not (math.isfinite(sent_s) and math.isfinite(at_s)):
        raise PacketError("a time that is not finite")
    if at_s and not sent_s:
        raise PacketError("a time without the time of sending")
    rest = data[_HEADER.size :]
    return _face(rest, sent_s, at_s) if kind == FACE else _sound(kind, rate_hz, rest, sent_s, at_s)


def sound_message(kind: int, rate_hz: int, sent_s: float, at_s: float, samples: NDArray[np.int16]) -> bytes:
    """`samples` (n,) as a message of that kind."""
    return _HEADER.pack(kind, VERSION, 0, rate_hz, sent_s, at_s) + samples.astype("<i2").tobytes()


def face_message(sent_s: float, at_s: float, motion: Floats | None, attention: float | None = None) -> bytes:
    """A face (58,), None: it is lost."""
    values = [] if motion is None else [*motion, *([] if attention is None else [attention])]
    return _HEADER.pack(FACE, VERSION, 0, 0, sent_s, at_s) + np.array(values, dtype="<f4").tobytes()


def json_message(**values: Any) -> bytes:
    """As JSON, for what is told in words."""
    return json.dumps(values, allow_nan=False).encode()


def framed(message: bytes) -> bytes:
    """A message as it goes over TCP."""
    return _LENGTH.pack(len(message)) + message


class MessageBuffer:
    """Bytes of a TCP stream in, whole messages out."""

    def __init__(self) -> None:
        self._data = bytearray()

    def push(self, data: bytes) -> Iterator[bytes]:
        """Messages that are whole now. Raises PacketError for a length that none has: nothing after it can be read."""
        self._data += data
        while len(self._data) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._data)
            if not 0 < length <= LONGEST:
                raise PacketError(f"a message of {length} bytes (1 to {LONGEST})")
            end = _LENGTH.size + length
            if len(self._data) < end:
                return
            message = bytes(self._data[_LENGTH.size : end])
            del self._data[:end]
            yield message


def _parse_json(data: bytes) -> Message:
    if len(data) > LONGEST_JSON:
        raise PacketError(f"JSON of more than {LONGEST_JSON} bytes")
    try:
        told = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise PacketError("JSON that cannot be read") from error
    kind = told.get("type")
    if kind == "hush":
        return Hush()
    if kind != "hello":
        raise PacketError("JSON of a type that a robot is not sent (hello, hush)")
    if told.get("version") != VERSION:
        raise PacketError(f"hello: version is not {VERSION}")
    return Hello(_names(told, "feeds", FEEDS), _names(told, "wants", WANTS), _text(told, "token"), _text(told, "name"))


def _names(told: Mapping[str, Any], key: str, choices: Mapping[str, int] | tuple[str, ...]) -> frozenset[str]:
    given = told.get(key, [])
    if not isinstance(given, list) or not all(isinstance(each, str) and each in choices for each in given):
        raise PacketError(f"hello: {key} is no list of {', '.join(choices)}")
    return frozenset(given)


def _text(told: Mapping[str, Any], key: str) -> str:
    given = told.get(key, "")
    if not isinstance(given, str) or len(given) > _LONGEST_NAME or not given.isprintable():
        raise PacketError(f"hello: {key} is no text of up to {_LONGEST_NAME} characters")
    return given


def _sound(kind: int, rate_hz: int, rest: bytes, sent_s: float, at_s: float) -> Sound:
    if not LOWEST_RATE_HZ <= rate_hz <= HIGHEST_RATE_HZ:
        raise PacketError(f"sound of {rate_hz} samples a second ({LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ})")
    if len(rest) % 2:
        raise PacketError("sound that is not of 16-bit samples")
    return Sound(kind, rate_hz, sent_s, at_s, np.frombuffer(rest, dtype="<i2").astype(np.int16))


def _face(rest: bytes, sent_s: float, at_s: float) -> Seen:
    if not rest:
        return Seen(sent_s, at_s, None)
    if len(rest) not in (4 * MOTION_DIM, 4 * MOTION_DIM + 4):
        raise PacketError(f"a face of {len(rest)} bytes, not of {MOTION_DIM} or {MOTION_DIM + 1} float32")
    values = np.frombuffer(rest, dtype="<f4").astype(np.float32)
    if not np.isfinite(values).all():
        raise PacketError("a face with values that are not finite")
    attention = float(values[MOTION_DIM]) if len(values) > MOTION_DIM else None
    return Seen(sent_s, at_s, values[:MOTION_DIM], attention)
