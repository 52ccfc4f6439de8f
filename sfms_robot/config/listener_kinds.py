"""The kinds of listeners that a folder may hold: what its config.yaml says, and what loads the folder.

Imported when a listener of that kind is asked for. Listeners of other packages are not folders of ours: see
`plugins`.
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
    """All as "module:name".

    Attributes:
        settings: a subclass of `config.Listener`, the model of config.yaml.
        load: folder, engine, threads or None -> `ports.BatchListener`; raises ConfigError or ModelError.
        export: folder, folder to write to, whether in 8 bits too -> the ONNX files of its networks.
    """

    settings: str
    load: str
    export: str

    def settings_class(self) -> type[Listener]:
        found: type[Listener] = _resolved(self.settings)
        return found

    def load_folder(self, folder: Path, engine: str = "auto", threads: int | None = None) -> Any:
        """The listener of a folder (`ports.BatchListener`), computed by `engine` (`listeners.engine.EngineName`)."""
        return _resolved(self.load)(folder, engine, threads)

    def export_folder(self, folder: Path, out: Path, int8: bool) -> list[Path]:
        """Write graphs of a folder's networks below `out`; the files written."""
        files: list[Path] = _resolved(self.export)(folder, out, int8)
        return files


LISTENER_KINDS: Final[Mapping[str, ListenerKind]] = {
    "sfms": ListenerKind(
        "sfms_robot.config.listener:Sfms", "sfms_robot.listeners.sfms:load", "sfms_robot.listeners.sfms:export_graphs"
    ),
    "arig": ListenerKind(
        "sfms_robot.config.arig:Arig", "sfms_robot.listeners.arig:load", "sfms_robot.listeners.arig:export_graphs"
    ),
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
