"""A listener by name, as the loop sees it: in a process of its own, or on another machine."""

from __future__ import annotations

from sfms_robot.config.listener import Calmness
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.process import ListenerProcess
from sfms_robot.listeners.remote import RemoteListener
from sfms_robot.listeners.zenoh_link import ZenohLink
from sfms_robot.network import LOCAL, Router, check_name
from sfms_robot.plugins import REMOTE

NamedFeed = ListenerProcess | RemoteListener


def open_feed(
    name: str, seed: int, calmness: Calmness | None = None, router: Router = LOCAL, engine: EngineName = "auto"
) -> NamedFeed:
    """Return a feed that loads or connects from now on; `wait_loaded` waits.

    `router`: to a listener on another machine, which chooses its engine itself.

    Raises ConfigError, MissingExtra.
    """
    if not name.startswith(REMOTE):
        return ListenerProcess(name, seed, calmness, engine)
    served = check_name(name.removeprefix(REMOTE), "listener")
    return RemoteListener(served, ZenohLink(served, router), seed, calmness)
