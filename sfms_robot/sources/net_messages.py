"""Messages between a robot and other programs: values to bytes and back. Opens no socket.

A message that begins with "{" is JSON (UTF-8), any other is binary, little-endian:

    uint8    kind: 1 voice, 2 face, 3 speech to the robot; 4 microphone from it
    uint8    version, 1
    uint16   0
    uint32   samples a second; 0 for a face
    float64  sent [s]: time of sending, by the sender's clock, which may have any origin
    float64  at [s]: by the same clock, when its newest sample was heard, the face was seen, or the first sample of
             speech will be played; 0: on arrival, speech after the speech that still waits
    rest     int16 mono PCM; for a face 58 float32 (pose 6, blendshapes 52), 59 (attention), or no data: it is lost

Each WebSocket message carries one message. Over TCP each message follows its length, uint32.
docs/reference/protocol.md describes the protocol for authors of other programs.
"""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from sfms_robot.config.base import PRINTABLE, one_line
from sfms_robot.errors import PacketError
from sfms_robot.frames import MOTION_DIM, Floats
from sfms_robot.signals.audio import HIGHEST_RATE_HZ, LOWEST_RATE_HZ
from sfms_robot.signals.face_units import beyond

VERSION: Final = 1
VOICE, FACE, SPEECH, MICROPHONE = 1, 2, 3, 4
FEEDS: Final = {VOICE: "voice", FACE: "face", SPEECH: "speech"}
LONGEST: Final = 1_048_576  # bytes: 21.8 s at 24 kHz
LONGEST_JSON: Final = 4096
_WINDOW_S: Final = 10.0  # length of a window of a clock's offsets; two windows are remembered
_SET_S: Final = 1.0  # if a message took this much longer than the quickest, the sender's clock was set

_HEADER: Final = struct.Struct("<BBHIdd")
_SOUND_IS: Final = "sound comes in binary messages, int16 behind a header of 24 bytes (docs/reference/protocol.md)"
_REALTIME: Final = re.compile(rb'"type"\s*:\s*"((?:session|input_audio_buffer|conversation|response)\.[\w.]+)"')
# First bytes of files, and the files' names in errors.
_FILES: Final = {b"RIFF": "a WAV file", b"OggS": "an Ogg file", b"fLaC": "a FLAC file", b"ID3\x04": "an MP3 file"}


_Text = Annotated[str, Field(max_length=64), PRINTABLE]


class Hello(BaseModel):
    """The first message of a program: which feeds it sends and what it wants to receive. `name`: its name in logs."""

    type: Literal["hello"]
    version: Literal[1]
    feeds: frozenset[Literal["voice", "face", "speech"]] = frozenset()
    wants: frozenset[Literal["microphone", "events"]] = frozenset()
    token: _Text = ""
    name: _Text = ""


class Hush(BaseModel):
    """A message that drops the robot's remaining speech, which will not be played."""

    feed: ClassVar[str] = "speech"
    type: Literal["hush"]


@dataclass(frozen=True, kw_only=True)
class SoundMessage:
    """Voice or speech, by `feed`. `samples` (n,) int16; times in seconds of the sender's clock, `at_s` 0: not set."""

    feed: str
    rate_hz: int
    sent_s: float
    at_s: float
    samples: NDArray[np.int16]


@dataclass(frozen=True)
class SeenMessage:
    """A person's face, motion (58,), or None: it is lost. Times as in `SoundMessage`."""

    feed: ClassVar[str] = "face"
    sent_s: float
    at_s: float
    motion: Floats | None
    attention: float | None = None


Message = Hello | Hush | SoundMessage | SeenMessage
_JSON: Final[TypeAdapter[Hello | Hush]] = TypeAdapter(Annotated[Hello | Hush, Field(discriminator="type")])


def parse_message(data: bytes) -> Message:
    """Parse a message from a program. Raises PacketError, in one line, for anything but one complete message."""
    if data[:1] == b"{":
        return _json(data)
    if len(data) > LONGEST:
        raise PacketError(f"a message of {len(data)} bytes, more than {LONGEST}: send it in pieces")
    if re.fullmatch(rb"[\t\n\r -~]{4,}", data[:256]):
        raise PacketError(f"a text that is not a JSON object (base64?): {_SOUND_IS}")
    if len(data) < _HEADER.size:
        raise PacketError(f"a message of {len(data)} bytes, shorter than a header")
    kind, version, zero, rate_hz, sent_s, at_s = _HEADER.unpack_from(data)
    feed = FEEDS.get(kind)
    if data[:4] in _FILES or (feed is None) + (version != VERSION) + (zero != 0) > 1:
        raise PacketError(f"{_FILES.get(data[:4], 'no header (raw PCM?)')}: {_SOUND_IS}")
    if version != VERSION:
        raise PacketError(f"a message of version {version}, not {VERSION}")
    if feed is None or zero:
        raise PacketError(f"a message of kind {kind}, which a program does not send ({', '.join(FEEDS.values())})")
    if not (math.isfinite(sent_s) and math.isfinite(at_s)):
        raise PacketError("a time that is not finite")
    if at_s and not sent_s:
        raise PacketError("a time without the time of sending")
    rest = data[_HEADER.size :]
    if kind == FACE:
        return _face(rest, sent_s, at_s)
    if not LOWEST_RATE_HZ <= rate_hz <= HIGHEST_RATE_HZ:
        raise PacketError(f"sound of {rate_hz} samples a second ({LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ})")
    if len(rest) % 2:
        raise PacketError(f"{len(rest)} bytes of sound, not of 16-bit samples")
    if rest[:4] in _FILES:
        raise PacketError(f"{_FILES[rest[:4]]} behind the header: send its samples alone")
    samples = np.frombuffer(rest, dtype="<i2").astype(np.int16)
    return SoundMessage(feed=feed, rate_hz=rate_hz, sent_s=sent_s, at_s=at_s, samples=samples)


def _json(data: bytes) -> Hello | Hush:
    if found := _REALTIME.search(data[:LONGEST_JSON]):
        event = found[1].decode()
        raise PacketError(f"{event!r} is an event of the OpenAI Realtime API, which is not supported: {_SOUND_IS}")
    if len(data) > LONGEST_JSON:
        raise PacketError(f"JSON of more than {LONGEST_JSON} bytes: {_SOUND_IS}")
    try:
        return _JSON.validate_json(data)
    except ValidationError as error:
        raise PacketError(" ".join(one_line(error.errors()[0]).split())) from None


def _face(rest: bytes, sent_s: float, at_s: float) -> SeenMessage:
    if not rest:
        return SeenMessage(sent_s, at_s, None)
    if len(rest) not in (4 * MOTION_DIM, 4 * MOTION_DIM + 4):
        raise PacketError(f"a face of {len(rest)} bytes, not of {MOTION_DIM} or {MOTION_DIM + 1} float32")
    values = np.frombuffer(rest, dtype="<f4").astype(np.float32)
    if not np.isfinite(values).all():
        raise PacketError("a face with values that are not finite")
    if (wrong := beyond(values[:MOTION_DIM])) is not None:
        raise PacketError(f"a face left out: {wrong}")
    attention = float(values[MOTION_DIM]) if len(values) > MOTION_DIM else None
    return SeenMessage(sent_s, at_s, values[:MOTION_DIM], attention)


def sound_message(kind: int, rate_hz: int, sent_s: float, at_s: float, samples: NDArray[np.int16]) -> bytes:
    """Return `samples` (n,) as a message of the given kind."""
    return _HEADER.pack(kind, VERSION, 0, rate_hz, sent_s, at_s) + samples.astype("<i2").tobytes()


def json_message(**values: Any) -> bytes:
    """Return a JSON message."""
    return json.dumps(values, allow_nan=False).encode()


@dataclass
class SenderClock:
    """Conversion from the clock of a sending program to ours.

    Every message has its time of sending, by a clock of any origin. The message of the last seconds that took the least
    time determines the offset of that clock: its delay counts as zero. So a converted time is late by the shortest
    delay and never early, and a drifting clock is followed. Keeps the least `arrived - sent` of two windows.
    """

    _began_s: float = 0.0
    _now_least: float | None = None
    _last_least: float | None = None

    def observe(self, sent_s: float, arrived_s: float) -> None:
        """Update the offset by a message that arrived at `arrived_s` of `time.monotonic`."""
        took = arrived_s - sent_s
        if self._now_least is None or took > self.offset_s + _SET_S:
            self._began_s, self._now_least, self._last_least = arrived_s, took, None
        elif arrived_s - self._began_s > _WINDOW_S:
            self._began_s, self._last_least, self._now_least = arrived_s, self._now_least, took
        else:
            self._now_least = min(self._now_least, took)

    @property
    def offset_s(self) -> float:
        """Seconds to add to a time of the sender; 0 before the first message."""
        known = [each for each in (self._now_least, self._last_least) if each is not None]
        return min(known, default=0.0)
