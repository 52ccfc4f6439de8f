"""Where something listens, as people type it: PORT, or HOST:PORT ([HOST]:PORT for IPv6), on loopback unless told."""

from __future__ import annotations

from typing import Final

LOOPBACK: Final = "127.0.0.1"
HIGHEST_PORT: Final = 65535


def port_number(text: str, least: int = 0) -> int | None:
    """A TCP or UDP port from `least` on; None for a text that is none. 0 asks for any that is free."""
    if not (text.isascii() and text.isdigit()):
        return None
    number = int(text)
    return number if least <= number <= HIGHEST_PORT else None


def host_and_port(text: str, least: int = 0) -> tuple[str, int] | None:
    """Host and port of PORT or HOST:PORT; None for another form."""
    host, colon, number = text.rpartition(":")
    port = port_number(number, least)
    if port is None or (colon and not host):
        return None
    return host.strip("[]") if colon else LOOPBACK, port
