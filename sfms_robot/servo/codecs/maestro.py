"""Pololu Maestro serial commands: values in, bytes out, and back. Opens no port.

1. A command byte has its top bit set, data bytes do not. So a reader that has lost synchronization resumes at the next
   command byte. Words of 14 bits are sent low seven bits first. (The only exception is Mini SSC, with data 0..254.)
2. Compact protocol: command, data. Pololu protocol, for several boards on one wire: AA, device number, command
   without its top bit, data. With both, a board whose setting "Enable CRC" is on expects one more byte at the end, the
   CRC-7 of all bytes before it; its answers have no CRC.
3. Targets and positions are in quarter microseconds of pulse width; target 0 switches the pulses off.
4. A board that detects its baud rate ignores all bytes before AA.
5. `GET_POSITION`, `GET_MOVING` and `GET_ERRORS` are answered by one or two bytes without a frame.

The CRC-7 detects any change of one byte that keeps the length of the packet. (A CRC of 7 bits misses one such change,
0x91. This change flips the top bit, and rule 1 detects it.) If a changed byte begins another command, the CRC of that
command fits by chance in 1 of 128 cases; Mini SSC has no CRC.

Source: Pololu Maestro Servo Controller User's Guide, pololu.com/docs/0J40, sections 4.b and 5.c to 5.f.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

# Command bytes, with their names in section 5.e of the guide; [0] is the command byte, [1] the first data byte.
SET_TARGET: Final = 0x84  # [1] channel, [2] target bits 0-6, [3] target bits 7-13
SET_SPEED: Final = 0x87  # [1] channel, [2] speed bits 0-6, [3] speed bits 7-13
SET_ACCELERATION: Final = 0x89  # [1] channel, [2] acceleration bits 0-6, [3] acceleration bit 7
GET_POSITION: Final = 0x90  # [1] channel; answer [0] position low 8 bits, [1] position high 8 bits
GET_MOVING: Final = 0x93  # Get Moving State; answer [0] 0 or 1
SET_TARGETS: Final = 0x9F  # Set Multiple Targets (Mini Maestro 12, 18 and 24): [1] number, [2] first channel, words
GET_ERRORS: Final = 0xA1  # answer [0] error bits 0-7, [1] error bits 8-15
GO_HOME: Final = 0xA2
MINI_SSC: Final = 0xFF  # [1] servo number, [2] target 0-254

BAUD_INDICATION: Final = 0xAA
DEFAULT_DEVICE: Final = 12
OFF: Final = 0  # target that switches pulses off
MAX_WORD: Final = 0x3FFF
FACTORY_PULSE_US: Final = (992, 2000)  # of every channel; a wider range is set over USB, and a board clips silently

# Bits of the error register, section 4.e; bits 6 to 8 are errors of the script.
SIGNAL_ERROR: Final = 1 << 0  # Serial Signal Error: a stop bit was not where it should be
CRC_ERROR: Final = 1 << 3  # Serial CRC Error: the byte after a command was not its CRC
PROTOCOL_ERROR: Final = 1 << 4  # Serial Protocol Error: an unknown or incomplete command
TIMEOUT_ERROR: Final = 1 << 5  # Serial Timeout: no command within the time of its setting
WIRE_ERRORS: Final = 0x1F  # bytes were lost or damaged on the way; the board itself is fine

_POLYNOMIAL: Final = 0x91  # polynomial of the CRC, section 5.d
_DATA_LENGTH: Final = {
    SET_TARGET: 3,
    SET_SPEED: 3,
    SET_ACCELERATION: 3,
    GET_POSITION: 1,
    GET_MOVING: 0,
    GET_ERRORS: 0,
    GO_HOME: 0,
    MINI_SSC: 2,
}


class MaestroCommand(NamedTuple):
    """A command that a board has read. `error`: bit of the error register if the command is invalid, else 0."""

    code: int
    data: bytes = b""
    error: int = 0


def word(value: int) -> bytes:
    """Return 14 bits as two data bytes. Raises ValueError for a value that does not fit."""
    if not 0 <= value <= MAX_WORD:
        raise ValueError(f"{value} does not fit the 14 bits of a Maestro command")
    return bytes([value & 0x7F, value >> 7])


def from_word(data: bytes) -> int:
    """Return the value of two data bytes, the inverse of `word`."""
    return data[0] | data[1] << 7  # low seven bits first


def set_target(channel: int, quarter_us: int) -> bytes:
    """Return a command that sets a pulse width, in quarter microseconds; 0 = no pulses."""
    return bytes([SET_TARGET, channel]) + word(quarter_us)


def set_targets(first: int, quarter_us: Sequence[int]) -> bytes:
    """Return a command that sets the pulse widths of consecutive channels from `first` on."""
    return bytes([SET_TARGETS, len(quarter_us), first]) + b"".join(map(word, quarter_us))


def get_position(channel: int) -> bytes:
    """Return a request answered by two bytes, low byte first: the present pulse in quarter microseconds; 0 = none."""
    return bytes([GET_POSITION, channel])


def get_errors() -> bytes:
    """Return a request answered by two bytes, low byte first: the error register. The request clears the register."""
    return bytes([GET_ERRORS])


def crc7(packet: bytes) -> int:
    """Return the CRC of a packet, 0..127, computed from the lowest bit of each byte on; 0 if it ends in its own CRC."""
    crc = 0
    for byte in packet:
        crc ^= byte
        for _ in range(8):
            crc = (crc ^ _POLYNOMIAL if crc & 1 else crc) >> 1
    return crc


def sealed(packet: bytes) -> bytes:
    """Append the CRC to a command of either protocol."""
    return packet + bytes([crc7(packet)])


def maybe_command(buffer: bytearray, device: int = DEFAULT_DEVICE, crc: bool = False) -> MaestroCommand | None:
    """Take the next command for board `device` off the front of `buffer`, or return None: more bytes are needed.

    `crc`: a CRC byte follows every command except Mini SSC.

    An error is returned as a MaestroCommand with `error` set, and its bytes are removed. Commands to other boards are
    dropped silently. After None the buffer contains at most one incomplete command.
    """
    while buffer:
        code, start = buffer[0], 1
        if code < 0x80:
            del buffer[0]
            return MaestroCommand(code, error=PROTOCOL_ERROR)
        if code == BAUD_INDICATION:
            if len(buffer) < 2:
                return None
            if buffer[1] >= 0x80:  # not a device number: a second baud indication, or one sent alone
                del buffer[0]
                continue
            if len(buffer) < 3:
                return None
            code, start = buffer[2] | 0x80, 3
            if buffer[2] >= 0x80:  # the top bit of a command after AA and device is cleared
                del buffer[:2]
                return MaestroCommand(BAUD_INDICATION, error=PROTOCOL_ERROR)
        end = _end(buffer, code, start)
        if end is None:
            return None
        if end < 0:  # not a command of the guide
            del buffer[:start]
            return MaestroCommand(code, error=PROTOCOL_ERROR)
        checked = crc and code != MINI_SSC
        end += checked
        cut = next((i for i in range(start, min(end, len(buffer))) if code != MINI_SSC and buffer[i] >= 0x80), None)
        if cut is not None:  # another command interrupts this one
            del buffer[:cut]
            return MaestroCommand(code, error=PROTOCOL_ERROR)
        if len(buffer) < end:
            return None
        whole, other = bytes(buffer[:end]), start == 3 and buffer[1] != device
        del buffer[:end]
        if other:  # daisy chain: every board reads every command
            continue
        if checked and crc7(whole):
            return MaestroCommand(code, error=CRC_ERROR)
        return MaestroCommand(code, whole[start : end - checked])
    return None


def _end(buffer: bytearray, code: int, start: int) -> int | None:
    """Return the index after the data of a command; None while it is not known, -1 for an unknown command."""
    if code != SET_TARGETS:
        return start + _DATA_LENGTH[code] if code in _DATA_LENGTH else -1
    if len(buffer) <= start:
        return None
    # number of targets and first channel, then a word for each target
    return start + 2 + 2 * (buffer[start] & 0x7F)
