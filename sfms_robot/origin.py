"""Which pages of the web may connect to a server of this program, and under which names it answers.

A browser says whose page asks (Origin) and which name it was given for us (Host). A name that somebody else gives to
this machine's address proves nothing: a page of theirs would be of "the same origin". So what is no loopback name must
be an address, or a name that no stranger can own: one of the local network (.local, RFC 6762), or this machine's own.
"""

from __future__ import annotations

import hmac
import ipaddress
import socket
from urllib.parse import urlsplit


def origin_problem(origin: str | None, host: str) -> str | None:
    """Why a page may not connect; None where it may, or where who connects is no browser (`origin` None).

    `host`: what the request calls us, with or without a port.
    """
    if origin is None:
        return None
    page, here = _host(origin), _host(f"//{host}")
    if page == "localhost" or (page is not None and is_loopback(page)):
        return None
    if page is not None and page == here and _is_ours(page):
        return None
    return f"a page of {origin[:80]!r} may not connect"


def host_problem(host: str) -> str | None:
    """Why a request that calls us `host` is not answered; None where it is."""
    name = _host(f"//{host}")
    return None if name is not None and (name == "localhost" or _is_ours(name)) else f"{host[:80]!r} is not here"


def token_admits(shown: str, token: str | None) -> bool:
    """Whether who shows this may come in; `token` None: everybody. Takes as long for any wrong one."""
    return token is None or hmac.compare_digest(shown.encode(), token.encode())


def is_loopback(host: str) -> bool:
    """Whether `host` is an address of this machine alone."""
    address = _address(host)
    return address is not None and address.is_loopback


def _host(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _is_ours(name: str) -> bool:
    return _address(name) is not None or name.endswith(".local") or name == socket.gethostname().lower()


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
