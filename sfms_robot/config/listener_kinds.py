"""The kinds of listeners there are: what a folder's config.yaml holds, and what loads the folder.

A kind of somebody else's is an entry point of the group `sfms_robot.listeners`, named as `kind:` in config.yaml says,
whose object is a `ListenerKind`. Everything is imported when a listener of that kind is asked for, torch too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Final

from sfms_robot.config.base import parse
from sfms_robot.config.listener import Listener
from sfms_robot.config.yaml_file import read
from sfms_robot.errors import ConfigError

GROUP: Final = "sfms_robot.listeners"


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


def listener_kind(name: str, file: Path | str, others: Iterable[EntryPoint] | None = None) -> ListenerKind:
    """The kind of that name, ours first; `file` is only for the message.

    Raises ConfigError naming every kind, or what is wrong with the package that brings it.
    """
    if name in LISTENER_KINDS:
        return LISTENER_KINDS[name]
    known = {each.name: each for each in (entry_points(group=GROUP) if others is None else others)}
    if name not in known:
        raise ConfigError.at(file, "kind", name, "is not a kind of listener", [*LISTENER_KINDS, *known])
    try:
        kind = known[name].load()
    except (ImportError, AttributeError) as error:
        raise ConfigError.at(file, "kind", name, f"cannot be imported from {known[name].value}: {error}") from error
    if not isinstance(kind, ListenerKind):
        raise ConfigError.at(file, "kind", name, f"of {known[name].value} is no ListenerKind")
    return kind


def load_listener(file: Path) -> Listener:
    """Read one listener's YAML file, of any kind. Raises ConfigError."""
    return parse_listener(read(file), file)


def parse_listener(raw: Any, file: Path | str, others: Iterable[EntryPoint] | None = None) -> Listener:
    """Validate plain data of a listener. Raises ConfigError."""
    name = str(raw.get("kind")) if isinstance(raw, dict) else ""
    return parse(listener_kind(name, file, others).settings_class(), raw, file)


def _resolved(where: str) -> Any:
    module, name = where.split(":")
    return getattr(import_module(module), name)
