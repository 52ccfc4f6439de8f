"""Live Link Face, Epic's app for iPhones with a depth camera: `--face live-link[:PORT|:HOST[:PORT]]`.

One packet a frame, big-endian:

    uint8   version, 6
    int32   length n, then n bytes: device id          (n < 0: -n characters of UTF-16)
    int32   length n, then n bytes: subject name
    int32   frame number, counted from midnight; float32 part of a frame
    int32   frame rate: numerator, denominator
    uint8   number of values: 61, or 0 while no face is seen
    float32 52 blendshapes in the order "live_link_udp"; head yaw, pitch, roll; yaw, pitch, roll of each eye [rad]

The head's angles turn as ours do, which is not proved (`signals.tracks`).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from sfms_robot.errors import PacketError
from sfms_robot.frames import CHANNELS, ORDERS, SHAPES, Floats
from sfms_robot.sources.live_face import ANY, UdpSight, addresses_of_this_machine

PORT: Final = 11111  # what the app suggests
VERSION: Final = 6
LATE_S: Final = 0.5  # a frame number further back than this, or after so long a silence: the count began again

_LENGTH: Final = struct.Struct(">i")
_FRAME: Final = struct.Struct(">ifiiB")
_LONGEST_NAME: Final = 512  # bytes
_COUNT: Final = 61
_SHAPES: Final = ORDERS["live_link_udp"]
_VALUES: Final = (*_SHAPES, "yaw", "pitch", "roll", *(f"eye{i}" for i in range(6)))
# A tracker may overshoot 0..1, and is clipped; another unit is refused.
_LOWEST: Final = np.array([-0.5] * 52 + [-2 * np.pi] * 9, dtype=np.float32)
_HIGHEST: Final = np.array([2.0] * 52 + [2 * np.pi] * 9, dtype=np.float32)
# Of each of our channels: where it stands in a packet, and its factor; a packet has no position.
_COLUMNS: Final = np.array([_VALUES.index(name) if name in _VALUES else 0 for name in CHANNELS])
_FACTORS: Final = np.array([1, 1, 1, 0, 0, 0, *[1] * 52], dtype=np.float32)


class LiveLinkPacket(NamedTuple):
    """One packet.

    Attributes:
        number: of the frame; what it counts is frames of `rate_hz` since midnight, or anything.
        values: (61,) as the phone sent them, or None: no face is seen.
    """

    subject: str
    number: int
    rate_hz: float
    values: Floats | None


def parse_packet(data: bytes) -> LiveLinkPacket:
    """Return a whole packet of version 6 with finite values. Raises PacketError, in one line, for any other."""
    if not data:
        raise PacketError("an empty packet")
    if data[0] != VERSION:
        raise PacketError(_other_version(data))
    _, start = _name(data, 1)  # the device's id
    subject, start = _name(data, start)
    if len(data) < start + _FRAME.size:
        raise PacketError("a packet that is cut off")
    number, _, numerator, denominator, count = _FRAME.unpack_from(data, start)
    if count not in (0, _COUNT):
        raise PacketError(f"a packet of another number of values than {_COUNT}")
    if len(data) != start + _FRAME.size + 4 * count:
        raise PacketError("a packet that is cut off, or too long")
    if numerator <= 0 or denominator <= 0:
        raise PacketError(f"frame rate: expected positive numbers, got {numerator}/{denominator}")
    values = None if count == 0 else _values(data, start + _FRAME.size)
    return LiveLinkPacket(subject, number, numerator / denominator, values)


def _values(data: bytes, start: int) -> Floats:
    values = np.frombuffer(data, dtype=">f4", count=_COUNT, offset=start).astype(np.float32)
    if not ((values >= _LOWEST) & (values <= _HIGHEST)).all():  # NaN fails both
        raise PacketError("values that are not finite, not within 0..1 or not in radians")
    return values


def _name(data: bytes, start: int) -> tuple[str, int]:
    """Return a text and where it ends."""
    if len(data) < start + _LENGTH.size:
        raise PacketError("a packet that is cut off")
    (length,) = _LENGTH.unpack_from(data, start)
    wide = length < 0
    size, start = (-2 * length if wide else length), start + _LENGTH.size
    if size > _LONGEST_NAME or start + size > len(data):
        raise PacketError("a name that is longer than its packet")
    text = data[start : start + size].decode("utf-16-be" if wide else "utf-8", "replace")
    return text.rstrip("\0"), start + size


def _other_version(data: bytes) -> str:
    """Return why a packet of another version is not read."""
    if any(_is_animator(data, order) for order in "<>"):
        return (
            "the app is in MetaHuman Animator mode, which sends no blendshapes: choose Live Link (ARKit) as its "
            "capture mode"
        )
    if 0 < data[0] < VERSION:
        return f"an older version of the app (its packets are version {data[0]}, not {VERSION}): update it"
    return "no packets of Live Link Face"


def _is_animator(data: bytes, order: str) -> bool:
    """Return whether it is uint16 version, text, frame time, uint16 values, 6 floats of pose: by its exact length."""
    head = struct.Struct(order + "HH")
    if len(data) < head.size:
        return False
    version, length = head.unpack_from(data)
    counted = head.size + length + 16
    if not 0 < version < 256 or len(data) < counted + 2:
        return False
    (count,) = struct.unpack_from(order + "H", data, counted)
    return bool(count > 0 and len(data) == counted + 2 + 2 * count + 24)


def motion_of(values: Floats) -> Floats:
    """Return motion (58,) of the values (61,) of a packet; it has no position, which stays 0."""
    motion: Floats = values[_COLUMNS] * _FACTORS
    shapes = motion[SHAPES]
    np.minimum(np.maximum(shapes, 0.0, out=shapes), 1.0, out=shapes)
    return motion


class LiveLinkDecoder:
    """`Decoder` of one phone: the order of its packets is judged by their frame numbers.

    A number a little back is late, one far back a new count: midnight, or the app was started again. Phones count in
    steps of one, or of two where they send every other frame: lost is what is missing between steps.
    """

    def __init__(self) -> None:
        self._counts = dict.fromkeys(("lost", "doubled", "late", "recounted", "no_face"), 0)
        self._subject: str | None = None
        self.restart()

    def restart(self) -> None:
        self._number: int | None = None
        self._data = b""
        self._time_s = 0.0
        self._step: int | None = None

    def decode(self, data: bytes, time_s: float) -> Floats | None:
        packet = parse_packet(data)
        self._subject = packet.subject
        if not self._is_next(packet, data, time_s):
            return None
        self._number, self._data, self._time_s = packet.number, data, time_s
        if packet.values is None:
            self._counts["no_face"] += 1
            return None
        return motion_of(packet.values)

    def statistics(self) -> Mapping[str, Any]:
        """Return counts of frames lost, doubled, late, without a face, of new counts of the phone; and its name."""
        return {**self._counts, "subject": self._subject}

    def _is_next(self, packet: LiveLinkPacket, data: bytes, time_s: float) -> bool:
        if self._number is None:
            return True
        if data == self._data:
            self._counts["doubled"] += 1
            return False
        forward = packet.number - self._number
        if time_s - self._time_s > LATE_S or abs(forward) > LATE_S * packet.rate_hz:
            self._counts["recounted"] += forward < 0
            return True
        if forward < 0:
            self._counts["late"] += 1
            return False
        if forward > 0:  # not every program that sends these packets counts
            self._step = forward if self._step is None else min(self._step, forward)
            self._counts["lost"] += forward // self._step - 1
        return True


def open_live_link(argument: str) -> UdpSight:
    """Open `--face live-link[:PORT|HOST[:PORT]][,flip=...]`; without HOST only this machine can send.

    The log says what to type for a phone, which is another machine, and the address for its app. Raises as
    `UdpSight`.
    """
    return UdpSight("live-link", argument, PORT, LiveLinkDecoder(), _hint)


def _hint(host: str, port: int, wider: str) -> str:
    """Return what to do so that packets of a phone arrive."""
    own = addresses_of_this_machine() if wider or host in ANY else [host]
    target = f"{' or '.join(own) or 'the address of this machine'}, port {port}"
    app = f"in the app, capture mode Live Link (ARKit), enter the target {target}"
    return f"{host}, port {port}, this machine alone; for a phone {wider}, and {app}" if wider else app
