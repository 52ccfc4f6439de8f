"""What Feetech servos put into the FF FF frame: their own instructions, and the bits of the status byte.

STS and SMS send words low byte first, SCS high byte first; which of the two is a fact of the model (`byte_order` of
its firmware map), as is the sign rule of each register. Sync write has the form of Dynamixel 1.0. Parameters begin at
byte 5:

    SYNC READ (82)         start address, length, then ids; to id FE, one status of each in that order. SCS do not
                           reliably answer it
    RESET TURNS (0A)       none; STS only
    CALIBRATE OFFSET (0B)  none; the present position becomes the middle

Byte 4 of an answer is the status of the servo. Bit 4 is not used, and nothing there says whether a request was taken.

Sources: Feetech communication protocol manual (matthieuvigne/STS_servos @bdff048, extras/); ftservo/FTServo_Arduino
@64922cd, src/INST.h.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

RESET_TURNS: Final = 0x0A
CALIBRATE_OFFSET: Final = 0x0B
SYNC_READ: Final = 0x82

# Bits of the status byte, in every answer: all of them are states of the servo, a request is never refused aloud.
VOLTAGE: Final = 0x01
ENCODER: Final = 0x02
TEMPERATURE: Final = 0x04
CURRENT: Final = 0x08
OVERLOAD: Final = 0x20

CALIBRATE_HERE: Final = 128  # written to `torque_enable` of an STS: the present position becomes the middle


def sync_read_params(address: int, length: int, servos: Sequence[int]) -> bytes:
    """Parameters of a sync read; one answer per id comes back, in this order."""
    return bytes([address, length, *servos])


def sync_read_parts(params: bytes) -> tuple[int, int, bytes]:
    """(address, length, ids). Raises IndexError when address or length are missing."""
    return params[0], params[1], params[2:]
