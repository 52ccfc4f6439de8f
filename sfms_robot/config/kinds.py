"""Which family a listener's file is of: its `kind` says it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from sfms_robot.config.arig import Arig
from sfms_robot.config.base import parse
from sfms_robot.config.listener import Listener, Sfms
from sfms_robot.config.yaml_file import read
from sfms_robot.errors import ConfigError

KINDS: Final[Mapping[str, type[Listener]]] = {"sfms": Sfms, "arig": Arig}


def load_listener(file: Path) -> Listener:
    """Read one listener's YAML file, of any kind. Raises ConfigError."""
    return parse_listener(read(file), file)


def parse_listener(raw: Any, file: Path | str) -> Listener:
    """Validate plain data of a listener. Raises ConfigError."""
    kind = str(raw.get("kind")) if isinstance(raw, dict) else ""
    if kind not in KINDS:
        raise ConfigError.at(file, "kind", kind, "is not a kind of listener", KINDS)
    return parse(KINDS[kind], raw, file)
