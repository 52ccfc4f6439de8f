"""Live Link Face, Epic's app for iPhones with a depth camera: `--face live-link[:PORT|:HOST[:PORT]]`.

Each frame is one packet, big-endian:

    uint8   version, 6; another version is accepted if the rest has this format
    int32   length n, then n bytes: device id          (n < 0: -n characters of UTF-16)
    int32   length n, then n bytes: subject name; some senders count characters, not bytes
    int32   frame number, counted from midnight; float32 part of a frame
    int32   frame rate: numerator, denominator; 30/0 and similar values of senders below 60 a second mean 30
    uint8   number of values: 61, or 0 while no face is seen; 52 lack the head, of more than 61 the first are read
    float32 52 blendshapes in the order "live_link_udp"; head yaw, pitch, roll; yaw, pitch, roll of each eye [rad]

The head's angles have the same signs as ours, which is not proved (`signals.tracks`). Some senders write them in
degrees, which is decided over the first second (`signals.face_units`). Only values that a face needs are checked: 52
blendshapes and three angles.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from sfms_robot.endpoint import addresses_of_this_machine
from sfms_robot.errors import PacketError
from sfms_robot.frames import CHANNELS, ORDERS, Floats
from sfms_robot.ports import Facts
from sfms_robot.signals.face_units import LiveUnits
from sfms_robot.sources.live_face import ANY, Decoder, UdpSight, foreign

VERSION: Final = 6
LATE_S: Final = 0.5  # a frame number further back than this, or after a longer silence, begins a new count

_LENGTH: Final = struct.Struct(">i")
_FRAME: Final = struct.Struct(">ifiiB")
_LONGEST_NAME: Final = 512  # bytes
_USUAL_HZ: Final = 60.0
_SHAPES: Final = ORDERS["live_link_udp"]
_VALUES: Final = (*_SHAPES, "yaw", "pitch", "roll", *(f"eye{i}" for i in range(6)))
_NEEDED: Final = _VALUES.index("eye0")
# For each of our channels: its index in a packet, and its factor, 0 for channels that a packet lacks (position).
_COLUMNS: Final = np.array([_VALUES.index(name) if name in _VALUES else 0 for name in CHANNELS])
_FACTORS: Final = np.array([name in _VALUES for name in CHANNELS], dtype=np.float32)


class LiveLinkPacket(NamedTuple):
    """One packet.

    Attributes:
        number: frame number; it counts frames of `rate_hz` since midnight, or from any other start.
        values: (61,) as the phone sent them, 0 for missing ones; None: no face is seen.
        sent: number of values in the packet.
    """

    subject: str
    number: int
    rate_hz: float
    values: Floats | None
    sent: int


def parse_packet(data: bytes) -> LiveLinkPacket:
    """Parse a packet with the values that a face needs. Raises PacketError, in one line, for any other packet."""
    if not data:
        raise PacketError("an empty packet")
    try:
        return _packet(data)
    except PacketError as error:
        raise PacketError(_other_format(data) or str(error)) from None


def _packet(data: bytes) -> LiveLinkPacket:
    start = _end_of_name(data, 1)  # the device's id
    end = _end_of_name(data, start)
    end = next((each for each in _ends(data, start) if _fits(data, each)), end)
    if len(data) < end + _FRAME.size:
        raise PacketError("a packet that is cut off")
    number, _, numerator, denominator, count = _FRAME.unpack_from(data, end)
    if 0 < count < len(_SHAPES):
        raise PacketError(f"{count} values, of which the first {len(_SHAPES)} have to be blendshapes")
    if len(data) < end + _FRAME.size + 4 * count:
        raise PacketError("a packet that is cut off")
    rate_hz = numerator / max(denominator, 1) if numerator > 0 else _USUAL_HZ
    values = None if count == 0 else _values(data, end + _FRAME.size, count)
    return LiveLinkPacket(_text(data, start, end), number, rate_hz, values, count)


def _values(data: bytes, start: int, count: int) -> Floats:
    values = np.zeros(len(_VALUES), dtype=np.float32)
    read = np.frombuffer(data, dtype=">f4", count=min(count, len(_VALUES)), offset=start)
    if not np.isfinite(read[:_NEEDED]).all():
        raise PacketError("values that are not finite")
    values[: len(read)] = np.where(np.isfinite(read), read, np.float32(0))
    return values


def _ends(data: bytes, start: int) -> Iterator[int]:
    """Yield possible ends of a name: at its length in bytes, then later ones, for a length in characters."""
    (length,) = _LENGTH.unpack_from(data, start)
    begin = start + _LENGTH.size
    yield from range(begin + (length if length >= 0 else -2 * length), begin + 4 * abs(length) + 1)


def _fits(data: bytes, at: int) -> bool:
    """Return whether a frame that begins at `at` fills the rest of the packet."""
    values = at + _FRAME.size
    return values <= len(data) == values + 4 * data[values - 1]


def _end_of_name(data: bytes, start: int) -> int:
    """Return the end of a text according to its length, which is stored at `start`."""
    if len(data) < start + _LENGTH.size:
        raise PacketError("a packet that is cut off")
    (length,) = _LENGTH.unpack_from(data, start)
    size = int(length if length >= 0 else -2 * length)
    end = start + _LENGTH.size + size
    if size > _LONGEST_NAME or end > len(data):
        raise PacketError("a name that is longer than its packet")
    return end


def _text(data: bytes, start: int, end: int) -> str:
    """Return the text whose length is stored at `start`."""
    wide = data[start] > 0x7F  # a negative length
    return data[start + _LENGTH.size : end].decode("utf-16-be" if wide else "utf-8", "replace").rstrip("\0")


def _other_format(data: bytes) -> str | None:
    """Return a line about the other format that this is; None: it is Live Link's."""
    if any(_is_animator(data, order) for order in "<>"):
        return (
            "the app is in MetaHuman Animator mode, which sends no blendshapes: choose Live Link (ARKit) as its "
            "capture mode"
        )
    if 0 < data[0] < VERSION:
        return f"an older version of the app (its packets are version {data[0]}, not {VERSION}): update it"
    return None if data[0] == VERSION else foreign(data) or "no packets of Live Link Face"


def _is_animator(data: bytes, order: str) -> bool:
    """Return whether data is uint16 version, text, frame time, uint16 values, 6 floats of pose, by its exact length."""
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
    """Return motion (58,) of the values (61,) of a packet, in the packet's units; the position is 0."""
    motion: Floats = values[_COLUMNS] * _FACTORS
    return motion


class LiveLinkDecoder(Decoder):
    """`Decoder` of one phone, which determines the order of its packets from their frame numbers.

    A number that is a little lower is a late packet; one that is much lower begins a new count, at midnight or after a
    restart of the app. Phones count in steps of one, or of two if they send every other frame; numbers missing between
    steps are lost packets. If a sender has never counted, each packet is a new frame.
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
        self._sent = len(_VALUES)

    def decode(self, data: bytes, time_s: float) -> Floats | None:
        packet = parse_packet(data)
        self._subject = packet.subject
        if not self._is_next(packet, data, time_s):
            return None
        self._number, self._data, self._time_s = packet.number, data, time_s
        self.blind = packet.values is None
        if packet.values is None:
            self._counts["no_face"] += 1
            return None
        self._sent = packet.sent
        return motion_of(packet.values)

    def remark(self) -> str | None:
        if _NEEDED <= self._sent <= len(_VALUES):
            return None
        unused = "no head angles" if self._sent < _NEEDED else f"the first {_NEEDED} are used"
        return f"{self._sent} values, not {len(_VALUES)}: {unused}"

    def statistics(self) -> Facts:
        """Return counts of lost, doubled, late and faceless frames, and of restarts of the count; and the subject."""
        return {**self._counts, "subject": self._subject}

    def _is_next(self, packet: LiveLinkPacket, data: bytes, time_s: float) -> bool:
        if self._number is None:
            return True
        if data == self._data and self._step is not None:
            self._counts["doubled"] += 1
            return False
        forward = packet.number - self._number
        if time_s - self._time_s > LATE_S or abs(forward) > LATE_S * packet.rate_hz:
            self._counts["recounted"] += forward < 0
            return True
        if forward < 0:
            self._counts["late"] += 1
            return False
        if forward > 0:
            self._step = forward if self._step is None else min(self._step, forward)
            self._counts["lost"] += forward // self._step - 1
        return True


def open_live_link(argument: str) -> UdpSight:
    """Open `--face live-link[:PORT|HOST[:PORT]][,flip=...]`; without HOST only this machine can send.

    The log contains the flag for a phone, which is another machine, and the address to enter in its app. Raises as
    `UdpSight`.
    """
    return UdpSight("live-link", argument, LiveLinkDecoder(), _hint, LiveUnits())


def _hint(host: str, port: int, wider: str) -> str:
    """Return instructions for making packets of a phone arrive."""
    own = addresses_of_this_machine() if wider or host in ANY else [host]
    target = f"{' or '.join(own) or 'the address of this machine'}, port {port}"
    app = f"in the app, capture mode Live Link (ARKit), enter the target {target}"
    return f"{host}, port {port}, this machine alone; for a phone {wider}, and {app}" if wider else app
