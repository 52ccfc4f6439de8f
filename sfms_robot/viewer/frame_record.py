"""One picture of a run, as it goes from the run's process to the page's, and as the page is told it.

The run packs numbers as they are, some microseconds of work; the page's process makes JSON of them, once for all who
look. What seldom changes (state, faults, hazards) comes as JSON that the run keeps until it does.

    float64   time [s]
    float32   level of the person's voice [dB], of the robot's own, attention, place x, y, z [m]; NaN: there is none
    uint8     whether the person talks; uint8 0
    uint16    J, the number of joints
    float32   motion (58,), joints asked (J,) [rad], joints read (J,) [rad, NaN: never]
    rest      JSON of `s`, `w`, `f`, `h` without its braces
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import orjson

from sfms_robot.frames import MOTION_DIM, Doubles, Floats

_HEADER: Final = struct.Struct("<d6fBBH")
_DIGITS: Final = 4
_DB_DIGITS: Final = 1
NOTHING: Final = math.nan

# (J,) angles, read where the servo told one and else asked [rad] -> values of the joints of a URDF.
Shown = Callable[[Doubles], Doubles]


@dataclass(frozen=True)
class Picture:
    """What a page shows of one instant; None and NaN where there is nothing to show.

    Attributes:
        motion: (58,). asked_rad, read_rad: (J,); NaN in the latter where a servo never answered.
        rare: what `rare_json` made of it.
    """

    time_s: float
    motion: Floats
    asked_rad: Doubles
    read_rad: Floats
    rare: bytes
    voice_db: float = NOTHING
    own_voice_db: float = NOTHING
    attention: float = NOTHING
    place_m: Sequence[float] | Floats = (NOTHING, NOTHING, NOTHING)
    talking: bool = False


def rare_json(
    state: str, why: Sequence[str], faults: Mapping[str, str], hazards_hz: Mapping[str, float] | None
) -> bytes:
    """State and why, faults by joint, hazards by kind of event: JSON without its braces."""
    hazards = None if not hazards_hz else {kind: round(float(hazard), _DIGITS) for kind, hazard in hazards_hz.items()}
    return orjson.dumps({"s": state, "w": list(why), "f": dict(faults), "h": hazards})[1:-1]


def pack_picture(picture: Picture) -> bytes:
    """As bytes, see the module."""
    header = _HEADER.pack(
        picture.time_s, picture.voice_db, picture.own_voice_db, picture.attention, *map(float, picture.place_m),
        picture.talking, 0, len(picture.asked_rad),
    )  # fmt: skip
    numbers = np.concatenate([picture.motion, picture.asked_rad, picture.read_rad], dtype="<f4", casting="same_kind")
    return header + numbers.tobytes() + picture.rare


def frame_json(record: bytes, shown: Shown | None = None) -> bytes:
    """The page's `frame` message of a packed picture. `shown` None: there is no URDF, its joints are the head's."""
    time_s, voice_db, own_db, attention, x_m, y_m, z_m, talking, _, joints = _HEADER.unpack_from(record)
    ends = _HEADER.size + 4 * (MOTION_DIM + 2 * joints)
    values = np.frombuffer(record, "<f4", MOTION_DIM + 2 * joints, _HEADER.size).astype(np.float64)
    asked_rad, read_rad = values[MOTION_DIM : MOTION_DIM + joints], values[MOTION_DIM + joints :]
    there_rad = np.where(np.isnan(read_rad), asked_rad, read_rad)
    rounded = values.round(_DIGITS)
    message = {
        "type": "frame",
        "t": round(time_s, _DIGITS),
        "m": rounded[:MOTION_DIM],
        "j": rounded[MOTION_DIM : MOTION_DIM + joints],
        "r": rounded[MOTION_DIM + joints :],
        "u": (there_rad if shown is None else shown(there_rad)).round(_DIGITS),
        "db": _number(voice_db, _DB_DIGITS),
        "talk": bool(talking),
        "own": _number(own_db, _DB_DIGITS),
        "at": _number(attention),
        "o": None if math.isnan(x_m) else [_number(x_m), _number(y_m), _number(z_m)],
    }
    return orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY)[:-1] + b"," + record[ends:] + b"}"


def _number(value: float, digits: int = _DIGITS) -> float | None:
    """JSON has no NaN: null."""
    return None if math.isnan(value) else round(value, digits)


def told_json(**message: Any) -> bytes:
    """Any other message."""
    return orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY)
