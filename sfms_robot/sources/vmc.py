"""Avatar software that sends the VMC protocol (OSC over UDP): `--face vmc[:PORT|:HOST[:PORT]]`.

These messages are read (protocol.vmc.info, "Marionette" specification), alone or in bundles:

    /VMC/Ext/Blend/Val   name, value                 a blendshape: ARKit's 52 ("perfect sync"), or a preset of VRM
    /VMC/Ext/Blend/Apply                             apply the values since the last one; without it a face is complete
                                                     when the next begins (a bundle, or a name again), or after 100 ms
    /VMC/Ext/Bone/Pos    name, position, quaternion  of bones "Head" and "Neck", each relative to its parent
    /VMC/Ext/OK          loaded, ..., tracking       tracking 0: the face is lost

Names may have any spelling that `signals.face_units.channel_of` accepts. If a sender's ARKit shapes move, they are
used; the presets of other senders become the nearest ARKit shapes. Values that are often above 2 are percent.

Unity's axes are left-handed, x right, y up, z forward as seen from the avatar; a rotation about (x, y, z) there is one
about (-z, x, -y) in ours. That follows from the two definitions. An avatar may mirror its person, depending on a
setting of its software, and this is not checked here: `flip=yaw+roll` undoes a mirror.

Messages and bundles are parsed here, in a third of python-osc's time; python-osc 1.10 does not return from a bundle
with a size of -4.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

import numpy as np

from sfms_robot.endpoint import addresses_of_this_machine
from sfms_robot.errors import PacketError
from sfms_robot.frames import BLENDSHAPES, NEUTRAL, POSE, SHAPES, Doubles, Floats
from sfms_robot.ports import Facts
from sfms_robot.signals.face_units import LiveUnits, channel_of, used_line
from sfms_robot.signals.rotations import angles_of
from sfms_robot.sources.live_face import ANY, Decoder, UdpSight, foreign

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
_NAMES: Final = (*BLENDSHAPES, *_PRESETS)  # names of the values, in their order
_AS_ARKIT: Final = np.array(
    [[preset.get(name, 0.0) for name in BLENDSHAPES] for preset in _PRESETS.values()], np.float32
)

_MOST_ELEMENTS: Final = 512  # in a packet
_DEEPEST: Final = 4  # levels of bundles in bundles
_MOST_UNKNOWN: Final = 64  # unknown names that are kept and counted
_UNIT_RANGE: Final = (0.9, 1.1)  # accepted length of a unit quaternion
_FACE_S: Final = 0.1  # after this time a face without "Apply" is complete
_MOST_VALUE: Final = 1000.0

_NOTHING: Final = (
    "neither blendshapes (/VMC/Ext/Blend/Val) nor the bone Head among its messages: switch on their sending"
)
_ONLY_THE_HEAD: Final = "the head's pose and no blendshapes: switch on sending of blendshapes (perfect sync)"

_BUNDLE: Final = b"#bundle\0"
_READ: Final = frozenset((b"/VMC/Ext/Blend/Val", b"/VMC/Ext/Blend/Apply", b"/VMC/Ext/Bone/Pos", b"/VMC/Ext/OK"))


def elements(data: bytes, depth: int = 0) -> Iterator[bytes]:
    """Yield the messages of a packet, one or a bundle of them, in order. Raises PacketError for other data."""
    if not data.startswith(_BUNDLE):
        if not data.startswith(b"/"):
            raise PacketError(foreign(data) or "no OSC packet")
        yield data
        return
    if depth == _DEEPEST:
        raise PacketError("bundles in bundles without end")
    start = len(_BUNDLE) + 8  # skip the time tag
    while start < len(data):
        size = int.from_bytes(data[start : start + 4], "big", signed=True)
        start += 4
        if size <= 0 or start + size > len(data):
            raise PacketError("an OSC bundle that is cut off")
        element = data[start : start + size]
        if element.startswith(_BUNDLE):
            yield from elements(element, depth + 1)
        else:
            yield element
        start += size


def _text(element: bytes, at: int) -> tuple[bytes, int]:
    """Return a text of a message and the start of the next value; texts are padded with zeros to 4 bytes."""
    end = element.find(b"\0", at)
    if end < 0:
        raise PacketError("an OSC message that is cut off")
    return element[at:end], end + 4 - end % 4


def arguments(element: bytes, at: int) -> list[Any]:
    """Return the numbers, texts and booleans of a message whose types begin at `at`. Raises PacketError for others."""
    values: list[Any] = []
    if at >= len(element):
        return values
    types, at = _text(element, at)
    try:
        for kind in _layout(types):
            if kind is None:
                text, at = _text(element, at)
                values.append(text)
            elif isinstance(kind, bool):
                values.append(kind)
            else:
                values += kind.unpack_from(element, at)
                at += kind.size
    except struct.error as error:
        raise PacketError("an OSC message that is cut off") from error
    return values


@lru_cache(maxsize=64)
def _layout(types: bytes) -> list[struct.Struct | bool | None]:
    """Return the layout of a message's values by their types: runs of numbers, booleans (no bytes), texts (None)."""
    if not re.fullmatch(rb",[sTFihfd]*", types):
        raise PacketError("an OSC message of types that are not read")
    alone = {"s": None, "T": True, "F": False}
    runs = re.findall("[sTF]|[^sTF]+", types[1:].decode())
    return [alone[run] if run in alone else struct.Struct(">" + run.replace("h", "q")) for run in runs]


def turn_of_unity(quaternion: Sequence[float]) -> Doubles:
    """Return the rotation (3, 3) in our axes of a quaternion x, y, z, w of unit length in Unity's axes."""
    x, y, z, w = quaternion
    cross = np.array([[0.0, y, x], [-y, 0.0, z], [-x, -z, 0.0]])  # of (-z, x, -y)
    turn: Doubles = np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
    return turn


@lru_cache(maxsize=1024)
def _place(name: bytes) -> int | None:
    """Return the index of a name among the values, or None."""
    text = name.decode("utf-8", "replace")
    preset, channel = text.lower().rpartition(".")[2], channel_of(text)
    found = preset if preset in _PRESETS else channel
    return _NAMES.index(found) if found in _NAMES else None


class VmcDecoder(Decoder):
    """`Decoder` of one avatar. A name that is not sent again keeps its value, as in other receivers of avatars."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(("messages", "wrong_messages", "lost_tracking"), 0)
        self.restart()

    def restart(self) -> None:
        self._unknown = set[bytes]()
        self._values = [0.0] * len(_NAMES)
        self._known = set[int]()  # places received so far
        self._pending = set[int]()  # places whose values are not applied yet
        self._pending_s = 0.0  # time since which values are pending
        self._applies = False  # True: the sender marks complete faces by "Apply"
        self._turned = False
        self._shapes: Floats = np.zeros(_ARKIT, dtype=np.float32)
        self._has_arkit = False
        self._bones = {b"neck": np.eye(3), b"head": np.eye(3)}
        self.blind = False
        self._changed = False

    def decode(self, data: bytes, time_s: float) -> Floats | None:
        if self._pending and (time_s - self._pending_s > _FACE_S or (data[:1] == b"#" and not self._applies)):
            self._apply()
        if not self._pending:
            self._pending_s = time_s
        ours, other = False, b""
        for number, element in enumerate(elements(data)):
            if number == _MOST_ELEMENTS:
                raise PacketError("an OSC bundle without end")
            if element.startswith(b"/VMC/"):
                ours = True
                self._counts["messages"] += 1
                try:
                    self._take(element)
                except PacketError:
                    self._counts["wrong_messages"] += 1
            else:
                other = element
        if not ours:
            raise PacketError(foreign(other) or "no packet of the VMC protocol")
        return self._face()

    def due(self, time_s: float) -> Floats | None:
        if self._pending and time_s - self._pending_s > _FACE_S:
            self._apply()
        return self._face()

    def remark(self) -> str | None:
        if not self._unknown and not self._known:
            return None if self.blind else _ONLY_THE_HEAD if self._turned else _NOTHING
        moved = {name for place in self._known for name in _PRESETS.get(_NAMES[place], {_NAMES[place]: 1.0})}
        return used_line(moved, [name.decode("utf-8", "replace") for name in self._unknown]) if self._unknown else None

    def statistics(self) -> Facts:
        """Return counts of messages, messages with unexpected types, losses of tracking, and unknown names."""
        return {**self._counts, "unknown_names": len(self._unknown)}

    def _take(self, element: bytes) -> None:
        """Process one message. Raises PacketError for values that do not fit its address."""
        address, at = _text(element, 0)
        if address not in _READ:
            return
        match address, arguments(element, at):
            case b"/VMC/Ext/Blend/Val", [bytes(name), value, *_] if _is_number(value) and math.isfinite(value):
                self._blend(name, min(max(float(value), -_MOST_VALUE), _MOST_VALUE))
            case b"/VMC/Ext/Blend/Apply", _:
                self._applies = True
                self._apply()
            case b"/VMC/Ext/Bone/Pos", [bytes(name), _, _, _, *quaternion]:
                if name.lower() in self._bones:
                    self._turn(name.lower(), quaternion[:4])
            case b"/VMC/Ext/OK", [loaded, *more]:
                blind = loaded == 0 or more[2:3] == [0]
                self._counts["lost_tracking"] += blind and not self.blind
                self.blind = blind
            case _:
                raise PacketError("values of other types")

    def _blend(self, name: bytes, value: float) -> None:
        place = _place(name)
        if place is None:
            if len(self._unknown) < _MOST_UNKNOWN:
                self._unknown.add(name)
            return
        if place in self._pending and not self._applies:  # the next face begins
            self._apply()
        self._pending.add(place)
        self._known.add(place)
        self._values[place] = value
        self._has_arkit = self._has_arkit or (place < _ARKIT and value > 0.0)

    def _turn(self, bone: bytes, quaternion: Sequence[Any]) -> None:
        length = math.hypot(*quaternion) if len(quaternion) == 4 and all(map(_is_number, quaternion)) else 0.0
        if not _UNIT_RANGE[0] <= length <= _UNIT_RANGE[1]:  # NaN is in no range
            raise PacketError("not a quaternion of unit length")
        self._bones[bone] = turn_of_unity([part / length for part in quaternion])
        self._changed = self._turned = True

    def _apply(self) -> None:
        self._pending.clear()
        if self._unknown and not self._known:
            return  # none of its values can be shown
        values = np.array(self._values, dtype=np.float32)
        self._shapes = values[:_ARKIT] if self._has_arkit else (values[_ARKIT:, None] * _AS_ARKIT).max(axis=0)
        self._changed = True

    def _face(self) -> Floats | None:
        """Return the face (58,) if it has changed since the last call, else None."""
        changed, self._changed = self._changed, False
        if not changed or self.blind:
            return None
        motion = NEUTRAL.copy()
        motion[POSE][:3] = angles_of((self._bones[b"neck"] @ self._bones[b"head"])[None])[0]
        motion[SHAPES] = self._shapes
        return motion


def _is_number(value: object) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool)


def open_vmc(argument: str) -> UdpSight:
    """Open `--face vmc[:PORT|HOST[:PORT]][,flip=...]`; without HOST only software on this machine can send.

    Raises as `UdpSight`.
    """
    return UdpSight("vmc", argument, VmcDecoder(), _hint, LiveUnits(angles=False))


def _hint(host: str, port: int, wider: str) -> str:
    """Return instructions for making packets of avatar software arrive."""
    own = addresses_of_this_machine() if host in ANY else [host]
    target = f"let the avatar software send VMC to {' or '.join(own) or 'this machine'}, port {port}"
    return f"{target}; {wider} also takes packets of other machines" if wider else target
