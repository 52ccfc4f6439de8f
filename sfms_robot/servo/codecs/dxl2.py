"""Dynamixel Protocol 2.0 packets: values in, bytes out, and back. Opens no port.

    byte   0  1  2  3       4    5      6      7            8 ...       n-2    n-1
           FF FF FD 00      ID   LEN_L  LEN_H  INSTRUCTION  PARAM ...   CRC_L  CRC_H
           header, reserved                    55 = status  ERROR, PARAM ...

Parameters, by the manual's names (words low byte first):

    PING              none                          status: model number (2), firmware version (1)
    READ              address (2), length (2)       status: the data
    WRITE, REG WRITE  address (2), data             status: no data
    ACTION, REBOOT    none                          status: no data
    FACTORY RESET     FF all, 01 all but the id, 02 all but id and baud rate
    CLEAR             01 44 58 4C 22                present position back into one turn
    SYNC WRITE        address (2), length (2), then id, data of each; sent to id FE, no servo answers
    SYNC READ         address (2), length (2), then ids; sent to id FE, one status of each, in that order
    FAST SYNC READ    the same; one status from id FE: ERROR, ID, data, CRC of each

1. `length` counts instruction, parameters and crc, after stuffing. Words are sent low byte first.
2. A status packet is instruction 0x55, with the error byte as first parameter; bit 7 of the error byte is the alert.
3. Stuffing: between instruction and crc, every FF FF FD is followed by one more FD, so the header FF FF FD 00
   never appears inside a packet. The crc covers the stuffed bytes.
4. A reader that has lost synchronization searches for the next header. A header inside an incomplete packet means that
   the packet was cut off, and reading continues at that header.

Source: ROBOTIS e-manual, docs/en/dxl/protocol2.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

from fastcrc.crc16 import umts

from sfms_robot.errors import PacketError

# Instructions, e-manual "Instruction"; 55 marks packets sent by a servo.
PING: Final = 0x01
READ: Final = 0x02  # address (2), length (2)
WRITE: Final = 0x03  # address (2), data
FACTORY_RESET: Final = 0x06
REBOOT: Final = 0x08
CLEAR: Final = 0x10  # with the key 44 58 4C 22
STATUS: Final = 0x55
SYNC_READ: Final = 0x82  # the same block of several ids; each sends its own status
SYNC_WRITE: Final = 0x83  # one address, different data for each id
FAST_SYNC_READ: Final = 0x8A  # since a firmware version that depends on the model
BULK_READ: Final = 0x92  # a different block of each id
BULK_WRITE: Final = 0x93

# Error byte of a status packet (byte 8): e-manual "Status Packet: Error".
ALERT: Final = 0x80  # bit 7: the hardware error status is not 0; says nothing about the request
ERRORS: Final = {
    1: "result fail",
    2: "instruction error",
    3: "crc error",
    4: "data range error",
    5: "data length error",
    6: "data limit error",
    7: "access error",
}
INSTRUCTION_ERROR: Final = 2  # bits 0 to 6 are one number, not flags
DATA_RANGE_ERROR: Final = 4
DATA_LENGTH_ERROR: Final = 5
DATA_LIMIT_ERROR: Final = 6
ACCESS_ERROR: Final = 7

BROADCAST: Final = 0xFE  # "Packet ID": ids are 0 to 252 (FC); FD and FF are reserved
MAX_ID: Final = 252
MAX_PACKET: Final = 1024  # bytes; a longer length field is noise, and this limits the buffer of a reader
STATUS_OVERHEAD: Final = 11  # bytes of a status packet without its data

_HEADER: Final = b"\xff\xff\xfd\x00"  # "Header" and "Reserved"
_LOOKALIKE: Final = b"\xff\xff\xfd"  # not allowed inside a packet: byte stuffing replaces it by `_STUFFED`
_STUFFED: Final = b"\xff\xff\xfd\xfd"


class Packet(NamedTuple):
    """A packet. In a status, `params` is the data after the error byte; in an instruction, `error` is 0."""

    servo: int
    instruction: int
    params: bytes
    error: int = 0


crc16: Final = umts  # CRC-16/BUYPASS: 0x8005, start 0, not reflected. A second argument continues an earlier call


def encode_instruction(servo: int, instruction: int, params: bytes = b"") -> bytes:
    """Return an instruction packet. Raises PacketError if it would be longer than `MAX_PACKET`."""
    body = (bytes([instruction]) + params).replace(_LOOKALIKE, _STUFFED)
    if len(body) + 9 > MAX_PACKET:
        raise PacketError(f"a packet of {len(body) + 9} bytes is longer than {MAX_PACKET}")
    # LEN = instruction + parameters + crc, after stuffing. The crc covers all bytes from byte 0 on.
    packet = _HEADER + bytes([servo]) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def encode_sync_write(address: int, length: int, rows: bytes) -> bytes:
    """Return a sync write; `rows` are id and `length` bytes of data of each servo. Raises PacketError if too long."""
    # address (2), length (2), then id and data of each: e-manual "Sync Write"
    head = address.to_bytes(2, "little") + length.to_bytes(2, "little")
    return encode_instruction(BROADCAST, SYNC_WRITE, head + rows)


def encode_status(servo: int, error: int, data: bytes = b"") -> bytes:
    """Return a status packet, as a servo sends it."""
    return encode_instruction(servo, STATUS, bytes([error]) + data)


def encode_fast_status(replies: Iterable[tuple[int, int, bytes]], length: int | None = None) -> bytes:
    """Return the one status packet that answers a fast sync read; `replies` are (id, error, data) in list order.

    Each device appends error, id, data and the crc of all bytes so far; the last crc ends the packet. Stuffing is not
    used, since a device cannot know the bytes of the devices before it. `length`: LEN of a truncated packet.
    """
    parts = [bytes([error, servo]) + data for servo, error, data in replies]
    if length is None:  # LEN counts from the instruction on: 1, then error, id, data and crc of each device
        length = 1 + sum(len(part) + 2 for part in parts)
    out = _HEADER + bytes([BROADCAST]) + length.to_bytes(2, "little") + bytes([STATUS])
    for part in parts:
        out += part
        out += crc16(out).to_bytes(2, "little")
    return out


def split_fast_status(data: bytes | bytearray, length: int) -> list[tuple[int, int, bytes]]:
    """Return (id, error, data) of each device in the answer to a fast sync read of `length` bytes.

    `data` begins with the header. If a device is silent, the packet is truncated: the devices before the gap are
    returned, each verified by its own crc, and none after the gap.
    """
    # FF FF FD 00 FE LEN LEN 55, then of each device ERROR ID data CRC CRC: 4 bytes and the data
    if not data.startswith(_HEADER + bytes([BROADCAST])) or data[7:8] != bytes([STATUS]):
        return []
    data, size = bytes(data), length + 4
    ends = range(8 + size, len(data) + 1, size)
    whole = bool(ends) and _proved(data[: ends[-1]])  # the last crc covers the whole packet
    out = []
    for end in ends:  # index after the crc of one device
        if not whole and not _proved(data[:end]):
            break
        out.append((data[end - size + 1], data[end - size], data[end - size + 2 : end - 2]))
    return out


def _proved(data: bytes) -> bool:
    return crc16(data[:-2]) == data[-2] | data[-1] << 8


def maybe_packet(buffer: bytearray) -> Packet | None:
    """Take the first whole packet off the front of `buffer`, or return None: more bytes are needed.

    Noise before it is dropped, and so is a packet with a wrong crc. After None the buffer contains at most one
    incomplete packet, so a caller that empties it after each read stores a bounded number of bytes.
    """
    while True:
        start = buffer.find(_HEADER)
        if start < 0:
            begun = next((size for size in (3, 2, 1) if buffer.endswith(_HEADER[:size])), 0)
            del buffer[: len(buffer) - begun]
            return None
        del buffer[:start]
        if len(buffer) < 7:  # byte 6 is LEN_H, the last byte of the length
            return None
        servo, length = buffer[4], buffer[5] | buffer[6] << 8
        total = length + 7  # LEN counts the bytes after byte 6
        if length < 3 or total > MAX_PACKET or servo in (0xFD, 0xFF):  # FD and FF are not ids: they look like a header
            del buffer[0]
            continue
        if len(buffer) < total:
            again = buffer.find(_HEADER, 7)
            if 7 <= again <= total - 6:  # a whole header before the crc: this packet was cut off
                del buffer[:again]
                continue
            return None
        packet = bytes(buffer[:total])
        if not _proved(packet):
            del buffer[0]
            continue
        body = packet[7:-2]  # instruction, then parameters
        if body[0] == STATUS and len(body) < 2:
            del buffer[0]
            continue
        del buffer[:total]
        if _STUFFED in body and not (servo == BROADCAST and body[0] == STATUS):  # a fast answer is not stuffed
            body = body.replace(_STUFFED, _LOOKALIKE)
        if body[0] == STATUS:
            return Packet(servo, STATUS, body[2:], body[1])
        return Packet(servo, body[0], body[1:])
