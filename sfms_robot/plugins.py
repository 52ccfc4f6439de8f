"""Plug-ins of other packages: entry points of the groups `sfms_robot.listeners`, `.sources`, `.outputs` and `.buses`.

An entry of the first three names a callable that accepts the text after the colon of NAME:ARGUMENT ("" without one) and
returns a `ports.Listener`, a source or a `ports.Output`; an entry of the last names a `servo.families.BusFamily`. They
are imported only when they are used. Shipped names and folders take precedence.

A plug-in that fails causes a ConfigError of one line for the user who named it. For all others it is left out.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.data import find
from sfms_robot.errors import ConfigError, RobotError, first_line

if TYPE_CHECKING:  # imports numpy, which is not needed to look up a name
    from sfms_robot.ports import Listener

GROUP: Final = "sfms_robot.listeners"
REMOTE: Final = "zenoh/"  # prefix of the name of a listener on another machine (`listeners.remote`)

log = logging.getLogger(__name__)


def plugins(group: str) -> Mapping[str, EntryPoint]:
    """Return the installed entry points of a group by name, not yet imported."""
    return {entry.name: entry for entry in entry_points(group=group)}


def shipped(group: str, **kinds: str) -> Mapping[str, EntryPoint]:
    """Return this package's own kinds of a group by name: `some_kind="module:callable"` becomes some-kind."""
    named = {name.replace("_", "-"): place for name, place in kinds.items()}
    return {name: EntryPoint(name, f"{group}.{place}", group) for name, place in named.items()}


def plug_in(entry: EntryPoint, *arguments: Any, **more: Any) -> Any:
    """Import the object of an entry and return it; with `arguments`, call it and return the result.

    Raises a ConfigError of one line for any error of another package, except for RobotErrors that its callable raises
    on purpose. Errors of this package's own kinds are raised unchanged.
    """
    try:
        found = entry.load()
        return found(*arguments, **more) if arguments else found
    except (Exception, SystemExit) as error:
        if entry.value.startswith("sfms_robot.") or (arguments and isinstance(error, RobotError)):
            raise
        log.info("traceback of plug-in %s", entry.name, exc_info=True)
        raise plugin_error(entry, f"{type(error).__name__}: {first_line(error)}") from error


def plugin_error(entry: EntryPoint, problem: str) -> ConfigError:
    """Return the error that names the plug-in, its package and what is wrong with it."""
    of = f"package {entry.dist.name if entry.dist else 'unknown'}, {entry.value}"
    return ConfigError(f"plug-in {entry.name} ({of}): {problem}")


def listener_folder(name: str) -> Path | None:
    """Return the folder of a listener by shipped name or path; None for a plug-in or a listener on another machine.

    Raises ConfigError that lists the choices.
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
    """Return the listener that another package registers for `name`, NAME or NAME:ARGUMENT. Raises ConfigError."""
    entry = _entry(name)
    if entry is None:
        raise ConfigError(f"listener {name!r} is registered by no package")
    listener: Listener = plug_in(entry, name.partition(":")[2])
    return listener


def _entry(name: str) -> EntryPoint | None:
    return plugins(GROUP).get(name.partition(":")[0])
