"""Addresses: parsing them, listening at them, and which clients a server of this program admits.

A browser sends the origin of its page (Origin) and the name by which it reached this machine (Host). That both are
equal proves nothing: a stranger can let a name of their own point to this machine's address, and their page would then
be of "the same origin". So a host that is not loopback must be an address, or a name that no stranger can own: one of
the local network (.local, RFC 6762), or this machine's own name.
"""

from __future__ import annotations

import errno
import hmac
import ipaddress
import socket
import struct
import sys
import threading
from contextlib import suppress
from typing import Final
from urllib.parse import urlsplit

from sfms_robot.errors import InputError, PortError

LOOPBACK: Final = "127.0.0.1"
HIGHEST_PORT: Final = 65535
LONGEST_NUMBER: Final = 20  # digits, as in 2**64. Python refuses 4301 digits and more; floats end at 309


def whole_number(text: str) -> int:
    """Return the whole number in `text`. Raises InputError, in one line, for any other text or a longer number.

    It can also be used as `json.loads(parse_int=...)`, since InputError is a ValueError.
    """
    digits = text.lstrip("+-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= LONGEST_NUMBER):
        got = text if len(text) <= LONGEST_NUMBER else f"{text[:8]}... ({len(digits)} characters)"
        raise InputError(f"expected a whole number of up to {LONGEST_NUMBER} digits, got {got}")
    return int(text)


def port_number(text: str, least: int = 0) -> int | None:
    """Return the TCP or UDP port in `text`, `least` or higher; None for any other text. 0 requests any free port."""
    try:
        number = whole_number(text)
    except InputError:
        return None
    return number if least <= number <= HIGHEST_PORT else None


def host_and_port(text: str, least: int = 0) -> tuple[str, int] | None:
    """Return (host, port) of PORT (on loopback), HOST:PORT or [HOST]:PORT (IPv6); None for any other form."""
    host, colon, number = text.rpartition(":")
    port = port_number(number, least)
    if port is None or (colon and not host):
        return None
    return host.strip("[]") if colon else LOOPBACK, port


def address_text(host: str, port: int) -> str:
    """Return an address as HOST:PORT, with an IPv6 host in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def listen(flag: str, host: str, port: int, others: int = 0) -> socket.socket:
    """Return a TCP socket that listens at an address, or on the first free one of the next `others` ports.

    Port 0 means any free port; it is also tried last unless `others` is 0. `flag` is the option that the error names.
    Raises PortError.
    """
    ports = [*range(port, min(port + others, HIGHEST_PORT + 1)), 0] if port and others else [port]
    for each in ports:
        try:
            family, _, _, _, where = socket.getaddrinfo(host, each, type=socket.SOCK_STREAM)[0]
            return socket.create_server(where[:2], family=family, backlog=128)
        except (OSError, UnicodeError) as error:
            code = getattr(error, "errno", None)
            if each != ports[-1] and code in (errno.EADDRINUSE, errno.EACCES):
                continue
            used = "is used by another program (choose another port; 0: any free one)"
            problem = used if code == errno.EADDRINUSE else getattr(error, "strerror", None) or error
            raise PortError(f"{flag}: TCP port {each} on {host}: {problem}") from error
    raise AssertionError("no port was tried")


def leads_here(address: str, port: int) -> bool:
    """Return whether HOST:PORT is this machine at `port`. Sends no query to a name server."""
    host, at = host_and_port(address.lower()) or ("", 0)
    name = socket.gethostname().lower()
    named = host in ("localhost", name, f"{name}.local", "0.0.0.0", "::", *addresses_of_this_machine())
    return at == port and (named or is_loopback(host))


def connect(address: str) -> socket.socket:
    """Return a connection to HOST:PORT, without Nagle's delay, or to a socket in the file system. Raises OSError."""
    place = host_and_port(address)
    if place is None:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(address)
        except OSError:
            connection.close()
            raise
        return connection
    connection = socket.create_connection(place)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def origin_problem(origin: str | None, host: str) -> str | None:
    """Return the reason why a page may not connect; None if it may.

    `origin` is None for clients that are not browsers, which may connect. `host`: the name of this machine in the
    request, with or without a port.
    """
    if origin is None:
        return None
    page = _host(origin)
    if page == "localhost" or (
        page is not None and (is_loopback(page) or (page == _host(f"//{host}") and _ours(page)))
    ):
        return None
    return f"a page of {origin[:80]!r} may not connect"


def host_problem(host: str) -> str | None:
    """Return the reason to refuse a request that names this machine `host`; None if it is accepted."""
    name = _host(f"//{host}")
    return None if name is not None and (name == "localhost" or _ours(name)) else f"{host[:80]!r} is not here"


def token_admits(given: str, token: str | None) -> bool:
    """Return whether a client is admitted; `token` None admits any. The time is the same for all wrong tokens."""
    return token is None or hmac.compare_digest(given.encode(), token.encode())


def is_loopback(host: str) -> bool:
    """Return whether `host` is a loopback address, which only this machine can reach."""
    address = _address(host)
    return address is not None and address.is_loopback


def is_address(host: str) -> bool:
    """Return whether `host` is an IPv4 or IPv6 address, not a name."""
    return _address(host) is not None


def _host(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _ours(name: str) -> bool:
    return is_address(name) or name.endswith(".local") or name == socket.gethostname().lower()


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def addresses_of_this_machine() -> list[str]:
    """Return the IPv4 addresses by which other machines may reach this one; empty if unknown. Sends nothing."""
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


class ServerThread:
    """A thread with an event loop for a server, whose address is bound from construction until `close`.

    A subclass defines `_serve`, which serves `_socket` and returns soon after `_closing` is set.

    Args: `flag`, `host`, `port` as for `listen`. Raises PortError.

    Attributes:
        address: the bound host and port.
    """

    def __init__(self, flag: str, host: str, port: int, stop_s: float) -> None:
        import asyncio  # slow to load, and most users of this module have no server

        self._socket, self._stop_s = listen(flag, host, port), stop_s
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name=flag, daemon=True)

    def start(self) -> None:
        """Accept connections from now on. Idempotent."""
        if self._thread.ident is None:
            self._thread.start()

    def close(self) -> None:
        """Close every connection and release the port. Blocks `stop_s` at most. Idempotent."""
        if self._thread.ident is None:
            self._loop.close()
            self._socket.close()
        elif self._thread.is_alive():
            with suppress(RuntimeError):  # the thread has ended meanwhile
                self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join(self._stop_s)

    async def _serve(self) -> None:
        raise NotImplementedError

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()
            self._socket.close()
