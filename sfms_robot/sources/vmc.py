"""Avatar software that speaks the VMC protocol (OSC over UDP): `--face vmc[:PORT|:HOST[:PORT]]`.

Read (protocol.vmc.info, "Marionette" specification), alone or in bundles:

    /VMC/Ext/Blend/Val   name, value                 a blendshape: ARKit's 52 ("perfect sync"), or a preset of VRM
    /VMC/Ext/Blend/Apply                             those since the last one hold now
    /VMC/Ext/Bone/Pos    name, position, quaternion  of bones "Head" and "Neck", each against its parent
    /VMC/Ext/OK          loaded, ..., tracking       tracking 0: the face is lost

Names go by any case. A sender whose ARKit shapes move is believed in these; the presets of another become the ARKit
shapes nearest to them. Unity's axes are left-handed, x right, y up, z forward as the avatar has them; a rotation about
(x, y, z) there is one about (-z, x, -y) in ours. That follows from the two definitions; whether an avatar mirrors its
person is a setting of its software, and not proved here: `flip=yaw+roll` undoes a mirror.

A message of the usual types is read at fixed places, which takes a third of python-osc's time; others are read by its
primitives. Bundles are walked here: python-osc 1.10 never comes back from one that gives a size of -4.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from pythonosc.parsing import osc_types

from sfms_robot.errors import PacketError
from sfms_robot.frames import BLENDSHAPES, MOTION_DIM, POSE, SHAPES, Floats
from sfms_robot.sources.live_face import ANY, UdpSight, addresses_of_this_machine, open_udp_sight

PORT: Final = 39539  # what the protocol gives those who receive

# The ARKit shapes nearest to a preset of VRM 0 and 1.
_SMILE: Final = {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0, "cheekSquintLeft": 0.5, "cheekSquintRight": 0.5}
_SAD: Final = {"browInnerUp": 0.8, "mouthFrownLeft": 0.8, "mouthFrownRight": 0.8}
_CALM: Final = {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5}
_A: Final = {"jawOpen": 0.7}
_I: Final = {"jawOpen": 0.15, "mouthStretchLeft": 0.5, "mouthStretchRight": 0.5}
_U: Final = {"jawOpen": 0.15, "mouthPucker": 0.8}
_E: Final = {"jawOpen": 0.35, "mouthStretchLeft": 0.3, "mouthStretchRight": 0.3}
_O: Final = {"jawOpen": 0.4, "mouthFunnel": 0.7}
_PRESETS: Final[Mapping[str, Mapping[str, float]]] = {
    "a": _A, "aa": _A, "i": _I, "ih": _I, "u": _U, "ou": _U, "e": _E, "ee": _E, "o": _O, "oh": _O,
    "joy": _SMILE, "happy": _SMILE, "fun": _CALM, "relaxed": _CALM, "sorrow": _SAD, "sad": _SAD,
    "angry": {"browDownLeft": 1.0, "browDownRight": 1.0, "mouthPressLeft": 0.3, "mouthPressRight": 0.3},
    "surprised": {"eyeWideLeft": 0.8, "eyeWideRight": 0.8, "browInnerUp": 0.8, "browOuterUpLeft": 0.8,
                  "browOuterUpRight": 0.8, "jawOpen": 0.3},
    "blink": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "blink_l": {"eyeBlinkLeft": 1.0}, "blinkleft": {"eyeBlinkLeft": 1.0},
    "blink_r": {"eyeBlinkRight": 1.0}, "blinkright": {"eyeBlinkRight": 1.0},
    "lookup": {"eyeLookUpLeft": 1.0, "eyeLookUpRight": 1.0},
    "lookdown": {"eyeLookDownLeft": 1.0, "eyeLookDownRight": 1.0},
    "lookleft": {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0},
    "lookright": {"eyeLookInLeft": 1.0, "eyeLookOutRight": 1.0},
    "neutral": {},
}  # fmt: skip
_ARKIT: Final = len(BLENDSHAPES)
# Every name as it stands on the wire, lower case, and its place among the values: ARKit's first, then the presets.
_PLACES: Final = {name.lower().encode(): place for place, name in enumerate((*BLENDSHAPES, *_PRESETS))}
_AS_ARKIT: Final = np.array(
    [[preset.get(name, 0.0) for name in BLENDSHAPES] for preset in _PRESETS.values()], np.float32
)

_MOST_ELEMENTS: Final = 512  # of a packet
_MOST_UNUSUAL: Final = 64  # messages of a packet that are not of the usual types
_DEEPEST: Final = 4  # bundles in bundles
_LONGEST_ODD: Final = 512  # bytes of an element of unusual types
_MOST_UNKNOWN: Final = 64  # names that are counted apart
_UNIT_RANGE: Final = (0.9, 1.1)  # length of a quaternion that is one

_BUNDLE: Final = b"#bundle\0"
_SIZE: Final = struct.Struct(">i")
_FLOAT: Final = struct.Struct(">f")
_BLEND: Final = b"/VMC/Ext/Blend/Val\0\0,sf\0"
_APPLY: Final = b"/VMC/Ext/Blend/Apply\0"
_BONE: Final = b"/VMC/Ext/Bone/Pos\0\0\0,sfffffff\0\0\0"
_READ_FROM: Final = (b"/VMC/Ext/Blend/Val\0", b"/VMC/Ext/Bone/Pos\0", b"/VMC/Ext/OK\0")
_QUATERNION: Final = struct.Struct(">4f")
_OURS: Final = b"/VMC/"

Quaternion = tuple[float, float, float, float]  # x, y, z, w


def elements(data: bytes, depth: int = 0) -> Iterator[bytes]:
    """Yield the messages of a packet, one or a bundle of them, in order. Raises PacketError for other bytes."""
    if not data.startswith(_BUNDLE):
        if not data.startswith(b"/"):
            raise PacketError("no OSC packet")
        yield data
        return
    if depth == _DEEPEST:
        raise PacketError("bundles in bundles without end")
    start = len(_BUNDLE) + 8  # the time tag
    while start < len(data):
        if start + _SIZE.size > len(data):
            raise PacketError("an OSC bundle that is cut off")
        (size,) = _SIZE.unpack_from(data, start)
        start += _SIZE.size
        if size <= 0 or start + size > len(data):
            raise PacketError("an OSC bundle that is cut off")
        element = data[start : start + size]
        if element.startswith(_BUNDLE):
            yield from elements(element, depth + 1)
        else:
            yield element
        start += size


def parse_message(element: bytes) -> tuple[str, list[Any]]:
    """Return address and arguments of one message of numbers and texts. Raises PacketError for other types."""
    if len(element) > _LONGEST_ODD:
        raise PacketError("an OSC message that is too long")
    values: list[Any] = []
    try:
        address, start = osc_types.get_string(element, 0)
        if start >= len(element):
            return address, values
        types, start = osc_types.get_string(element, start)
        if not types.startswith(","):
            raise PacketError("an OSC message without types")
        for kind in types[1:]:
            if kind in "TF":
                values.append(kind == "T")
                continue
            if kind not in _READ:
                raise PacketError("an OSC message of types that are not read")
            value, start = _READ[kind](element, start)
            values.append(value)
    except (osc_types.ParseError, UnicodeDecodeError) as error:
        raise PacketError("an OSC message that is cut off") from error
    return address, values


_READ: Final[Mapping[str, Any]] = {
    "i": osc_types.get_int,
    "h": osc_types.get_int64,
    "f": osc_types.get_float,
    "d": osc_types.get_double,
    "s": osc_types.get_string,
}


def angles_of_unity(quaternion: Quaternion) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in our axes [rad], R = Rz(yaw) Ry(pitch) Rx(roll), of a rotation in Unity's axes."""
    x, y, z, w = quaternion
    x, y, z = -z, x, -y
    sine = max(-1.0, min(1.0, 2.0 * (w * y - z * x)))
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(sine),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


class VmcDecoder:
    """`Decoder` of one avatar. A name that is not sent again keeps its value, as receivers of avatars have it."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(("messages", "wrong_messages", "lost_tracking"), 0)
        self._unknown: set[bytes] = set()
        self.restart()

    def restart(self) -> None:
        self._values = [0.0] * len(_PLACES)
        self._shapes: Floats = np.zeros(_ARKIT, dtype=np.float32)
        self._has_arkit = False
        self._bones: dict[bytes, Quaternion] = {b"neck": (0.0, 0.0, 0.0, 1.0), b"head": (0.0, 0.0, 0.0, 1.0)}
        self._tracking = True
        self._changed = False
        self._unusual = 0  # messages of the packet at hand

    def decode(self, data: bytes, time_s: float) -> Floats | None:
        ours, self._unusual = False, 0
        for number, element in enumerate(elements(data)):
            if number == _MOST_ELEMENTS:
                raise PacketError("an OSC bundle without end")
            if element.startswith(_OURS):
                ours = True
                self._counts["messages"] += 1
                self._take(element)
        if not ours:
            raise PacketError("no packet of the VMC protocol")
        changed, self._changed = self._changed, False
        return self._motion() if changed and self._tracking else None

    def statistics(self) -> Mapping[str, Any]:
        """Return counts of messages, those of unexpected types, losses of tracking, and unknown names."""
        return {**self._counts, "unknown_names": len(self._unknown)}

    def _take(self, element: bytes) -> None:
        if element.startswith(_BLEND) and len(element) >= len(_BLEND) + 8:
            self._blend(element[len(_BLEND) : -4], _FLOAT.unpack_from(element, len(element) - 4)[0])
        elif element.startswith(_BONE) and len(element) >= len(_BONE) + 32:
            name = element[len(_BONE) : -28].rstrip(b"\0").lower()
            if name in self._bones:
                self._turn(name, _QUATERNION.unpack_from(element, len(element) - 16))
        elif element.startswith(_APPLY):
            self._apply()
        elif element.startswith(_READ_FROM) and self._unusual < _MOST_UNUSUAL:
            self._unusual += 1
            self._take_unusual(element)

    def _take_unusual(self, element: bytes) -> None:
        """Take a message of other types than most senders write, or one that is not in every frame."""
        try:
            address, values = parse_message(element)
        except PacketError:
            self._counts["wrong_messages"] += 1
            return
        match address, values:
            case "/VMC/Ext/Blend/Val", [str(name), value, *_] if _is_number(value):
                self._blend(name.encode(), float(value))
            case "/VMC/Ext/Bone/Pos", [str(name), *numbers] if len(numbers) >= 7 and all(map(_is_number, numbers)):
                if (key := name.lower().encode()) in self._bones:
                    x, y, z, w = map(float, numbers[3:7])
                    self._turn(key, (x, y, z, w))
            case "/VMC/Ext/OK", [loaded, *more]:
                self._track(loaded != 0 and (len(more) < 3 or more[2] != 0))
            case _:
                self._counts["wrong_messages"] += 1

    def _blend(self, name: bytes, value: float) -> None:
        name = name.rstrip(b"\0").lower()
        place = _PLACES.get(name)
        if place is None:
            if len(self._unknown) < _MOST_UNKNOWN:
                self._unknown.add(name)
        elif math.isfinite(value):
            self._values[place] = min(max(value, 0.0), 1.0)
            self._has_arkit = self._has_arkit or (place < _ARKIT and value > 0.0)
        else:
            self._counts["wrong_messages"] += 1

    def _turn(self, bone: bytes, quaternion: Quaternion) -> None:
        length = math.sqrt(sum(part * part for part in quaternion))
        if not _UNIT_RANGE[0] <= length <= _UNIT_RANGE[1]:  # NaN is in no range
            self._counts["wrong_messages"] += 1
            return
        x, y, z, w = quaternion
        self._bones[bone] = (x / length, y / length, z / length, w / length)
        self._changed = True

    def _apply(self) -> None:
        values = np.array(self._values, dtype=np.float32)
        self._shapes = values[:_ARKIT] if self._has_arkit else (values[_ARKIT:, None] * _AS_ARKIT).max(axis=0)
        self._changed = True

    def _track(self, tracking: bool) -> None:
        self._counts["lost_tracking"] += self._tracking and not tracking
        self._tracking = tracking

    def _motion(self) -> Floats:
        motion = np.zeros(MOTION_DIM, dtype=np.float32)
        motion[POSE][:3] = angles_of_unity(_product(self._bones[b"neck"], self._bones[b"head"]))
        motion[SHAPES] = self._shapes
        return motion


def _is_number(value: object) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool)


def open_vmc(argument: str) -> UdpSight:
    """Open `--face vmc[:PORT|HOST[:PORT]][,flip=...]`; without HOST only avatar software on this machine can send.

    Raises as `open_udp_sight`.
    """
    return open_udp_sight("vmc", argument, PORT, VmcDecoder(), _hint)


def _hint(host: str, port: int, wider: str) -> str:
    """Return what to do so that packets of avatar software arrive."""
    own = addresses_of_this_machine() if host in ANY else [host]
    target = f"let the avatar software send VMC to {' or '.join(own) or 'this machine'}, port {port}"
    return f"{target}; {wider} also takes packets of other machines" if wider else target
