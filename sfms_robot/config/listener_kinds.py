"""The kinds of listeners that a folder may hold: what its config.yaml says, and what loads the folder.

Imported when a listener of that kind is asked for, torch too. Listeners of other packages are not folders of ours: see
`listeners.plugins`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from sfms_robot.config.base import parse
from sfms_robot.config.listener import Listener
from sfms_robot.config.yaml_file import read
from sfms_robot.errors import ConfigError


@dataclass(frozen=True)
class ListenerKind:
    """Both as "module:name".

    Attributes:
        settings: a subclass of `config.Listener`, the model of config.yaml.
        load: folder -> `ports.Listener`; raises ConfigError or ModelError.
    """

    settings: str
    load: str

    def settings_class(self) -> type[Listener]:
        found: type[Listener] = _resolved(self.settings)
        return found

    def load_folder(self, folder: Path) -> Any:
        """The listener of a folder (`ports.Listener`)."""
        return _resolved(self.load)(folder)


LISTENER_KINDS: Final[Mapping[str, ListenerKind]] = {
    "sfms": ListenerKind("sfms_robot.config.listener:Sfms", "sfms_robot.listeners.sfms:load"),
    "arig": ListenerKind("sfms_robot.config.arig:Arig", "sfms_robot.listeners.arig:load"),
}


def load_listener(file: Path) -> Listener:
    """Read one listener's YAML file, of any kind. Raises ConfigError."""
    return parse_listener(read(file), file)


def parse_listener(raw: Any, file: Path | str) -> Listener:
    """Validate plain data of a listener. Raises ConfigError."""
    name = str(raw.get("kind")) if isinstance(raw, dict) else ""
    if name not in LISTENER_KINDS:
        raise ConfigError.at(file, "kind", name, "is not a kind of listener", LISTENER_KINDS)
    return parse(LISTENER_KINDS[name].settings_class(), raw, file)


def _resolved(where: str) -> Any:
    module, name = where.split(":")
    return getattr(import_module(module), name)
