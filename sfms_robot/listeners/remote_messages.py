"""What a robot and a server of listeners say to one another: values in, bytes out, and back. Opens no socket.

A message that begins with "{" is JSON (UTF-8), any other is binary, little-endian; docs/remote.md says which goes
where.

    frame      uint8    kind, 1
               uint8    protocol, 1
               uint16   flags: 1 face, 2 jaw, 4 the robot's own voice, 8 attention, 16 place
               uint32   number: index of the frame in loop time, frame 0 ends at 0.04 s
               float64  time [s]: SpeakerFrame.time_s, loop time
               float64  sent [s]: by the robot's clock
               float64  sent [s]: the same instant by the server's clock, as far as the robot knows it; NaN: not yet
               uint16   samples of audio, uint16 samples of own voice; int16 PCM of both, 16 kHz
               float64  time of the face, 58 float32 (pose 6, blendshapes 52); 3 float32 jaw; float64 attention;
                        3 float32 place: each where its flag says so

    plan       uint8    kind, 2
               uint8    protocol, 1
               uint16   flags: 2 jaw
               uint32   number of the frame that it answers
               float64  that frame's `sent`, by the robot's clock
               float64  when that frame came, and float64 when this was sent, by the server's clock
               float32  what the step took [ms]
               uint16   frames H of the plan, uint16 bytes of JSON
               float64  made at; H float64 times, loop time; H x 58 float32, H x 3 float32 jaw where its flag says so
               JSON     {"events": [...], "hazards_hz": {...}}: also the events of the two plans before, since a plan
                        may be lost

Sound is told as a sound card would: in 65,536 steps, at most 1.0. Everything else survives bit for bit.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Final

import numpy as np
import orjson

from sfms_robot import __version__
from sfms_robot.endpoint import whole_number
from sfms_robot.errors import PacketError
from sfms_robot.frames import (
    AUDIO_HZ,
    CHANNELS,
    EVENT_KINDS,
    FRAME_HZ,
    FRAME_SAMPLES,
    MOTION_DIM,
    FaceFrame,
    Floats,
    ListenerEvent,
    Plan,
    SpeakerFrame,
)

PROTOCOL: Final = 1
FRAME, PLAN = 1, 2
FACE, JAW, OWN_VOICE, ATTENTION, PLACE = 1, 2, 4, 8, 16
MOST_PLANNED: Final = 256  # frames of a plan
LONGEST_JSON: Final = 16_384

_START: Final = struct.Struct("<BB")
_FRAME: Final = struct.Struct("<BBHIdddHH")
_PLAN: Final = struct.Struct("<BBHIdddfHH")
_PCM: Final = 32_768.0


@dataclass(frozen=True)
class SentFrame:
    """A frame on its way. `sent_s` by the robot's clock, `server_sent_s` by the server's, NaN where that is unknown."""

    number: int
    frame: SpeakerFrame
    sent_s: float
    server_sent_s: float = math.nan


@dataclass(frozen=True)
class SentPlan:
    """A plan on its way back; `echo_s` is the `sent_s` of the frame it answers, the others by the server's clock."""

    number: int
    plan: Plan
    echo_s: float
    came_s: float
    sent_s: float
    step_ms: float


@dataclass(frozen=True)
class Interface:
    """What both sides must agree on. The text names them to a person."""

    protocol: int = PROTOCOL
    version: str = __version__
    frame_hz: int = FRAME_HZ
    audio_hz: int = AUDIO_HZ
    motion: str = "arkit58"
    channels: tuple[str, ...] = CHANNELS

    def __str__(self) -> str:
        space = f"{self.motion} ({len(self.channels)} channels)"
        return (
            f"sfms-robot {self.version}, protocol {self.protocol}, {self.frame_hz} frames a second, "
            f"{self.audio_hz} Hz, {space}"
        )

    def fits(self, other: Interface) -> bool:
        """Whether they understand one another: all but the version of the program must be the same."""
        return replace(self, version="") == replace(other, version="")


@dataclass(frozen=True)
class Join:
    """A robot asks to be listened for. `client` tells robots apart, `calmness` is `config.Calmness` as a mapping."""

    client: str
    seed: int
    calmness: Mapping[str, Any] | None = None
    interface: Interface = field(default_factory=Interface)


@dataclass(frozen=True)
class Welcome:
    """A stream was begun: its frames go under `stream`. `server` changes when the server is started anew."""

    stream: str
    server: str
    listener: str
    horizon: int
    hop: int
    interface: Interface = field(default_factory=Interface)


@dataclass(frozen=True)
class Refusal:
    """No stream was begun, and why; `final`: asking again cannot help."""

    reason: str
    final: bool


@dataclass(frozen=True)
class Notice:
    """`kind` "unknown": there is no such stream (any more); "skipped": `frames` were left out; "leave", "calm"."""

    kind: str
    frames: int = 0
    calmness: Mapping[str, Any] | None = None


# --- frames ---------------------------------------------------------------------------------------------------------


def frame_message(sent: SentFrame) -> bytes:
    """Raises nothing: what a frame holds was judged where it was made."""
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
    header = _FRAME.pack(
        FRAME, PROTOCOL, flags, sent.number, frame.time_s, sent.sent_s, sent.server_sent_s, len(audio) // 2,
        len(own) // 2,
    )  # fmt: skip
    return b"".join([header, *parts])


def parse_frame(data: bytes) -> SentFrame:
    """Raises PacketError, in one line, for everything else than a whole frame whose values are finite."""
    rest = _checked(data, FRAME, _FRAME, "a frame")
    _, _, flags, number, time_s, sent_s, server_sent_s, samples, own_samples = rest.header
    if samples not in (0, FRAME_SAMPLES) or own_samples not in (0, FRAME_SAMPLES):
        raise PacketError(f"a frame of {samples} and {own_samples} samples (0 or {FRAME_SAMPLES})")
    if not (math.isfinite(time_s) and math.isfinite(sent_s)) or number >= 1 << 31:
        raise PacketError("a frame whose time is not finite")
    audio, own = rest.pcm(samples), rest.pcm(own_samples)
    face = attention = place_m = None
    if flags & FACE:
        face_s, motion = rest.number("<d"), rest.floats(MOTION_DIM)
        face = FaceFrame(face_s, motion[:6], motion[6:], rest.floats(3) if flags & JAW else None)
    if flags & ATTENTION:
        attention = rest.number("<d", finite=False)  # NaN: nobody wrote it down
    if flags & PLACE:
        place_m = rest.floats(3)
    rest.end()
    frame = SpeakerFrame(time_s, audio, face, own if flags & OWN_VOICE else None, attention, place_m)
    return SentFrame(number, frame, sent_s, server_sent_s)


# --- plans ----------------------------------------------------------------------------------------------------------


def plan_message(sent: SentPlan, earlier: tuple[ListenerEvent, ...] = ()) -> bytes:
    """`earlier`: events that plans before have told."""
    plan = sent.plan
    told = {"events": [asdict(event) for event in (*earlier, *plan.events)], "hazards_hz": dict(plan.hazards_hz)}
    words = orjson.dumps(told, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS)
    flags = 0 if plan.jaw_rad is None else JAW
    header = _PLAN.pack(
        PLAN, PROTOCOL, flags, sent.number, sent.echo_s, sent.came_s, sent.sent_s, sent.step_ms, len(plan.times_s),
        len(words),
    )  # fmt: skip
    times = struct.pack("<d", plan.made_at_s) + np.asarray(plan.times_s, dtype="<f8").tobytes()
    jaw = b"" if plan.jaw_rad is None else _floats(plan.jaw_rad)
    return b"".join([header, times, _floats(plan.frames), jaw, words])


def parse_plan(data: bytes) -> SentPlan:
    """Raises PacketError as `parse_frame`; motion that is not finite is the loop's to refuse."""
    rest = _checked(data, PLAN, _PLAN, "a plan")
    _, _, flags, number, echo_s, came_s, sent_s, step_ms, frames, words = rest.header
    if not 1 <= frames <= MOST_PLANNED:
        raise PacketError(f"a plan of {frames} frames (1 to {MOST_PLANNED})")
    made_at_s = rest.number("<d")
    times_s = rest.doubles(frames)
    motion = rest.floats(frames * MOTION_DIM, finite=False).reshape(frames, MOTION_DIM)
    jaw_rad = rest.floats(frames * 3, finite=False).reshape(frames, 3) if flags & JAW else None
    events, hazards_hz = _told(rest.bytes(words))
    rest.end()
    return SentPlan(
        number, Plan(made_at_s, times_s, motion, jaw_rad, events, hazards_hz), echo_s, came_s, sent_s, step_ms
    )


def _told(words: bytes) -> tuple[tuple[ListenerEvent, ...], dict[str, float]]:
    try:
        told = orjson.loads(words)
        events = tuple(_event(each) for each in told["events"])
        return events, {str(kind): float(hz) for kind, hz in told["hazards_hz"].items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise PacketError("a plan whose events cannot be read") from error


def _event(told: Mapping[str, Any]) -> ListenerEvent:
    target = told["target_rad"]
    event = ListenerEvent(**{**told, "target_rad": None if target is None else (float(target[0]), float(target[1]))})
    if event.kind not in EVENT_KINDS or not all(map(math.isfinite, (event.start_s, event.duration_s, event.size))):
        raise PacketError(
            f"an event {str(event.kind)[:20]!r} that a listener does not decide ({', '.join(EVENT_KINDS)})"
        )
    return event


# --- words ----------------------------------------------------------------------------------------------------------


def words_message(said: Join | Welcome | Refusal | Notice) -> bytes:
    """As JSON."""
    return json.dumps({"type": type(said).__name__.lower(), **asdict(said)}, allow_nan=False).encode()


def parse_words(data: bytes) -> Join | Welcome | Refusal | Notice:
    """Raises PacketError, in one line, for everything else than what `words_message` makes."""
    if len(data) > LONGEST_JSON:
        raise PacketError(f"JSON of more than {LONGEST_JSON} bytes")
    try:
        told = json.loads(data, parse_int=whole_number)
        kind = told.pop("type")
        if "interface" in told:
            told["interface"] = _interface(told["interface"])
        said: Join | Welcome | Refusal | Notice = _KINDS[kind](**told)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise PacketError(f"JSON that is none of {', '.join(_KINDS)}") from error
    _check_words(said)
    return said


_KINDS: Final[Mapping[str, Any]] = {"join": Join, "welcome": Welcome, "refusal": Refusal, "notice": Notice}
# Of the fields of all kinds.
_TYPES: Final[Mapping[str, type]] = {
    **dict.fromkeys(("client", "stream", "server", "listener", "reason", "kind"), str),
    **dict.fromkeys(("seed", "horizon", "hop", "frames"), int),
    "final": bool,
}


def _interface(told: Mapping[str, Any]) -> Interface:
    """Keys of a later protocol are left out: it is to be named, not to be understood."""
    known = {each.name: told[each.name] for each in fields(Interface) if each.name in told}
    return Interface(**{**known, "channels": tuple(map(str, known.get("channels", ())))})


def _check_words(said: Join | Welcome | Refusal | Notice) -> None:
    if not all(isinstance(value, _TYPES.get(name, object)) for name, value in vars(said).items()):
        raise PacketError(f"a {type(said).__name__.lower()} with a value of another type")
    if isinstance(said, Join) and said.seed < 0:
        raise PacketError(f"join: seed: expected 0 or more, got {said.seed}")
    calmness = getattr(said, "calmness", None)
    if calmness is not None and not isinstance(calmness, dict):
        raise PacketError("a calmness that is no mapping")


# --- bytes ----------------------------------------------------------------------------------------------------------


class _Rest:
    """What follows a header, taken off its front."""

    def __init__(self, header: tuple[Any, ...], data: bytes, at: int, what: str) -> None:
        self.header, self._data, self._at, self._what = header, data, at, what

    def bytes(self, count: int) -> bytes:
        end = self._at + count
        if end > len(self._data):
            raise PacketError(f"{self._what} of {len(self._data)} bytes, cut short")
        taken, self._at = self._data[self._at : end], end
        return taken

    def number(self, form: str, finite: bool = True) -> float:
        value = float(struct.unpack(form, self.bytes(struct.calcsize(form)))[0])
        if finite and not math.isfinite(value):
            raise PacketError(f"{self._what} with a value that is not finite")
        return value

    def floats(self, count: int, finite: bool = True) -> Floats:
        values = np.frombuffer(self.bytes(4 * count), dtype="<f4").astype(np.float32)
        if finite and not np.isfinite(values).all():
            raise PacketError(f"{self._what} with values that are not finite")
        return values

    def doubles(self, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        values = np.frombuffer(self.bytes(8 * count), dtype="<f8").astype(np.float64)
        if not np.isfinite(values).all():
            raise PacketError(f"{self._what} with times that are not finite")
        return values

    def pcm(self, count: int) -> Floats:
        samples = np.frombuffer(self.bytes(2 * count), dtype="<i2")
        return (samples / np.float32(_PCM)).astype(np.float32)

    def end(self) -> None:
        if self._at != len(self._data):
            raise PacketError(f"{self._what} with {len(self._data) - self._at} bytes too many")


def _checked(data: bytes, kind: int, form: struct.Struct, what: str) -> _Rest:
    if len(data) < _START.size:
        raise PacketError(f"{what} of {len(data)} bytes, cut short")
    found, protocol = _START.unpack_from(data)
    if protocol != PROTOCOL:
        raise PacketError(f"{what} of protocol {protocol}, not {PROTOCOL}")
    if found != kind:
        raise PacketError(f"a message of kind {found}, where {what} was expected")
    if len(data) < form.size:
        raise PacketError(f"{what} of {len(data)} bytes, cut short")
    return _Rest(form.unpack_from(data), data, form.size, what)


def _pcm(samples: Floats | None) -> bytes:
    if samples is None:
        return b""
    return bytes(np.clip(np.rint(samples * np.float32(_PCM)), -_PCM, _PCM - 1).astype("<i2").tobytes())


def _floats(values: Floats) -> bytes:
    return bytes(np.asarray(values, dtype="<f4").tobytes())
