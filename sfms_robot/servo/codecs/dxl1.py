"""What Dynamixel Protocol 1.0 puts into the FF FF frame: bulk read, sync write, and the bits of the error byte.

Words travel low byte first. There is no sync read, and a bulk read only on the MX series. Parameters begin at byte 5:

    SYNC WRITE (83)  start address, length L, then id and L bytes of data of each; to id FE, nobody answers
    BULK READ (92)   00, then length, id, start address of each: in this order, unlike everywhere else; to id FE, one
                     status of each in the order asked, each waiting for the one before it

Source: ROBOTIS e-manual, docs/en/dxl/protocol1.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

BULK_READ: Final = 0x92

# Bits of the error byte. Some say what was wrong with the request, the others what is wrong with the servo.
VOLTAGE: Final = 0x01
ANGLE_LIMIT: Final = 0x02
OVERHEATING: Final = 0x04
RANGE: Final = 0x08
CHECKSUM: Final = 0x10
OVERLOAD: Final = 0x20
INSTRUCTION: Final = 0x40  # bit 7 is always 0

REFUSALS: Final[Mapping[int, str]] = {
    ANGLE_LIMIT: "angle limit error",
    RANGE: "range error",
    CHECKSUM: "checksum error",
    INSTRUCTION: "instruction error",
}
REFUSAL_BITS: Final = ANGLE_LIMIT | RANGE | CHECKSUM | INSTRUCTION


def refusal_text(error: int) -> str:
    """What an error byte says against the request; empty when it was taken."""
    return ", ".join(text for bit, text in REFUSALS.items() if error & bit)


def sync_write_params(address: int, values: Mapping[int, bytes]) -> bytes:
    """Parameters of a sync write: address, length, then id and data of each servo; all data have one length."""
    length = len(next(iter(values.values())))
    return bytes([address, length]) + b"".join(bytes([servo]) + data for servo, data in values.items())


def sync_write_parts(params: bytes) -> tuple[int, Iterator[tuple[int, bytes]]]:
    """(address, (id, data) of each servo); what is left over behind the last whole part is ignored.

    Raises IndexError when address or length are missing.
    """
    address, length = params[0], params[1]
    starts = range(2, len(params) - length, length + 1)
    return address, ((params[i], params[i + 1 : i + 1 + length]) for i in starts)


def bulk_read_params(requests: Iterable[tuple[int, int, int]]) -> bytes:
    """Parameters of a bulk read of (id, address, length)."""
    return b"\x00" + b"".join(bytes([length, servo, address]) for servo, address, length in requests)


def bulk_read_parts(params: bytes) -> Sequence[tuple[int, int, int]]:
    """(id, address, length) of each servo asked."""
    body = params[1:]
    return [(body[i + 1], body[i + 2], body[i]) for i in range(0, len(body) - 2, 3)]
