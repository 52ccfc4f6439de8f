"""An emulated phone, which sends recorded packets of a real phone at their original pace. Also a command:

    python -m sfms_robot.emulator.phone [[HOST:]PORT]

sends to port 11111 of this machine until Ctrl-C.
"""

from __future__ import annotations

import gzip
import math
import socket
import struct
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from sfms_robot.data import data_dir
from sfms_robot.endpoint import LOOPBACK, host_and_port
from sfms_robot.errors import ConfigError

RATE_HZ: Final = 60.0
PORT: Final = 11111
_LENGTH: Final = struct.Struct(">I")


def recorded_packets(path: Path | None = None) -> list[bytes]:
    """Return packets of Live Link Face as the phone sent them; by default those included in this package.

    A file is gzip of one byte, a big-endian uint32 count, and per packet its uint32 length and bytes. Raises
    ConfigError for any other file.
    """
    file = data_dir("sim") / "phones" / "llv" / "packets.gesichter" if path is None else path
    try:
        data = gzip.decompress(file.read_bytes())
        (count,) = _LENGTH.unpack_from(data, 1)
        packets, start = [], 1 + _LENGTH.size
        for _ in range(count):
            (length,) = _LENGTH.unpack_from(data, start)
            start += _LENGTH.size + length
            packets.append(data[start - length : start])
    except (OSError, EOFError, struct.error) as error:
        raise ConfigError(f"{file}: not recorded packets of a phone: {error}") from error
    return packets


def renumbered(packet: bytes, number: int) -> bytes:
    """Return the packet with another frame number."""
    start = 1
    for _ in ("device", "subject"):
        start += _LENGTH.size + _LENGTH.unpack_from(packet, start)[0]
    return packet[:start] + struct.pack(">i", number) + packet[start + 4 :]


class EmulatedPhone:
    """A sender of the packets included in this package; packet i is due at i / `RATE_HZ`.

    The recording is played forwards and backwards in a loop, with increasing numbers. The caller passes the time.
    """

    def __init__(self, host: str = LOOPBACK, port: int = PORT) -> None:
        self.sent = 0
        self._packets = recorded_packets()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._target = (host, port)

    def packet(self, number: int) -> bytes:
        """Return packet `number` of the endless stream."""
        last = len(self._packets) - 1
        place = number % (2 * last)
        return renumbered(self._packets[min(place, 2 * last - place)], number)

    def send_until(self, now_s: float) -> int:
        """Send the packets due by `now_s`; return their number. Does not wait."""
        due = math.floor(now_s * RATE_HZ + 1e-6) + 1
        before = self.sent
        while self.sent < due:
            self._socket.sendto(self.packet(self.sent), self._target)
            self.sent += 1
        return self.sent - before

    def play(
        self,
        duration_s: float = math.inf,
        now_s: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Send at the phone's pace for `duration_s`. Blocks."""
        start_s = now_s()
        while (elapsed_s := now_s() - start_s) < duration_s:
            self.send_until(elapsed_s)
            sleep(max(0.0, self.sent / RATE_HZ - (now_s() - start_s)))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def main(arguments: Sequence[str]) -> None:
    """Send to `[HOST:]PORT` until interrupted. Raises ConfigError."""
    target = arguments[0] if arguments else str(PORT)
    place = host_and_port(target, least=1)
    if place is None:
        raise ConfigError(f"{target!r} is not an address to send to (PORT, HOST:PORT)")
    phone = EmulatedPhone(*place)
    try:
        phone.play()
    except OSError as error:
        raise ConfigError(f"{target!r}: {error.strerror}") from error
    finally:
        phone.close()


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:
        pass
    except ConfigError as problem:
        sys.exit(str(problem))
