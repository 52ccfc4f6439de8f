"""The FF FF frame of Dynamixel Protocol 1.0 and of Feetech: values in, bytes out, and back. Opens no port.

    byte  0  1  2    3       4                       5 ...           n-1
          FF FF ID   LENGTH  INSTRUCTION or ERROR    PARAMETER ...   CHECKSUM
          header

1. LENGTH counts code, parameters and checksum. CHECKSUM is the inverse of the low byte of the sum of bytes 2 to n-2.
2. Byte 4 is the instruction in a frame of a host, and the error byte in the answer of a servo. The frame does not show
   which of the two it is, nor which request it answers: a reader needs the request, its servo and the expected length
   of the answer.
3. Byte stuffing is not used, so parameters may look like a header. After a frame with a wrong checksum, reading
   continues at the next header after its first byte.

Parameters begin at byte 5. Both families have this instruction to id FE, which no servo answers:

    SYNC WRITE (83)        start address, length L, then id and L bytes of data of each

Dynamixel 1.0 sends words low byte first, and has no sync read:

    BULK READ (92)         00, then length, id, start address of each (other instructions have another order); to id
                           FE, one status of each in the order of the ids, each after the previous one; MX series only

Feetech STS and SMS send words low byte first, SCS high byte first. This depends on the model (`byte_order` of its
firmware map), and so does the sign rule of each register:

    SYNC READ (82)         start address, length, then ids; to id FE, one status of each in that order. SCS servos do
                           not answer it reliably
    RESET TURNS (0A)       none; STS only
    CALIBRATE OFFSET (0B)  none; the present position becomes the middle

Sources: ROBOTIS e-manual, docs/en/dxl/protocol1.md; Feetech communication protocol manual (matthieuvigne/STS_servos
@bdff048, extras/Feetech-CommunicationProtocole.docx); ftservo/FTServo_Arduino @64922cd, src/INST.h.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from sfms_robot.errors import PacketError

# Instructions: e-manual "Instruction"; the last three are Feetech's.
PING: Final = 0x01
READ: Final = 0x02  # address, length
WRITE: Final = 0x03  # address, data
REG_WRITE: Final = 0x04  # kept in the servo until ACTION
ACTION: Final = 0x05  # executes the pending REG WRITE
FACTORY_RESET: Final = 0x06
SYNC_WRITE: Final = 0x83
BULK_READ: Final = 0x92  # Dynamixel MX
RESET_TURNS: Final = 0x0A  # Feetech STS
CALIBRATE_OFFSET: Final = 0x0B  # Feetech
SYNC_READ: Final = 0x82  # Feetech STS and SMS

BROADCAST: Final = 0xFE
MAX_ID: Final = 0xFD
OVERHEAD: Final = 6  # bytes of a frame without its parameters
MAX_PARAMS: Final = 0xFF - 2
MAX_FRAME: Final = OVERHEAD + MAX_PARAMS

# Error byte of Dynamixel 1.0 (e-manual "Status Packet: Error"): four bits concern the request; bits 0, 2 and 5 concern
# the servo (voltage, overheating, overload). All bits of Feetech are states of the servo: none reports a refusal.
ANGLE_LIMIT: Final = 0x02  # bit 1: the goal is outside the angle limits
RANGE: Final = 0x08  # bit 3: a parameter is out of range
CHECKSUM: Final = 0x10  # bit 4
INSTRUCTION: Final = 0x40  # bit 6: unknown instruction, or ACTION without REG WRITE; bit 7 is always 0

REFUSALS: Final[Mapping[int, str]] = {
    ANGLE_LIMIT: "angle limit error",
    RANGE: "range error",
    CHECKSUM: "checksum error",
    INSTRUCTION: "instruction error",
}
REFUSAL_BITS: Final = sum(REFUSALS)

CALIBRATE_HERE: Final = 128  # written to `torque_enable` of an STS: the present position becomes the middle

_HEADER: Final = b"\xff\xff"


class Frame(NamedTuple):
    """A frame. `code` is an instruction or an error byte, depending on the sender."""

    servo: int
    code: int
    params: bytes


def encode(servo: int, code: int, params: bytes = b"") -> bytes:
    """Return a frame. Raises PacketError for more parameters than its length byte can count."""
    if len(params) > MAX_PARAMS:
        raise PacketError(f"a frame of {len(params)} parameters is longer than {MAX_PARAMS}")
    body = bytes([servo, len(params) + 2, code]) + params
    return _HEADER + body + bytes([~sum(body) & 0xFF])  # covers bytes 2 to n-2: ID to the last parameter


def maybe_frame(buffer: bytearray) -> Frame | None:
    """Take the first whole frame off the front of `buffer`, or return None: more bytes are needed.

    After None the buffer contains at most one incomplete frame, `MAX_FRAME` - 1 bytes.
    """
    while True:
        start = buffer.find(_HEADER)
        if start < 0:
            del buffer[: len(buffer) - buffer.endswith(_HEADER[:1])]
            return None
        del buffer[:start]
        if len(buffer) < 4:  # LENGTH is byte 3
            if len(buffer) == 3 and buffer[2] == 0xFF:
                del buffer[0]
            return None
        servo, length = buffer[2], buffer[3]
        if servo == 0xFF or length < 2:  # a third FF belongs to the header; LENGTH counts at least code and checksum
            del buffer[0]
            continue
        total = length + 4  # LENGTH counts the bytes after byte 3
        if len(buffer) < total:
            return None
        if ~sum(buffer[2 : total - 1]) & 0xFF != buffer[total - 1]:
            del buffer[0]
            continue
        # byte 4 is the code, the parameters follow
        frame = Frame(servo, buffer[4], bytes(buffer[5 : total - 1]))
        del buffer[:total]
        return frame


def salvage(buffer: bytearray) -> list[Frame]:
    """Empty a buffer that receives no more bytes; return its whole frames, also those after an incomplete frame."""
    frames = []
    while buffer:
        frame = maybe_frame(buffer)
        if frame is not None:
            frames.append(frame)
        else:
            del buffer[:1]
    return frames


def refusal_text(error: int) -> str:
    """Return why a request was refused, from an error byte of Dynamixel 1.0; empty if it was accepted."""
    return ", ".join(text for bit, text in REFUSALS.items() if error & bit)


def encode_sync_write(address: int, length: int, rows: bytes) -> bytes:
    """Return a sync write; `rows` are id and `length` bytes of data of each servo. Raises PacketError like `encode`."""
    # start address, L, then id and L bytes of each: e-manual "Sync Write"
    return encode(BROADCAST, SYNC_WRITE, bytes([address, length]) + rows)


def bulk_read_params(requests: Iterable[tuple[int, int, int]]) -> bytes:
    """Return the parameters of a bulk read of (id, address, length)."""
    return b"\x00" + b"".join(bytes([length, servo, address]) for servo, address, length in requests)


def sync_read_params(address: int, length: int, servos: Sequence[int]) -> bytes:
    """Return the parameters of a Feetech sync read; one answer per id comes back, in this order."""
    return bytes([address, length, *servos])
