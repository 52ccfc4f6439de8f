"""Listeners that other packages bring: entry points of the group `sfms_robot.listeners`.

Each names a callable that takes what stands behind the colon of `--listener NAME:ARGUMENT` ("" without one) and returns
a `ports.Listener`. It is imported only where the listener is loaded. Shipped names and folders go first.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sfms_robot.data import find
from sfms_robot.errors import ConfigError

if TYPE_CHECKING:  # numpy, which a look at a name does not need
    from sfms_robot.ports import Listener

GROUP: Final = "sfms_robot.listeners"
REMOTE: Final = "zenoh/"  # begins the name of a listener on another machine (`remote`)


def listener_folder(name: str) -> Path | None:
    """Folder of a listener by shipped name or path; None for one that another package brings, or another machine.

    Raises ConfigError with the choices.
    """
    if name.startswith(REMOTE):
        return None
    try:
        return find("listeners", name, "config.yaml")
    except ConfigError:
        if _entry(name) is None:
            raise
        return None


def load_plugin(name: str) -> Listener:
    """The listener that another package registers for `name`, NAME or NAME:ARGUMENT. Raises ConfigError."""
    entry = _entry(name)
    if entry is None:
        raise ConfigError(f"listener {name!r} is registered by no package")
    try:
        build = entry.load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"listener {name!r}: {entry.value} cannot be imported: {error}") from error
    listener: Listener = build(name.partition(":")[2])
    return listener


def _entry(name: str) -> EntryPoint | None:
    bare = name.partition(":")[0]
    return next((entry for entry in entry_points(group=GROUP) if entry.name == bare), None)
