"""Messages between a robot and a server of listeners: values in, bytes out, and back. Opens no socket.

A message that begins with "{" is JSON (UTF-8), any other is binary, little-endian; docs/guide/remote.md lists the route
of each.

    frame      uint8    kind, 1
               uint8    protocol, 1
               uint16   flags: 1 face, 2 jaw, 4 the robot's own voice, 8 attention, 16 place
               uint32   number: index of the frame in loop time, frame 0 ends at 0.04 s
               float64  time [s]: SpeakerFrame.time_s, loop time
               float64  sent [s]: by the robot's clock
               float64  sent [s]: the same instant by the server's clock, as estimated by the robot; NaN: unknown yet
               uint16   samples of audio, uint16 samples of own voice; int16 PCM of both, 16 kHz
               float64  time of the face, 58 float32 (pose 6, blendshapes 52); 3 float32 jaw; float64 attention;
                        3 float32 place: each only if its flag is set

    plan       uint8    kind, 2
               uint8    protocol, 1
               uint16   flags: 2 jaw
               uint32   number of the frame that it answers
               float64  that frame's `sent`, by the robot's clock
               float64  time when that frame came, and float64 time when this plan was sent, by the server's clock
               float32  duration of the step [ms]
               uint16   frames H of the plan, uint16 bytes of JSON
               float64  made at; H float64 times, loop time; H x 58 float32, H x 3 float32 jaw only if its flag is set
               JSON     {"events": [...], "hazards_hz": {...}}: also the events of the two plans before, since a plan
                        may be lost

Sound has the resolution of a sound card: 65,536 steps, at most 1.0. All other values arrive bit for bit.
"""

from __future__ import annotations

import math
import struct
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Final, Literal

import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as validated

from sfms_robot import __version__
from sfms_robot.errors import PacketError
from sfms_robot.frames import (
    AUDIO_HZ,
    CHANNELS,
    EVENT_KINDS,
    FRAME_HZ,
    FRAME_SAMPLES,
    MOTION_DIM,
    Events,
    FaceFrame,
    Floats,
    Plan,
    SpeakerFrame,
)

PROTOCOL: Final = 1
FRAME, PLAN = 1, 2
FACE, JAW, OWN_VOICE, ATTENTION, PLACE = 1, 2, 4, 8, 16
MOST_PLANNED: Final = 256  # most frames of a plan
LONGEST_JSON: Final = 16_384

_START: Final = struct.Struct("<BB")
_FRAME: Final = struct.Struct("<BBHIdddHH")
_PLAN: Final = struct.Struct("<BBHIdddfHH")
_PCM: Final = 32_768.0


# --- Frames -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SentFrame:
    """A sent frame. `sent_s` is by the robot's clock, `server_sent_s` by the server's, NaN if that is unknown."""

    number: int
    frame: SpeakerFrame
    sent_s: float
    server_sent_s: float = math.nan


def frame_message(sent: SentFrame) -> bytes:
    """Return a frame as bytes. Raises nothing: the values of a frame were checked where it was made."""
    frame = sent.frame
    audio, own = _pcm(frame.audio), _pcm(frame.agent_audio)
    flags, parts = 0, [audio, own]
    if frame.face is not None:
        flags |= FACE
        parts += [struct.pack("<d", frame.face.time_s), _floats(frame.face.pose), _floats(frame.face.blendshapes)]
        if frame.face.jaw_rad is not None:
            flags |= JAW
            parts.append(_floats(frame.face.jaw_rad))
    if frame.agent_audio is not None:
        flags |= OWN_VOICE
    if frame.attention is not None:
        flags |= ATTENTION
        parts.append(struct.pack("<d", frame.attention))
    if frame.place_m is not None:
        flags |= PLACE
        parts.append(_floats(frame.place_m))
    times_s = frame.time_s, sent.sent_s, sent.server_sent_s
    header = _FRAME.pack(FRAME, PROTOCOL, flags, sent.number, *times_s, len(audio) // 2, len(own) // 2)
    return b"".join([header, *parts])


def parse_frame(data: bytes) -> SentFrame:
    """Return the frame of a message. Raises PacketError, in one line, unless it is whole and its values are finite."""
    rest = _Reader(data, FRAME, _FRAME, "a frame")
    _, _, flags, number, time_s, sent_s, server_sent_s, samples, own_samples = rest.header
    if samples not in (0, FRAME_SAMPLES) or own_samples not in (0, FRAME_SAMPLES):
        raise PacketError(f"a frame: expected 0 or {FRAME_SAMPLES} samples, got {samples} and {own_samples}")
    if not (math.isfinite(time_s) and math.isfinite(sent_s)) or number >= 1 << 31:
        raise PacketError("a frame: its time is not finite")
    audio, own = (np.asarray(rest.array("<i2", count) / _PCM, np.float32) for count in (samples, own_samples))
    face = attention = place_m = None
    if flags & FACE:
        face_s, motion = rest.number(), rest.array("<f4", MOTION_DIM)
        face = FaceFrame(face_s, motion[:6], motion[6:], rest.array("<f4", 3) if flags & JAW else None)
    if flags & ATTENTION:
        attention = rest.number(finite=False)  # NaN: unknown
    if flags & PLACE:
        place_m = rest.array("<f4", 3)
    rest.end()
    frame = SpeakerFrame(time_s, audio, face, own if flags & OWN_VOICE else None, attention, place_m)
    return SentFrame(number, frame, sent_s, server_sent_s)


# --- Plans ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SentPlan:
    """A sent plan. `echo_s` is the `sent_s` of the frame it answers, `came_s` and `sent_s` by the server's clock."""

    number: int
    plan: Plan
    echo_s: float
    came_s: float
    sent_s: float
    step_ms: float


@validated(frozen=True, config=ConfigDict(allow_inf_nan=False, extra="forbid"))
class Decided:
    """The JSON of a plan: its events and those of plans before, and the hazards [1/s] by kind."""

    events: Events
    hazards_hz: dict[str, float]


_DECIDED: Final = TypeAdapter(Decided)


def plan_message(sent: SentPlan, earlier: Events = ()) -> bytes:
    """Return a plan as bytes. `earlier`: events of earlier plans, which are sent again."""
    plan = sent.plan
    decided = {"events": [asdict(event) for event in (*earlier, *plan.events)], "hazards_hz": dict(plan.hazards_hz)}
    words = orjson.dumps(decided, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS)
    flags, times_s = (0 if plan.jaw_rad is None else JAW), (sent.echo_s, sent.came_s, sent.sent_s)
    header = _PLAN.pack(PLAN, PROTOCOL, flags, sent.number, *times_s, sent.step_ms, len(plan.times_s), len(words))
    times = struct.pack("<d", plan.made_at_s) + np.asarray(plan.times_s, dtype="<f8").tobytes()
    jaw = b"" if plan.jaw_rad is None else _floats(plan.jaw_rad)
    return b"".join([header, times, _floats(plan.frames), jaw, words])


def parse_plan(data: bytes) -> SentPlan:
    """Return the plan of a message. Raises PacketError as `parse_frame`; the loop refuses motion that is not finite."""
    rest = _Reader(data, PLAN, _PLAN, "a plan")
    _, _, flags, number, echo_s, came_s, sent_s, step_ms, frames, words = rest.header
    if not 1 <= frames <= MOST_PLANNED:
        raise PacketError(f"a plan: expected 1 to {MOST_PLANNED} frames, got {frames}")
    made_at_s, times_s = rest.number(), rest.array("<f8", frames)
    motion = rest.array("<f4", frames * MOTION_DIM, finite=False).reshape(frames, MOTION_DIM)
    jaw_rad = rest.array("<f4", frames * 3, finite=False).reshape(frames, 3) if flags & JAW else None
    try:
        decided = _DECIDED.validate_json(rest.bytes(words))
    except ValidationError as error:
        raise PacketError("a plan: its events cannot be read") from error
    rest.end()
    for event in decided.events:
        if event.kind not in EVENT_KINDS:
            raise PacketError(f"a plan: unknown event {event.kind[:20]!r} (valid: {', '.join(EVENT_KINDS)})")
    plan = Plan(made_at_s, times_s, motion, jaw_rad, decided.events, decided.hazards_hz)
    return SentPlan(number=number, plan=plan, echo_s=echo_s, came_s=came_s, sent_s=sent_s, step_ms=step_ms)


# --- Words ------------------------------------------------------------------------------------------------------------


@validated(frozen=True, kw_only=True, config=ConfigDict(extra="ignore"))  # a later protocol may have further keys
class Interface:
    """The properties that both sides must share; `str` returns them as text for people."""

    protocol: int = PROTOCOL
    version: str = __version__
    frame_hz: int = FRAME_HZ
    audio_hz: int = AUDIO_HZ
    motion: str = "arkit58"
    channels: tuple[str, ...]

    def __str__(self) -> str:
        """Return the properties as text."""
        return (
            f"sfms-robot {self.version}, protocol {self.protocol}, {self.frame_hz} frames a second, "
            f"{self.audio_hz} Hz, {self.motion} ({len(self.channels)} channels)"
        )

    def fits(self, other: Interface) -> bool:
        """Return whether both sides are compatible: everything except the program's version must be the same."""
        return replace(self, version="") == replace(other, version="")


OURS: Final = Interface(channels=CHANNELS)
Count = Annotated[int, Field(ge=0, lt=1 << 63)]
_STRICT: Final = ConfigDict(strict=True, extra="forbid")


@validated(frozen=True, config=_STRICT)
class Join:
    """A robot's request for a stream. `client` identifies the robot, `calmness` is `config.Calmness` as a mapping."""

    type: Literal["join"] = field(default="join", kw_only=True)
    client: str
    seed: Count
    calmness: dict[str, Any] | None = None
    interface: Interface = OURS


@validated(frozen=True, kw_only=True, config=_STRICT)
class Welcome:
    """The answer that a stream was begun: its frames go to `stream`. `server` changes when the server is restarted."""

    type: Literal["welcome"] = "welcome"
    stream: str
    server: str
    listener: str
    horizon: Annotated[Count, Field(ge=1)]
    hop: Annotated[Count, Field(ge=1)]
    interface: Interface = OURS


@validated(frozen=True, config=_STRICT)
class Refusal:
    """The answer that no stream was begun, with the reason; `final`: another request cannot help."""

    type: Literal["refusal"] = field(default="refusal", kw_only=True)
    reason: str
    final: bool


@validated(frozen=True, config=_STRICT)
class Notice:
    """A notice of `kind` "unknown" (no such stream, or no longer), "skipped" (`frames` left out), "leave" or "calm"."""

    type: Literal["notice"] = field(default="notice", kw_only=True)
    kind: str
    frames: Count = 0
    calmness: dict[str, Any] | None = None


Words = Join | Welcome | Refusal | Notice
_WORDS: Final[TypeAdapter[Words]] = TypeAdapter(Annotated[Words, Field(discriminator="type")])


def words_message(words: Words) -> bytes:
    """Return words as JSON."""
    return _WORDS.dump_json(words)


def parse_words(data: bytes) -> Words:
    """Return the words of a message. Raises PacketError, in one line, for JSON that `words_message` does not make."""
    if len(data) > LONGEST_JSON:
        raise PacketError(f"JSON of more than {LONGEST_JSON} bytes")
    try:
        return _WORDS.validate_json(data)
    except ValidationError as error:
        raise PacketError("JSON that is not a whole join, welcome, refusal or notice") from error


# --- Bytes ------------------------------------------------------------------------------------------------------------


class _Reader:
    """A reader of the bytes of a message, from front to back. `what` names the message in errors."""

    def __init__(self, data: bytes, kind: int, form: struct.Struct, what: str) -> None:
        self._data, self._at, self._what = data, 0, what
        if len(data) < _START.size:
            raise PacketError(f"{what}: {len(data)} bytes, cut short")
        found, protocol = _START.unpack_from(data)
        if protocol != PROTOCOL:
            raise PacketError(f"{what}: expected protocol {PROTOCOL}, got protocol {protocol}")
        if found != kind:
            raise PacketError(f"{what}: expected a message of kind {kind}, got kind {found}")
        self.header = form.unpack(self.bytes(form.size))

    def bytes(self, count: int) -> bytes:
        end = self._at + count
        if end > len(self._data):
            raise PacketError(f"{self._what}: {len(self._data)} bytes, cut short")
        taken, self._at = self._data[self._at : end], end
        return taken

    def array(self, kind: str, count: int, finite: bool = True) -> NDArray[Any]:
        """Return the next `count` numbers; `kind` is a numpy type, little-endian."""
        values = np.frombuffer(self.bytes(count * np.dtype(kind).itemsize), kind)
        if finite and not np.isfinite(values).all():
            raise PacketError(f"{self._what}: a value is not finite")
        return values.astype(values.dtype.newbyteorder("="))

    def number(self, finite: bool = True) -> float:
        return float(self.array("<f8", 1, finite)[0])

    def end(self) -> None:
        if self._at != len(self._data):
            raise PacketError(f"{self._what}: {len(self._data) - self._at} bytes too many")


def _pcm(samples: Floats | None) -> bytes:
    if samples is None:
        return b""
    return bytes(np.clip(np.rint(samples * np.float32(_PCM)), -_PCM, _PCM - 1).astype("<i2").tobytes())


def _floats(values: Floats) -> bytes:
    return np.asarray(values, dtype="<f4").tobytes()
