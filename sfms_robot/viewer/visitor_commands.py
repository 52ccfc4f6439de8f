"""What a page may ask for: JSON in, a checked command out. Opens no socket and does nothing.

Only the form is judged here: keys, types, finite numbers. Whether a name is one of this head's, or a value in its
range, is for who does it; what is wrong with either is one line for the visitor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import orjson

from sfms_robot.errors import PacketError

VERSION: Final = 1
LONGEST_COMMAND: Final = 8192  # bytes
LONGEST_PERSON: Final = 262_144  # bytes of a binary message: 2.7 s of sound at 48 kHz
FEEDS: Final = ("voice", "face")
_LONGEST_TEXT: Final = 256
_MOST_NUMBERS: Final = 128

Check = Callable[[Any], Any]


@dataclass(frozen=True)
class Command:
    """One command: its name, and the values of all its keys, given or not."""

    name: str
    values: Mapping[str, Any]


def parse_command(data: str) -> Command:
    """Raises PacketError, in one line, for what is no command of this version."""
    if len(data) > LONGEST_COMMAND:
        raise PacketError(f"a command of more than {LONGEST_COMMAND} characters")
    try:
        told = orjson.loads(data)
    except (ValueError, RecursionError) as error:
        raise PacketError("JSON that cannot be read") from error
    name = told.get("type") if isinstance(told, dict) else None
    if not isinstance(name, str) or name not in COMMANDS:
        raise PacketError(f"no command ({', '.join(COMMANDS)})")
    keys = COMMANDS[name]
    if unknown := sorted(set(told) - set(keys) - {"type"}):
        raise PacketError(f"{name}: {unknown[0][:40]!r} is no key of it ({', '.join(keys) or 'it has none'})")
    values = {}
    for key, (check, default) in keys.items():
        try:
            values[key] = check(told[key]) if key in told else _given(default)
        except ValueError as error:
            raise PacketError(f"{name}: {key} {error}") from None
    return Command(name, values)


_MUST: Final = object()


def _given(default: object) -> object:
    if default is _MUST:
        raise ValueError("is missing")
    return default


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError("is no number")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**32:
        raise ValueError("is no whole number from 0 on")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str) or len(value) > _LONGEST_TEXT or not value.isprintable():
        raise ValueError(f"is no text of up to {_LONGEST_TEXT} characters")
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("is neither true nor false")
    return value


def _anything(value: Any) -> Any:
    if len(orjson.dumps(value)) > _LONGEST_TEXT:
        raise ValueError(f"is longer than {_LONGEST_TEXT} characters")
    return value


def _numbers(value: Any, nothing: bool = False) -> dict[str, float | None]:
    if not isinstance(value, dict) or len(value) > _MOST_NUMBERS:
        raise ValueError(f"is no object of up to {_MOST_NUMBERS} numbers")
    try:
        return {name: None if nothing and each is None else _number(each) for name, each in value.items()}
    except ValueError:
        raise ValueError("has a value that is no number") from None


def _rates(value: Any) -> dict[str, float | None]:
    """Numbers, or null for as people do."""
    return _numbers(value, nothing=True)


def _feeds(value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(each, str) and each in FEEDS for each in value):
        raise ValueError(f"is no list of {', '.join(FEEDS)}")
    return [each for each in FEEDS if each in value]


# By command its keys: how each is checked, and what it is when it is left out.
COMMANDS: Final[Mapping[str, Mapping[str, tuple[Check, object]]]] = {
    "hello": {"version": (_whole, _MUST), "token": (_text, "")},
    "ping": {"id": (_anything, None)},
    "take": {},
    "give": {},
    "halt": {},
    "resume": {},
    "release": {},
    "neutral": {"seconds": (_number, 3.0)},
    "show": {"channels": (_numbers, _MUST), "seconds": (_number, 0.5)},
    "expression": {"name": (_text, _MUST), "seconds": (_number, 2.0)},
    "look_at": {"x_m": (_number, _MUST), "y_m": (_number, _MUST), "z_m": (_number, _MUST), "seconds": (_number, 2.0)},
    "knobs": {"intensity": (_numbers, {}), "style": (_numbers, {})},
    "calm": {"rates": (_rates, _MUST)},
    "listener": {"name": (_text, _MUST)},
    "speaker": {"name": (_text, _MUST)},
    "seed": {"seed": (_whole, _MUST)},
    "record": {"on": (_flag, _MUST)},
    "source": {"feeds": (_feeds, _MUST)},
}
