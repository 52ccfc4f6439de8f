"""The face of a live person: the value of `--face`, conversion of a tracker's faces to `Sighting`s, and UDP senders.

The flag is `--face KIND[:PLACE][,flip=CHANNEL+CHANNEL]`. PLACE depends on the kind: a UDP port, a camera. `flip`
inverts pose channels that a tracker sends with the opposite sign: `live-link:11111,flip=yaw+roll`.
"""

from __future__ import annotations

import errno
import logging
import math
import re
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any, Final

import numpy as np

from sfms_robot.endpoint import HIGHEST_PORT, LOOPBACK, address_text, host_and_port, is_address, is_loopback
from sfms_robot.errors import NOTE, ConfigError, PacketError, PortError, Said
from sfms_robot.frames import (
    BLENDSHAPES,
    BLINKS,
    CHANNELS,
    MOTION_DIM,
    NEUTRAL,
    POSE,
    POSE_CHANNELS,
    SHAPES,
    Doubles,
    FaceFrame,
    Floats,
    Sighting,
    clip_shapes,
)
from sfms_robot.ports import Facts
from sfms_robot.signals.face_units import LiveUnits, beyond
from sfms_robot.signals.rotations import angles_of, rotation
from sfms_robot.sources.live_voice import Clock, SourcePart

logger = logging.getLogger(__name__)

_OPTION: Final = re.compile(r",([a-z]+)=([^,=]*)$")
_WAITING: Final = 256  # faces; the newest are kept
REMEMBERED_S: Final = 120.0
AWAY_S: Final = 10.0
_SAMPLE_S: Final = 0.5
_SAMPLES: Final = int(REMEMBERED_S / _SAMPLE_S)
_EASE_S: Final = 0.5  # time constant with which the rest follows its estimate, so that a face never jumps
_SHAPE_QUANTILE: Final = 0.2
_HIGHEST_REST: Final = 0.5  # a shape held above this is an expression, however long it lasts
_MEDIANS: Final = [i for i, name in enumerate(CHANNELS) if name not in BLENDSHAPES or name.startswith("eyeLook")]

AS_SENT: Final[Floats] = np.ones(len(POSE_CHANNELS), np.float32)  # signs of the pose channels

PACKETS_PER_CALL: Final = 64
LONGEST_CALL_S: Final = 0.002
LONGEST_PACKET: Final = 16_384  # bytes; a longer one is cut off and counts as malformed
LOST_S: Final = 0.5  # five packets of a sender that sends ten a second
SILENT_S: Final = 2.0  # silence before another sender is accepted; delay before a new one's unused data is logged
USUAL_PORTS: Final = {"vmc": 39539, "live-link": 11111}  # suggested by the protocol, and by the app
ANY: Final = ("0.0.0.0", "::")  # every address of this machine
UNHEARD_S: Final = 5.0  # time of a run without a sender after which the log explains how to send
# Packets of other programs, and what to do about them.
_FOREIGN: Final = (
    (rb"/(W|HT|HRQ?|ELR|ERR)\0", "Face Cap in live mode, which has no VMC: use Live Link Face and --face live-link"),
    (rb"/avatar/parameters/", "VRCFaceTracking for VRChat, which is not VMC: let VRCFTtoVMCP turn it into VMC"),
    (rb"[A-Za-z_]+[-&]\d+\|", "iFacialMocap's own format: in its desktop app, switch on sending of VMC Protocol"),
    (rb"(#bundle\0.{12})?/VMC/", "VMC: --face vmc takes it"),
    (rb"\x06\0\0\0.\$?[\w-]{4}", "Live Link Face: --face live-link takes it"),
    (rb"\s*\{", "JSON, which is not read here: choose Live Link Face or VMC in the app that sends it"),
)

# Linux reports when a datagram arrived, in nanoseconds of the wall clock; Python has no name for the socket option.
_SO_TIMESTAMPNS: Final = 35
_TIMESPEC: Final = struct.Struct("@ll")
_OLDEST_S: Final = 5.0  # if a datagram seems older, or from the future, the wall clock was set in the meantime


def parse_face_argument(kind: str, argument: str) -> tuple[str, Floats]:
    """Return PLACE ("" if it is missing) and the signs (6,) of the pose channels: -1 for those to flip, else 1.

    `argument`: the text after `KIND:`. Raises ConfigError for an unknown option or channel.
    """
    place, given = split_options(f"--face {kind}", argument, "flip")
    return place, pose_signs(kind, given)


def split_options(flag: str, argument: str, *known: str) -> tuple[str, list[tuple[str, str]]]:
    """Return an argument without its options (`,name=value`), and the options, the last one first.

    Raises ConfigError for an option that is not `known`.
    """
    given = []
    while option := _OPTION.search(argument):
        name, value = option.groups()
        if name not in known:
            raise ConfigError(f"{flag}: option {name!r} is not known ({', '.join(known)})")
        given.append((name, value))
        argument = argument[: option.start()]
    return argument, given


def pose_signs(kind: str, options: Iterable[tuple[str, str]]) -> Floats:
    """Return the sign of each pose channel, from the options `flip` of `--face KIND`. Raises ConfigError."""
    signs = AS_SENT.copy()
    for channel in [each for name, value in options if name == "flip" for each in value.split("+")]:
        if channel not in POSE_CHANNELS:
            raise ConfigError(
                f"--face {kind}: flip = {channel!r}: expected a pose channel (valid: {', '.join(POSE_CHANNELS)})"
            )
        signs[POSE_CHANNELS.index(channel)] = -1.0
    return signs


class LiveFace(SourcePart):
    """A `ports.Sight` of faces passed to `put`: motion (58,) with its time, made relative to the person's rest.

    Several faces between two calls of `at` become one: the newest, with the strongest blink of all, so that no blink is
    lost between frames. All methods may be called from any thread.

    signs: (6,) factors of the pose channels.
    """

    def __init__(self, signs: Floats = AS_SENT, now: Clock = time.monotonic) -> None:
        super().__init__(now)
        self._signs = signs
        self._rest = RestingFace()
        self._waiting = deque[tuple[float, Floats, Floats | None]](maxlen=_WAITING)
        self._sighting: Sighting | None = None

    def start(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`. The person's rest is kept."""
        with self._lock:
            self._origin_s, self._sighting = origin_s, None

    def forget(self) -> None:
        """Forget the person's rest, for another camera or another person."""
        with self._lock:
            self._rest = RestingFace()

    def put(self, time_s: float, motion: Floats, place_m: Floats | None = None) -> None:
        """Add a face (58,) seen at `time_s` of `time.monotonic`, in order of time; `place_m`: see `Sighting`."""
        with self._lock:
            self._waiting.append((time_s, motion, place_m))

    def at(self, time_s: float) -> Sighting | None:
        """Return the newest sighting; see `ports.Sight.at`."""
        with self._lock:
            seen = []
            while self._waiting and self._waiting[0][0] - self._origin_s <= time_s:
                seen.append(self._waiting.popleft())
            if seen:
                seen_s, newest, place_m = seen[-1]
                motion = newest.copy()
                motion[BLINKS] = np.max([each[BLINKS] for _, each, _ in seen], axis=0)
                motion[POSE] *= self._signs
                # The rest is learned in monotonic time, so that a new loop time 0 does not interrupt learning.
                face = FaceFrame.of(seen_s - self._origin_s, self._rest.relative(motion, seen_s))
                self._sighting = Sighting(face, place_m=place_m)
            return self._sighting


# --- a person's face at rest, learned while they are seen ---------------------------------------------------------
#
# A camera looks from the side or from below, and no face rests at zero. So the pose that a person holds most counts as
# straight ahead, and a blendshape is measured from its resting level: (v - rest) / (1 - rest).
#
# Rest is a quantile of the last two minutes, one sample every half second: the median of pose and gaze, which move both
# ways, and a low quantile of all other shapes, which only rise. It exists from the first face on, computed from the
# samples so far. So:
#
# - a camera's angle and a face's offset are removed 3 s after the first face, and 80 s after the camera was moved;
# - a pose or gaze held for less than half of the remembered time, and another shape held for less than four fifths of
#   it, does not become rest: for the former that is a minute once two minutes have been seen;
# - a face that was away for 10 s may come back as another person: learning begins again.


class RestingFace:
    """The face of one person at rest, learned from all faces so far.

    Attributes:
        samples: (n, 58) newest last, n <= 240.
    """

    def __init__(self) -> None:
        self.samples: Floats = np.zeros((0, MOTION_DIM), dtype=np.float32)
        self._estimate: Floats = NEUTRAL
        self._rest = self._estimate  # follows the estimate slowly
        self._seen_s = self._sampled_s = -math.inf

    def relative(self, motion: Floats, time_s: float) -> Floats:
        """Return a face (58,) of `time_s` relative to the person's rest, (58,); faces come in order of time.

        Shapes stay within 0..1.
        """
        motion = np.asarray(motion, dtype=np.float32)
        known = 0 <= time_s - self._seen_s <= AWAY_S
        if not known or time_s - self._sampled_s >= _SAMPLE_S:
            before = self.samples[1 - _SAMPLES :] if known else self.samples[:0]
            self.samples, self._sampled_s = np.concatenate([before, motion[None]]), time_s
            self._estimate = _rest(self.samples)
        if known:
            follow = 1.0 - math.exp((self._seen_s - time_s) / _EASE_S)
            self._rest = self._rest + np.float32(follow) * (self._estimate - self._rest)
        else:
            self._rest = self._estimate
        self._seen_s = time_s
        # The pose relative to the resting pose, R0^T R, and the shapes above their resting level.
        out, rest = NEUTRAL.copy(), self._rest
        both: Doubles = np.stack([rest[POSE], motion[POSE]]).astype(np.float64)
        at_rest, now = rotation(both[:, :3])
        out[POSE][:3] = angles_of(at_rest.T @ now)
        out[POSE][3:] = at_rest.T @ (both[1, 3:] - both[0, 3:])
        level = rest[SHAPES]
        out[SHAPES] = np.clip((motion[SHAPES] - level) / (1.0 - level), 0.0, 1.0)
        return out


def _rest(samples: Floats) -> Floats:
    """Return the rest (58,) of samples (n, 58)."""
    low, middle = int(_SHAPE_QUANTILE * (len(samples) - 1)), (len(samples) - 1) // 2
    ranked = np.partition(samples, (low, middle), axis=0)
    rest: Floats = np.clip(ranked[low], 0.0, _HIGHEST_REST)
    rest[_MEDIANS] = ranked[middle, _MEDIANS]
    rest[SHAPES] = np.minimum(rest[SHAPES], _HIGHEST_REST)
    return rest


# --- a face that arrives as UDP datagrams, of any protocol -----------------------------------------------------------
#
# `at` reads the socket without blocking and for a bounded time: it needs no thread, and a flood of packets costs the
# loop 2 ms a call plus one packet. Unusable packets are counted and never raise. One sender is used: another is refused
# until the first has been silent for `SILENT_S`.

Address = tuple[Any, ...]


def _bound(kind: str, host: str, port: int) -> socket.socket:
    """Return a UDP socket that does not block. Raises PortError when it cannot be bound."""
    where = f"--face {kind}: UDP port {port} on {host}"
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        bound = socket.socket(family, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise PortError(f"{where}: {getattr(error, 'strerror', None) or error}") from error
    try:
        bound.bind(address)
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            raise PortError(f"{where} is used by another program ({kind}:PORT takes another)") from error
        raise PortError(f"{where}: {error.strerror or error}") from error
    bound.setblocking(False)
    return bound


def _age_s(extra: list[tuple[int, int, bytes]], wall_s: float) -> float:
    for level, kind, stamp in extra:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(stamp) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(stamp)
            age_s = wall_s - seconds - 1e-9 * nanoseconds
            return float(age_s) if 0.0 <= age_s <= _OLDEST_S else 0.0
    return 0.0


def foreign(data: bytes) -> str | None:
    """Return which program sends such a packet and what to change in it; None: unknown."""
    return next((text for pattern, text in _FOREIGN if re.match(pattern, data, re.DOTALL)), None)


class Decoder:
    """Reader of the packets of one sender.

    Attributes:
        blind: True if the sender reports that it sees no face.
    """

    blind = False

    def restart(self) -> None:
        """Forget the last sender before another one begins."""

    def decode(self, data: bytes, time_s: float) -> Floats | None:
        """Return motion (58,) of a packet, in the sender's units; None: it has no new face. Raises PacketError."""
        raise NotImplementedError

    def due(self, time_s: float) -> Floats | None:
        """Return motion (58,) that counts as complete by `time_s` although no packet marked its end, or None."""
        return None

    def remark(self) -> str | None:
        """Return one line about data of this sender that is not used, or None."""
        return None

    def statistics(self) -> Facts:
        return {}


class UdpSight(LiveFace):
    """`ports.Sight` of `--face KIND[:PORT|HOST[:PORT]][,flip=...]`: one person, seen by another device.

    The time from the lens to the network is not known here.

    Args:
        hint: returns what the user has to do so that packets arrive, from the bound host and port and the flag that
            would also accept packets of other machines ("" if the present flag does).
        units: decides the units of each sender over its first second, in which no face is shown; None: our units.

    Attributes:
        address: host and port that are bound.
        lost: True after half a second without a face and without a report that no face is seen.

    Raises ConfigError for an argument that cannot be used and PortError for a port that cannot be bound.
    """

    def __init__(
        self,
        kind: str,
        argument: str,
        decoder: Decoder,
        hint: Callable[[str, int, str], str],
        units: LiveUnits | None = None,
    ) -> None:
        place, signs = parse_face_argument(kind, argument)
        super().__init__(signs)
        self._kind, self._decoder, self._units = kind, decoder, units
        self._socket = _bound(kind, *parse_endpoint(kind, place))
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        if sys.platform == "linux":
            with suppress(OSError):  # without stamps of the system, a packet counts from when it is read
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        host, port = self.address
        wider = f"--face {kind}:{ANY[0]}" + ("" if port == USUAL_PORTS[kind] else f":{port}")
        self._hint: str | None = hint(host, port, wider if is_loopback(host) else "")
        self._sender: Address | None = None
        self._before: Address | None = None  # the sender's address before its port changed
        self._other: Address | None = None  # a second program on the sender's machine
        self._heard_s = self._result_s = -math.inf
        self._remark_s = math.inf  # when to log which data of this sender is not used
        self._said = Said()
        self._refusal_said = False
        self._counts = dict.fromkeys(("packets", "faces", "malformed", "refused", "errors"), 0)
        logger.log(NOTE, "%s: %s", kind, self._hint)

    def at(self, time_s: float) -> Sighting | None:
        for packet in self._packets():
            self.feed(*packet)
        now_s = self._origin_s + time_s
        if self._sender is not None and (motion := self._decoder.due(now_s)) is not None:
            self._show(motion, self._heard_s)
        self.lost = self._sender is not None and now_s - self._result_s > LOST_S
        if self._hint is not None and time_s > UNHEARD_S and not self._counts["packets"]:
            logger.warning("%s: no packets yet: %s", self._kind, self._hint)
            self._hint = None
        return super().at(time_s)

    def feed(self, data: bytes, sender: Address, time_s: float) -> None:
        """Process one packet, of any sender, that arrived at `time_s` of `time.monotonic`. Never raises."""
        self._counts["packets"] += 1
        if self._is_sender(sender):
            time_s = max(time_s, self._heard_s)  # the clock of the stamps may be set back; time here may not
        else:
            if time_s - self._heard_s < SILENT_S:
                self._refuse(sender)
                return
            self._sender = self._before = self._other = None
            self._decoder.restart()
        try:
            motion = self._decoder.decode(data, time_s)
        except PacketError as error:
            self._leave_out(str(error), sender)
            return
        if self._sender is None:
            logger.info("%s: packets come from %s", self._kind, address_text(*sender[:2]))
            self._refusal_said = False
            self._result_s, self._remark_s = time_s, time_s + SILENT_S
            if self._units is not None:
                self._units.restart()
            self.forget()
        self._sender, self._heard_s, self._hint = sender, time_s, None
        if motion is not None:
            self._show(motion, time_s)
        elif self._decoder.blind:
            self._result_s = time_s
        self._remark(time_s)

    def statistics(self) -> Facts:
        """Return counts of packets, faces, malformed and refused packets, errors; the sender; the decoder's counts."""
        sender = None if self._sender is None else address_text(*self._sender[:2])
        return {**self._counts, "sender": sender, **self._decoder.statistics()}

    def close(self) -> None:
        """Close the port. Idempotent."""
        self._socket.close()

    def _packets(self) -> Iterator[tuple[bytes, Address, float]]:
        """Yield received packets as arguments of `feed`, oldest first, no more than one call may process.

        Times are those of arrival if the system reports them, else those of reading. Never blocks, never raises.
        """
        wall_s, now_s = time.time(), time.monotonic()
        for _ in range(PACKETS_PER_CALL):
            try:
                if sys.platform == "win32":
                    data, sender = self._socket.recvfrom(LONGEST_PACKET)
                    age_s = 0.0
                else:
                    data, extra, _, sender = self._socket.recvmsg(LONGEST_PACKET, 64)
                    age_s = _age_s(extra, wall_s)
            except BlockingIOError:
                return
            except OSError:  # the network went down: the next call tries again
                self._counts["errors"] += 1
                return
            yield data, sender, now_s - age_s
            if time.monotonic() - now_s > LONGEST_CALL_S:
                return

    def _is_sender(self, sender: Address) -> bool:
        """Return whether this is the sender in use, by its host, because some senders open a new port for each packet.

        If a port is used again after another one, two programs send from the same host; the first one is used.
        """
        if self._sender is None or sender[0] != self._sender[0] or sender == self._other:
            return False
        if sender != self._sender:
            self._other = self._sender if sender == self._before else None
            self._before, self._sender = self._sender, sender
        return True

    def _show(self, motion: Floats, time_s: float) -> None:
        """Convert a face (58,) from the sender's units, once they are known, and put it."""
        ours: Floats | None = motion
        if self._units is not None:
            ours, units = self._units.take(motion, time_s), self._units.units
            if ours is None and (wrong := beyond(units.ours(motion))) is not None:
                self._leave_out(wrong, self._sender)
                return
            if units.line:
                self._say("%s: in packets of %s %s (said once)", units.line)
        self._result_s = time_s
        if ours is not None:
            self._counts["faces"] += 1
            clip_shapes(ours)
            self.put(time_s, ours)

    def _remark(self, time_s: float) -> None:
        """Log which data of this sender is not used, some seconds after its first packet."""
        if time_s < self._remark_s:
            return
        self._remark_s = math.inf
        if (remark := self._decoder.remark()) is not None:
            self._say("%s: of packets of %s: %s (said once)", remark)
        elif time_s - self._result_s > UNHEARD_S:
            self._say("%s: packets come from %s, but no face: %s (said once)", "they repeat one frame")
        else:
            self._remark_s = time_s + UNHEARD_S

    def _refuse(self, sender: Address) -> None:
        self._counts["refused"] += 1
        if not self._refusal_said and self._sender is not None:
            first = address_text(*self._sender[:2])
            text = "%s: %s sends too and is refused until %s is silent for %g s (said once)"
            logger.warning(text, self._kind, address_text(*sender[:2]), first, SILENT_S)
            self._refusal_said = True

    def _leave_out(self, reason: str, sender: Address | None) -> None:
        self._counts["malformed"] += 1
        self._say("%s: packets of %s are left out: %s (said once)", reason, sender)

    def _say(self, text: str, reason: str, sender: Address | None = None) -> None:
        """Log `text` with its reason, a few reasons at most, each once."""
        if self._said.first(reason):
            at = address_text(*(sender or self._sender or ("?", 0))[:2])
            logger.warning(text, self._kind, at, reason)


def parse_endpoint(kind: str, place: str) -> tuple[str, int]:
    """Return host and port of PORT, HOST:PORT ([HOST]:PORT for IPv6) or an address alone.

    Parts that PLACE leaves out are loopback and the kind's usual port. Raises ConfigError.
    """
    if not place:
        return LOOPBACK, USUAL_PORTS[kind]
    if is_address(place.strip("[]")):
        return place.strip("[]"), USUAL_PORTS[kind]
    found = host_and_port(place, least=1)
    if found is None:
        choices = f"{kind}, {kind}:PORT, {kind}:HOST:PORT, {kind}:ADDRESS; PORT 1 to {HIGHEST_PORT}"
        raise ConfigError(f"--face {kind}:{place}: {place!r}: expected a UDP port (valid: {choices})")
    return found
