"""The FF FF frame of Dynamixel Protocol 1.0 and of Feetech: values in, bytes out, and back. Opens no port.

    byte  0  1    2    3       4                       5 ...           n-1
          FF FF   ID   LENGTH  INSTRUCTION or ERROR    PARAMETER ...   CHECKSUM
          header

1. `length` counts code, parameters and sum. `sum` is the inverse of the low byte of id + length + code + parameters.
2. `code` is the instruction in what a host sends and the error byte in what a servo answers. Nothing in the frame says
   which of the two it is, nor what an answer answers: a reader has to know what it asked, whom, and how long the
   answer must be.
3. Nothing is stuffed, so parameters may look like a header. A frame whose sum is wrong was none: reading goes on at
   the next header behind its first byte.

Sources: ROBOTIS e-manual, docs/en/dxl/protocol1.md; Feetech communication protocol manual (matthieuvigne/STS_servos
@bdff048, extras/Feetech-CommunicationProtocole.docx).
"""

from __future__ import annotations

from typing import Final, NamedTuple

from sfms_robot.errors import PacketError

PING: Final = 0x01
READ: Final = 0x02
WRITE: Final = 0x03
REG_WRITE: Final = 0x04
ACTION: Final = 0x05
FACTORY_RESET: Final = 0x06
SYNC_WRITE: Final = 0x83

BROADCAST: Final = 0xFE
MAX_ID: Final = 0xFD
OVERHEAD: Final = 6  # bytes of a frame beside its parameters
MAX_PARAMS: Final = 0xFF - 2
MAX_FRAME: Final = OVERHEAD + MAX_PARAMS

_HEADER: Final = b"\xff\xff"


class Frame(NamedTuple):
    """One frame. `code` is an instruction or an error byte, depending on who sent it."""

    servo: int
    code: int
    params: bytes


def encode(servo: int, code: int, params: bytes = b"") -> bytes:
    """One frame. Raises PacketError for parameters that its length byte cannot count."""
    if len(params) > MAX_PARAMS:
        raise PacketError(f"a frame of {len(params)} parameters is longer than {MAX_PARAMS}")
    body = bytes([servo, len(params) + 2, code]) + params
    return _HEADER + body + bytes([~sum(body) & 0xFF])  # over ID to the last parameter, bytes 2 to n-2


def maybe_frame(buffer: bytearray) -> Frame | None:
    """Take the first whole frame off the front of `buffer`, or None: more bytes are needed.

    What stays in the buffer after None is at most one unfinished frame, `MAX_FRAME` - 1 bytes.
    """
    while True:
        start = buffer.find(_HEADER)
        if start < 0:
            del buffer[: len(buffer) - buffer.endswith(_HEADER[:1])]
            return None
        del buffer[:start]
        if len(buffer) < 4:
            if len(buffer) == 3 and buffer[2] == 0xFF:
                del buffer[0]
            return None
        servo, length = buffer[2], buffer[3]
        if servo == 0xFF or length < 2:  # a third FF is still header; LENGTH counts code and sum at least
            del buffer[0]
            continue
        total = length + 4  # LENGTH counts what is behind byte 3
        if len(buffer) < total:
            return None
        if ~sum(buffer[2 : total - 1]) & 0xFF != buffer[total - 1]:
            del buffer[0]
            continue
        frame = Frame(servo, buffer[4], bytes(buffer[5 : total - 1]))
        del buffer[:total]
        return frame


def salvage(buffer: bytearray) -> list[Frame]:
    """Empty a buffer to which nothing will be added: the whole frames behind a beginning that was cut off."""
    frames = []
    while buffer:
        frame = maybe_frame(buffer)
        if frame is not None:
            frames.append(frame)
        else:
            del buffer[:1]
    return frames
