r"""Lynxmotion SSC-32 and SSC-32U text commands: values in, bytes out, and back. Opens no port.

    #5 P1600 S750 #10 P750 T2500 \r     channels 5 and 10 move; S in us/s per channel, T in ms for the whole group
    #5 L \r                             output low: no pulses, the servo goes limp
    Q \r, QP 5 7 \r, VER \r             "." or "+" (still moving); one byte per channel in 10 us; a line of text

Letters of either case and spaces anywhere are allowed. A carriage return ends a command, ESC drops the bytes before it.

Sources: Lynxmotion SSC-32U User Guide, "Servo Move or Group Move" and "Advanced Functions"; for the fact that `L` stops
the pulses of a servo: community.robotshop.com/forum/t/ssc32-re-startup-condition/19731.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

CHANNELS: Final = 32  # <ch> 0..31
MIN_PULSE_US: Final = 500  # <pw>, "pulse width in microseconds, 500 - 2500"
MAX_PULSE_US: Final = 2500
MAX_TIME_MS: Final = 65535  # <time>, "time in milliseconds to complete the move, 65535 maximum"
MAX_LINE: Final = 1024  # bytes; a longer line is noise, and this limits the buffer of a reader
DONE: Final = b"."  # answers to Q, Query Movement Status
MOVING: Final = b"+"

_CR: Final = 0x0D  # <cr> starts the action of a command
_ESC: Final = 0x1B  # <esc> cancels the current command
# # <ch> P <pw> S <spd>, Servo Move; # <ch> <lvl> with H or L, Discrete Output
_ITEM: Final = re.compile(r"#(\d{1,2})(?:P(\d{1,5})(?:S(\d{1,5}))?|([HL]))")
# any number of these items, then T <time>: Servo Group Move
_GROUP: Final = re.compile(r"((?:#\d{1,2}(?:P\d{1,5}(?:S\d{1,5})?|[HL]))+)(?:T(\d{1,5}))?")
# QP <arg>, Query Pulse Width; several channels in one command
_QUERY: Final = re.compile(r"QP\s*\d{1,2}(?:\s+\d{1,2})*")


class Move(NamedTuple):
    """A pulse width, and the speed towards it in us/s; 0 = as fast as the servo can move."""

    pulse_us: int  # <pw>
    speed_us_s: int = 0  # <spd>


@dataclass(frozen=True)
class Group:
    """A group of channels that move together within `time_ms` (0 = at once), and outputs set high or low."""

    moves: Mapping[int, Move]
    time_ms: int = 0  # <time>
    levels: Mapping[int, bool] = field(default_factory=dict)


@dataclass(frozen=True)
class Query:
    """A query; `kind` is Q, QP (with `channels`) or VER."""

    kind: str
    channels: tuple[int, ...] = ()


def group_move(moves: Mapping[int, Move], time_ms: int = 0) -> bytes:
    """Return one command for all of `moves` (channel -> move), in its order; they start and stop together in `time_ms`.

    The command has no spaces: at 9600 baud each would take a millisecond.
    """
    for channel, move in moves.items():
        if not MIN_PULSE_US <= move.pulse_us <= MAX_PULSE_US:
            raise ValueError(
                f"channel {channel}: {move.pulse_us} us is outside {MIN_PULSE_US}..{MAX_PULSE_US} us of an SSC-32"
            )
    # #<ch>P<pw>S<spd> of each channel, then T<time> and <cr>
    text = "".join(
        f"#{channel}P{move.pulse_us}" + (f"S{move.speed_us_s}" if move.speed_us_s else "")
        for channel, move in moves.items()
    )
    return (text + (f"T{min(time_ms, MAX_TIME_MS)}" if time_ms else "") + "\r").encode()


def outputs_low(channels: Sequence[int]) -> bytes:
    """Return a command that ends the pulses on `channels`."""
    return ("".join(f"#{channel}L" for channel in channels) + "\r").encode()


def query_moving() -> bytes:
    """Return a request answered by `DONE` or `MOVING`."""
    return b"Q\r"


def maybe_command(buffer: bytearray) -> Group | Query | None:
    """Take the first whole command off the front of `buffer`, or return None: more bytes are needed.

    Lines that are not commands are dropped; an endless line is dropped in pieces of `MAX_LINE` bytes.
    """
    while True:
        end = buffer.find(_CR)
        escape = buffer.rfind(_ESC, 0, end if end >= 0 else len(buffer))
        if escape >= 0:
            del buffer[: escape + 1]
            end = buffer.find(_CR)
        if end < 0:
            if len(buffer) < MAX_LINE:
                return None
            end = MAX_LINE - 1
        line = buffer[:end].decode("ascii", "replace").upper().strip()
        del buffer[: end + 1]
        if (command := _parsed(line)) is not None:
            return command


def _parsed(line: str) -> Group | Query | None:
    text = re.sub(r"\s+", "", line)  # "spaces anywhere"
    if text in ("Q", "VER"):
        return Query(text)
    if _QUERY.fullmatch(line):
        channels = tuple(int(number) for number in re.findall(r"\d+", line))
        return Query("QP", channels) if max(channels) < CHANNELS else None
    whole = _GROUP.fullmatch(text)
    if whole is None:
        return None
    moves, levels = {}, {}
    for channel, pulse, speed, level in _ITEM.findall(whole[1]):
        if int(channel) >= CHANNELS:
            return None
        if level:
            levels[int(channel)] = level == "H"
        else:
            moves[int(channel)] = Move(int(pulse), int(speed or 0))
    return Group(moves, int(whole[2] or 0), levels)
