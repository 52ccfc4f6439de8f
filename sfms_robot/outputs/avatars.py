"""Outputs to avatar software that receives a face over UDP: the VMC protocol, and Live Link Face's packets.

    --output vmc[:HOST:PORT]          VSeeFace, VNyan, Warudo, Blender, Unity: 50 faces a second, in bundles
    --output vmc-single[:HOST:PORT]   the same, each message in a packet of its own, 25 a second
    --output live-link[:HOST:PORT]    Unreal's MetaHumans, as if an iPhone sent them, 50 a second

VMC (protocol.vmc.info, "Marionette"): OK, T, Bone/Pos of Neck, Head, LeftEye and RightEye, Blend/Val of the 52 ARKit
names ("perfect sync"), Blend/Apply. Unity's axes are left-handed, x right, y up, z forward: a turn about (a, b, c) in
ours is one about (b, -c, -a) there, the inverse of `sources.vmc.turn_of_unity`. Neck and head turn half each. Positions
of bones depend on the skeleton, which the receiver has, so 0 is sent, as face trackers do.

Live Link: the packet of `sources.live_link`, version 6, 61 values. Neither protocol has a position of the head.

UDP has no connection. A receiver that is away is noticed only on this machine, where the system refuses the packets.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from sfms_robot.endpoint import address_text
from sfms_robot.errors import OutputError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, ORDERS, POSE, SHAPES
from sfms_robot.outputs.registry import parse_address
from sfms_robot.ports import Facts, Output, OutputFrame
from sfms_robot.signals.gaze_kinematics import EYES_RAD, directions

SUBJECT: Final = "sfms-robot"  # name in Unreal's list
LARGEST_PACKET: Final = 1400  # bytes, so that no network splits it
_RATE: Final = 50  # frames a second of Live Link
_DAY: Final = 86_400 * _RATE  # frames a day


class UdpOutput(Output):
    """An output that sends packets to one address. A subclass defines `packets`, `usual_port` and `advice`."""

    usual_port: int
    advice: str

    def __init__(self, argument: str = "") -> None:
        self._address = parse_address(self.kind, argument, self.usual_port)
        self.peer = address_text(*self._address)
        self._socket: socket.socket | None = None
        self._bytes = 0

    def open(self) -> None:
        """Resolve the address. Raises OutputError."""
        host, port = self._address
        try:
            family, _, _, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            raise OutputError(f"no address found for {host}: {getattr(error, 'strerror', None) or error}") from error
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect(where)

    def send(self, frame: OutputFrame, now_s: float) -> None:
        """Send the packets of a frame. Raises OutputError if nothing listens."""
        assert self._socket is not None
        for packet in self.packets(frame, now_s):
            try:
                self._bytes += self._socket.send(packet)
            except BlockingIOError:  # the network is full: leave the rest out, the next frame is newer
                return
            except ConnectionRefusedError as error:
                raise OutputError(f"nothing listens there: {self.advice}") from error

    def packets(self, frame: OutputFrame, now_s: float) -> Sequence[bytes | bytearray]:
        """Return the packets of a frame."""
        raise NotImplementedError

    def statistics(self) -> Facts:
        """Return the bytes that were sent."""
        return {"bytes": self._bytes}

    def close(self) -> None:
        """Close the socket. Idempotent."""
        if self._socket is not None:
            self._socket.close()


# --- VMC ------------------------------------------------------------------------------------------------------------

_BONES: Final = ("Neck", "Head", "LeftEye", "RightEye")


def _osc(address: str, types: str, *texts: str) -> bytes:
    """Return an OSC message whose numbers, which come after its texts, are 0."""
    parts = [part.encode() for part in (address, f",{types}", *texts)]
    head = b"".join(part + bytes(4 - len(part) % 4) for part in parts)
    return head + bytes(4 * sum(kind in "if" for kind in types))


def unity_quaternion(roll: float, pitch: float, yaw: float, share: float = 1.0) -> tuple[float, float, float, float]:
    """Return x, y, z, w in Unity's axes of R = Rz(yaw) Ry(pitch) Rx(roll) in ours; `share` of the turn about its axis.

    Angles in rad.
    """
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(each / 2), math.sin(each / 2)) for each in (roll, pitch, yaw))
    w = cr * cp * cy + sr * sp * sy
    a = sr * cp * cy - cr * sp * sy
    b = cr * sp * cy + sr * cp * sy
    c = cr * cp * sy - sr * sp * cy
    size = math.sqrt(a * a + b * b + c * c)
    half = share * math.atan2(size, w)
    factor = math.sin(half) / size if size > 1e-12 else 0.0
    return factor * b, -factor * c, -factor * a, math.cos(half)


class VmcOutput(UdpOutput):
    """VMC, in bundles of up to `LARGEST_PACKET` bytes. Messages keep their lengths: only numbers are filled in."""

    kind, usual_port = "vmc", 39539  # the receivers' port in the protocol
    advice = "start the avatar software and switch on its VMC receiver, or check the port"
    _bundled = True

    def __init__(self, argument: str = "") -> None:
        super().__init__(argument)
        self._packets: list[bytearray] = []
        self._places: list[tuple[bytearray, int]] = []  # of each message: packet, and index of its numbers
        self._pack(_osc("/VMC/Ext/OK", "iiii"), 16)
        packet, at = self._places.pop()
        struct.pack_into(">iiii", packet, at, 1, 3, 0, 1)  # loaded, calibrated, mode normal, tracking
        self._pack(_osc("/VMC/Ext/T", "f"), 4)
        for bone in _BONES:
            self._pack(_osc("/VMC/Ext/Bone/Pos", "sfffffff", bone), 16)  # positions stay 0
        for name in BLENDSHAPES:
            self._pack(_osc("/VMC/Ext/Blend/Val", "sf", name), 4)
        self._pack(_osc("/VMC/Ext/Blend/Apply", ""), 0)
        self._places.pop()

    def packets(self, frame: OutputFrame, now_s: float) -> Sequence[bytearray]:
        roll, pitch, yaw = frame.motion[POSE][:3].tolist()
        half = unity_quaternion(roll, pitch, yaw, 0.5)
        eyes = (unity_quaternion(0.0, tilt, turn) for turn, tilt in directions(frame.motion, EYES_RAD).tolist())
        values = [(frame.time_s,), half, half, *eyes, *((each,) for each in frame.motion[SHAPES].tolist())]
        for (packet, at), numbers in zip(self._places, values, strict=True):
            struct.pack_into(f">{len(numbers)}f", packet, at, *numbers)
        return self._packets

    def _pack(self, message: bytes, numbers: int) -> None:
        """Add a message, which ends with `numbers` bytes to be filled in, to the last packet or to a new one."""
        size = struct.pack(">i", len(message)) if self._bundled else b""
        last = self._packets[-1] if self._packets else None
        if last is None or not self._bundled or len(last) + len(size) + len(message) > LARGEST_PACKET:
            last = bytearray(b"#bundle\0" + struct.pack(">Q", 1) if self._bundled else b"")  # 1: immediately
            self._packets.append(last)
        last += size + message
        self._places.append((last, len(last) - numbers))


class VmcSingleOutput(VmcOutput):
    """VMC for receivers that cannot read bundles."""

    kind, rate_hz = "vmc-single", 25.0
    _bundled = False


# --- Live Link ------------------------------------------------------------------------------------------------------

_ORDER: Final = [CHANNEL_INDEX[name] for name in (*ORDERS["live_link_udp"], "yaw", "pitch", "roll")]


class LiveLinkOutput(UdpOutput):
    """Live Link Face's packets. Frames are counted from midnight on, as in the app."""

    kind, usual_port, rate_hz = "live-link", 11111, float(_RATE)
    advice = "start Unreal with its Live Link plug-in, or check the port"

    def __init__(self, argument: str = "") -> None:
        super().__init__(argument)
        name = SUBJECT.encode()
        self._head = b"\x06" + 2 * (struct.pack(">i", len(name)) + name)  # device and subject
        self._midnight_s: float | None = None  # of `time.monotonic`
        self._number = 0

    def packets(self, frame: OutputFrame, now_s: float) -> Sequence[bytes]:
        if self._midnight_s is None:
            here = time.localtime()
            self._midnight_s = now_s - (here.tm_hour * 60 + here.tm_min) * 60 - here.tm_sec
        due = round((now_s - self._midnight_s) * _RATE)
        # Numbers are consecutive: by the clock alone, a frame that is a little late would skip a number.
        self._number = self._number + 1 if abs(self._number + 1 - due) < _RATE / 2 else due
        eyes = [each for turn, tilt in directions(frame.motion, EYES_RAD).tolist() for each in (turn, tilt, 0.0)]
        values = np.array([*frame.motion[_ORDER], *eyes], ">f4").tobytes()
        return [self._head + struct.pack(">ifiiB", self._number % _DAY, 0.0, _RATE, 1, len(values) // 4) + values]
