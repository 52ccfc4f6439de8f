"""Head files of older versions: what they call differently, and what it is called now.

| version | said | now |
|---|---|---|
| 0.1.0, no `version` | `buses.NAME.family: dynamixel` | `dynamixel2` |
| 0.1.0, no `version` | `safety.registers.drive_mode` | `safety.stored.drive_mode`: compared, no longer written |
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from sfms_robot.config.named_bus import FORMER_FAMILIES

VERSION: Final = 1
_STORED: Final = "drive_mode"


def migrated(raw: Any) -> Any:
    """A head as plain data in the words of this version; what has the wrong type is left to the models.

    Raises ValueError for a version that is not known yet.
    """
    if not isinstance(raw, dict):
        return raw
    version = raw.get("version", VERSION)
    if isinstance(version, int) and version > VERSION:
        raise ValueError(f"version = {version} is of a newer sfms-robot; this one reads version {VERSION}")
    out = dict(raw)
    if isinstance(raw.get("safety"), dict):
        out["safety"] = _stored(raw["safety"])
    if isinstance(raw.get("joints"), dict):
        out["joints"] = {name: _joint(joint) for name, joint in raw["joints"].items()}
    return out


def former_words(raw: Any) -> Iterator[str]:
    """One line for each word of an older version: its key, and what to say now."""
    if not isinstance(raw, dict):
        return
    for name, bus in _tables(raw.get("buses")):
        if (family := str(bus.get("family"))) in FORMER_FAMILIES:
            yield f"buses.{name}.family: {family!r} is called {FORMER_FAMILIES[family]!r} now"
    for where, holder in [("", raw), *((f"joints.{name}.", joint) for name, joint in _tables(raw.get("joints")))]:
        safety = holder.get("safety")
        if isinstance(safety, dict) and _has_former_register(safety):
            yield f"{where}safety.registers.{_STORED} is {where}safety.stored.{_STORED} now: compared, never written"


def _tables(value: Any) -> Iterator[tuple[Any, dict[Any, Any]]]:
    if isinstance(value, dict):
        yield from ((name, each) for name, each in value.items() if isinstance(each, dict))


def _joint(joint: Any) -> Any:
    if isinstance(joint, dict) and isinstance(joint.get("safety"), dict):
        return {**joint, "safety": _stored(joint["safety"])}
    return joint


def _has_former_register(safety: dict[Any, Any]) -> bool:
    return isinstance(safety.get("registers"), dict) and _STORED in safety["registers"]


def _stored(safety: dict[Any, Any]) -> dict[Any, Any]:
    if not _has_former_register(safety):
        return safety
    registers = dict(safety["registers"])
    stored = safety.get("stored") or {}
    return {**safety, "registers": registers, "stored": {_STORED: registers.pop(_STORED), **stored}}
