"""Numbers and addresses as people and programs write them: PORT, or HOST:PORT ([HOST]:PORT for IPv6), else loopback."""

from __future__ import annotations

from typing import Final

from sfms_robot.errors import InputError

LOOPBACK: Final = "127.0.0.1"
HIGHEST_PORT: Final = 65535
LONGEST_NUMBER: Final = 20  # digits: those of 2**64. Python itself refuses from 4301 on, and floats end at 309


def whole_number(text: str) -> int:
    """Return the whole number that `text` says. Raises an InputError of one line for another text, or a longer number.

    Also for `json.loads(parse_int=...)`: an InputError is a ValueError too.
    """
    digits = text.lstrip("+-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= LONGEST_NUMBER):
        got = text if len(text) <= LONGEST_NUMBER else f"{text[:8]}... ({len(digits)} characters)"
        raise InputError(f"expected a whole number of up to {LONGEST_NUMBER} digits, got {got}")
    return int(text)


def port_number(text: str, least: int = 0) -> int | None:
    """Return a TCP or UDP port from `least` on; None for any other text. 0 asks for any that is free."""
    try:
        number = whole_number(text)
    except InputError:
        return None
    return number if least <= number <= HIGHEST_PORT else None


def host_and_port(text: str, least: int = 0) -> tuple[str, int] | None:
    """Host and port of PORT or HOST:PORT; None for another form."""
    host, colon, number = text.rpartition(":")
    port = port_number(number, least)
    if port is None or (colon and not host):
        return None
    return host.strip("[]") if colon else LOOPBACK, port
