"""Messages of the page: pictures and documents to it, commands of its visitors. Opens no socket.

The run's process packs a picture, which takes microseconds, and sends it to the page's process, which makes JSON of it,
once for all visitors. Values that seldom change (state, faults, hazards) are JSON that the run keeps until they change.

    float64   time [s]
    float32   level of the person's voice [dB], of the robot's own, attention, place x, y, z [m]; NaN: unknown
    uint8     whether the person talks; a byte of padding
    uint16    J, the number of joints
    float32   motion (58,), joints requested (J,) [rad], joints read (J,) [rad, NaN: never]
    rest      JSON of `s`, `w`, `f`, `h` without its braces

Only the form of a command is checked here: keys, types, finite numbers. Names and ranges of a head are checked where
the command is carried out.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Final, Literal

import numpy as np
import orjson
from pydantic import AfterValidator, Field, StrictBool, create_model

from sfms_robot.config import parse
from sfms_robot.config.base import PRINTABLE, Model
from sfms_robot.errors import ConfigError, PacketError
from sfms_robot.frames import MOTION_DIM, Doubles, Floats

VERSION: Final = 1
LONGEST_COMMAND: Final = 8192  # characters
LONGEST_PERSON: Final = 262_144  # bytes of a binary message: 2.7 s of sound at 48 kHz
NOTHING: Final = math.nan
_HEADER: Final = struct.Struct("<d6f?xH")
_DIGITS: Final = 4
_LONGEST_TEXT: Final = 256

# (J,) angles [rad], read if a servo has answered, otherwise requested -> values of the joints of a URDF.
Shown = Callable[[Doubles], Doubles]


# --- pictures -------------------------------------------------------------------------------------------------------


def rare_json(
    state: str, why: Sequence[str], faults: Mapping[str, str], hazards_hz: Mapping[str, float] | None
) -> bytes:
    """Return state and why, faults by joint, hazards by kind of event: JSON without its braces."""
    hazards = None if not hazards_hz else {kind: round(float(hazard), _DIGITS) for kind, hazard in hazards_hz.items()}
    return orjson.dumps({"s": state, "w": list(why), "f": dict(faults), "h": hazards})[1:-1]


def pack_picture(
    time_s: float,
    motion: Floats,
    asked_rad: Doubles,
    read_rad: Floats,
    rare: bytes,
    *,
    voice_db: float = NOTHING,
    own_voice_db: float = NOTHING,
    attention: float | None = None,
    place_m: Sequence[float] | Floats | None = None,
    talking: bool = False,
) -> bytes:
    """Pack the picture of one instant, in the format of the module's docstring.

    Args:
        motion: (58,). asked_rad, read_rad: (J,); NaN in the latter where a servo never answered.
        rare: from `rare_json`.
    """
    place = [NOTHING] * 3 if place_m is None else place_m
    seen = NOTHING if attention is None else attention
    header = _HEADER.pack(time_s, voice_db, own_voice_db, seen, *place, talking, len(asked_rad))
    numbers = np.concatenate([motion, asked_rad, read_rad], dtype="<f4", casting="same_kind")
    return header + numbers.tobytes() + rare


def frame_json(record: bytes, shown: Shown | None = None) -> bytes:
    """Return the `frame` message of a packed picture. `shown` None: no URDF, the joints shown are the head's."""
    time_s, voice_db, own_db, attention, *place_m, talking, joints = _HEADER.unpack_from(record)
    count = MOTION_DIM + 2 * joints
    values = np.frombuffer(record, "<f4", count, _HEADER.size).astype(np.float64)
    asked_rad, read_rad = values[MOTION_DIM : MOTION_DIM + joints], values[MOTION_DIM + joints :]
    there_rad = np.where(np.isnan(read_rad), asked_rad, read_rad)
    message = {
        "type": "frame",
        "t": round(time_s, _DIGITS),
        "m": values[:MOTION_DIM].round(_DIGITS),
        "j": asked_rad.round(_DIGITS),
        "r": read_rad.round(_DIGITS),
        "u": (there_rad if shown is None else shown(there_rad)).round(_DIGITS),
        "db": round(voice_db, 1),  # unknown is NaN, which becomes null in JSON; the same below
        "talk": talking,
        "own": round(own_db, 1),
        "at": round(attention, _DIGITS),
        "o": None if math.isnan(place_m[0]) else [round(each, _DIGITS) for each in place_m],
    }
    return message_json(**message)[:-1] + b"," + record[_HEADER.size + 4 * count :] + b"}"


def message_json(**message: Any) -> bytes:
    """Return any other message to a page."""
    return orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY)


# --- commands -------------------------------------------------------------------------------------------------------


def _short(value: Any) -> Any:
    if len(orjson.dumps(value)) > _LONGEST_TEXT:
        raise ValueError(f"expected up to {_LONGEST_TEXT} characters")
    return value


_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Whole = Annotated[int, Field(strict=True, ge=0, lt=2**32)]
_Text = Annotated[str, Field(max_length=_LONGEST_TEXT), PRINTABLE]
_Anything = Annotated[Any, AfterValidator(_short)]
_Numbers = Annotated[dict[str, _Number], Field(max_length=128)]
_Rates = Annotated[dict[str, _Number | None], Field(max_length=128)]  # None: the rate of people
_Feeds = list[Literal["voice", "face"]]

# The keys of each command, with their types and defaults (...: required).
_KEYS: Final[Mapping[str, Mapping[str, Any]]] = {
    "hello": {"version": (_Whole, ...), "token": (_Text, "")},
    "ping": {"id": (_Anything, None)},
    "take": {},
    "give": {},
    "halt": {},
    "resume": {},
    "release": {},
    "neutral": {"seconds": (_Number, 3.0)},
    "show": {"channels": (_Numbers, ...), "seconds": (_Number, 0.5)},
    "expression": {"name": (_Text, ...), "seconds": (_Number, 2.0)},
    "look_at": {"x_m": (_Number, ...), "y_m": (_Number, ...), "z_m": (_Number, ...), "seconds": (_Number, 2.0)},
    "knobs": {"intensity": (_Numbers, {}), "style": (_Numbers, {})},
    "calm": {"rates": (_Rates, ...)},
    "listener": {"name": (_Text, ...)},
    "speaker": {"name": (_Text, ...)},
    "seed": {"seed": (_Whole, ...)},
    "record": {"on": (StrictBool, ...)},
    "source": {"feeds": (_Feeds, ...)},
}
COMMANDS: Final = {name: create_model(name, __base__=Model, **keys) for name, keys in _KEYS.items()}


def parse_command(data: str) -> tuple[str, dict[str, Any]]:
    """Return the name of a command and the values of all its keys. Raises PacketError, in one line, for other text."""
    if len(data) > LONGEST_COMMAND:
        raise PacketError(f"a command of more than {LONGEST_COMMAND} characters")
    try:
        given = orjson.loads(data)
    except ValueError as error:
        raise PacketError("JSON that cannot be read") from error
    name = given.pop("type", None) if isinstance(given, dict) else None
    if not isinstance(name, str) or name not in COMMANDS:
        raise PacketError(f"type: expected a command (valid: {', '.join(COMMANDS)})")
    try:
        return name, parse(COMMANDS[name], given, name).model_dump()
    except ConfigError as error:
        raise PacketError(" ".join(str(error).split())) from None
