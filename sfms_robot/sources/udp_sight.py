"""A face that comes as UDP datagrams, whatever protocol they speak.

The socket is read without blocking inside `at`, for a bounded time: no thread, and a flood costs the loop 2 ms a call
and one packet. What cannot be used is counted, never raised. One sender is listened to: another is refused until
the first has been silent for 2 s.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple, Protocol

from sfms_robot.endpoint import HIGHEST_PORT, LOOPBACK, host_and_port
from sfms_robot.errors import ConfigError, PacketError, PortError
from sfms_robot.frames import Floats, Sighting
from sfms_robot.origin import is_loopback
from sfms_robot.sources.live_face import LiveFace, parse_face_argument

logger = logging.getLogger(__name__)

PACKETS_PER_CALL: Final = 64
LONGEST_CALL_S: Final = 0.002
LONGEST_PACKET: Final = 16_384  # bytes; a longer one is cut off and counts as malformed
LOST_S: Final = 0.5  # five packets of one that sends ten a second
SILENT_S: Final = 2.0  # after so long another sender may take over
ANY: Final = ("0.0.0.0", "::")  # every address of this machine
UNHEARD_S: Final = 5.0  # so long into a run without a sender, what to type there is said
_REASONS_SAID: Final = 4

# Linux tells when a datagram came in, to the nanosecond of the wall clock; Python has no name for the option.
_SO_TIMESTAMPNS: Final = 35
_TIMESPEC: Final = struct.Struct("@ll")
_OLDEST_S: Final = 5.0  # a datagram that seems older, or of the future: the wall clock was set meanwhile

Address = tuple[Any, ...]


class Datagram(NamedTuple):
    """One packet. `time_s`: of `time.monotonic` when it came in, where the system tells; when it was read elsewhere."""

    data: bytes
    sender: Address
    time_s: float


class DatagramSocket:
    """A UDP socket that is read without blocking. Raises PortError when it cannot be bound.

    Attributes:
        address: host and port it is bound to.
        errors: times the system could not read, as when a network goes down.
    """

    def __init__(self, kind: str, host: str, port: int) -> None:
        """`kind`: what `--face` calls it, for the error's text."""
        self.errors = 0
        where = f"--face {kind}: UDP port {port} on {host}"
        try:
            family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:  # a name that is none is the latter
            raise PortError(f"{where}: {getattr(error, 'strerror', None) or error}") from error
        try:
            self._socket.bind(address)
            self._socket.setblocking(False)
            bound = self._socket.getsockname()
            self.address: tuple[str, int] = (str(bound[0]), int(bound[1]))
            self._stamped = sys.platform == "linux" and _ask_for_stamps(self._socket)
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                raise PortError(f"{where} is used by another program ({kind}:PORT takes another)") from error
            raise PortError(f"{where}: {error.strerror or error}") from error

    def waiting(self) -> Iterator[Datagram]:
        """What has come in, oldest first, no more than a call may take. Never blocks, never raises."""
        wall_s, now_s = time.time(), time.monotonic()
        for _ in range(PACKETS_PER_CALL):
            try:
                if sys.platform == "win32":
                    data, sender = self._socket.recvfrom(LONGEST_PACKET)
                    age_s = 0.0
                else:
                    data, extra, _, sender = self._socket.recvmsg(LONGEST_PACKET, 64 if self._stamped else 0)
                    age_s = _age_s(extra, wall_s)
            except BlockingIOError:
                return
            except OSError:  # a network that went down: the next call tries again
                self.errors += 1
                return
            yield Datagram(data, sender, now_s - age_s)
            if time.monotonic() - now_s > LONGEST_CALL_S:
                return

    def close(self) -> None:
        self._socket.close()


def _ask_for_stamps(of: socket.socket) -> bool:
    try:
        of.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    except OSError:
        return False
    return True


def _age_s(extra: list[tuple[int, int, bytes]], wall_s: float) -> float:
    for level, kind, stamp in extra:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(stamp) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(stamp)
            age_s = wall_s - seconds - 1e-9 * nanoseconds
            return float(age_s) if 0.0 <= age_s <= _OLDEST_S else 0.0
    return 0.0


class Decoder(Protocol):
    """What one sender says, packet by packet."""

    def restart(self) -> None:
        """Another sender begins: nothing of the last one holds."""

    def decode(self, data: bytes, time_s: float) -> Floats | None:
        """A packet -> motion (58,), or None: it tells no new face. Raises PacketError for what is none of ours."""

    def statistics(self) -> Mapping[str, Any]: ...


class UdpSight:
    """`ports.Sight` of one person who is seen by another device. What lies between lens and wire nobody tells here.

    hint: what a person has to do when nobody sends, in words.

    Attributes:
        lost: who sent is silent.
    """

    duration_s: float | None = None
    latency_s = 0.0

    def __init__(self, kind: str, opened: DatagramSocket, decoder: Decoder, face: LiveFace, hint: str) -> None:
        self._kind = kind
        self._socket = opened
        self._decoder = decoder
        self._face = face
        self._hint: str | None = hint
        self._sender: Address | None = None
        self._heard_s, self._origin_s = -float("inf"), 0.0
        self.lost = False
        self._said: set[str] = set()
        self._refusal_said = False
        self._counts = dict.fromkeys(("packets", "faces", "malformed", "refused"), 0)
        logger.warning("%s: %s", kind, hint)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port that are listened on."""
        return self._socket.address

    def start(self, origin_s: float) -> None:
        self._origin_s = origin_s
        self._face.start(origin_s)

    def at(self, time_s: float) -> Sighting | None:
        for packet in self._socket.waiting():
            self.feed(packet)
        self.lost = self._sender is not None and self._origin_s + time_s - self._heard_s > LOST_S
        if self._hint is not None and time_s > UNHEARD_S:
            logger.warning("%s: nobody sends yet: %s", self._kind, self._hint)
            self._hint = None
        return self._face.at(time_s)

    def feed(self, packet: Datagram) -> None:
        """One packet, from wherever it came. Never raises."""
        self._counts["packets"] += 1
        # Stamps come from a clock that may be set: time goes forward here.
        time_s = max(packet.time_s, self._heard_s) if packet.sender == self._sender else packet.time_s
        if packet.sender != self._sender:
            if time_s - self._heard_s < SILENT_S:
                self._refuse(packet.sender)
                return
            self._sender = None
            self._decoder.restart()
        try:
            motion = self._decoder.decode(packet.data, time_s)
        except PacketError as error:
            self._counts["malformed"] += 1
            self._say(str(error), packet.sender)
            return
        if self._sender is None:
            logger.info("%s: %s is listened to", self._kind, _name(packet.sender))
            self._refusal_said = False
            self._face.forget()
        self._sender, self._heard_s, self._hint = packet.sender, time_s, None
        if motion is not None:
            self._counts["faces"] += 1
            self._face.put(time_s, motion)

    def statistics(self) -> dict[str, Any]:
        """Packets, and of these faces, malformed ones, a second sender's; the sender; what its protocol counts."""
        sender = None if self._sender is None else _name(self._sender)
        return {**self._counts, "errors": self._socket.errors, "sender": sender, **self._decoder.statistics()}

    def close(self) -> None:
        """Give the port back. Idempotent."""
        self._socket.close()

    def _refuse(self, sender: Address) -> None:
        self._counts["refused"] += 1
        if not self._refusal_said and self._sender is not None:
            first = _name(self._sender)
            text = "%s: %s sends too and is refused: %s is listened to until it is silent for %g s (said once)"
            logger.warning(text, self._kind, _name(sender), first, SILENT_S)
            self._refusal_said = True

    def _say(self, reason: str, sender: Address) -> None:
        if reason not in self._said and len(self._said) < _REASONS_SAID:
            logger.warning("%s: packets of %s are left out: %s (said once)", self._kind, _name(sender), reason)
            self._said.add(reason)


def _name(sender: Address) -> str:
    return f"{sender[0]}:{sender[1]}"


def addresses_of_this_machine() -> list[str]:
    """IPv4 addresses under which other machines may find this one; sends nothing. Empty where they cannot be told."""
    if sys.platform != "linux":
        try:
            found = socket.gethostbyname_ex(socket.gethostname())[2]
        except OSError:
            return []
        return [address for address in found if not address.startswith("127.")]
    import fcntl

    addresses = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            try:
                answer = fcntl.ioctl(asked, 0x8915, struct.pack("256s", name.encode()[:15]))  # SIOCGIFADDR
            except OSError:  # an interface without an address
                continue
            addresses.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in addresses if not address.startswith("127.")]


def open_udp_sight(
    kind: str, argument: str, usual_port: int, decoder: Decoder, hint: Callable[[str, int, str], str]
) -> UdpSight:
    """Open `--face KIND[:PORT|HOST[:PORT]][,flip=...]`.

    `hint`: returns what a person has to do when no packets come, for the bound host and port, and for the flag that
    would also take packets from other machines ("" where this one does).

    Raises ConfigError for an argument that cannot be used and PortError for a port that is taken.
    """
    given = parse_face_argument(kind, argument)
    opened = DatagramSocket(kind, *parse_endpoint(kind, given.place, usual_port))
    host, port = opened.address
    wider = f"--face {kind}:{ANY[0]}" + ("" if port == usual_port else f":{port}")
    return UdpSight(kind, opened, decoder, LiveFace(given.signs), hint(host, port, wider if is_loopback(host) else ""))


def parse_endpoint(kind: str, place: str, port: int) -> tuple[str, int]:
    """Return host and port of PORT, HOST:PORT ([HOST]:PORT for IPv6) or an address alone.

    Loopback and `port` are what PLACE leaves out. Raises ConfigError.
    """
    if not place:
        return LOOPBACK, port
    if _is_address(place.strip("[]")):
        return place.strip("[]"), port
    found = host_and_port(place, least=1)
    if found is None:
        choices = f"{kind}, {kind}:PORT, {kind}:HOST:PORT, {kind}:ADDRESS; PORT 1 to {HIGHEST_PORT}"
        raise ConfigError(f"--face {kind}:{place}: {place!r} is no UDP port ({choices})")
    return found


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
