"""Which predictor a folder holds: the kinds of `config.listener_kinds`, imported only when chosen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from sfms_robot.config.calmness import Calmness
from sfms_robot.config.listener_kinds import LISTENER_KINDS
from sfms_robot.listeners.checkpoint import load_config
from sfms_robot.listeners.eventful import EventfulListener, MotionModel
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.listeners.plugins import listener_folder, load_plugin
from sfms_robot.ports import Listener


def load_listener(name: str | Path, graphs: bool = True, calmness: Calmness | None = None) -> Listener:
    """A listener by shipped name, of a folder with config.yaml and weights, or of another package.

    `graphs`: ready to run at full speed, which takes another second or two; else `build_graphs` is still to be called.
    `calmness`: how often a listener that decides events does what. Raises ConfigError or ModelError.
    """
    folder = listener_folder(str(name))
    if folder is None:
        return load_plugin(str(name))
    settings = load_config(folder)
    listener = cast(Listener, LISTENER_KINDS[settings.kind].load_folder(folder))
    if settings.events:
        listener = EventfulListener(cast(MotionModel, listener), EventModel.load(), calmness)
    if graphs:
        build_graphs(listener)
    return listener


def build_graphs(listener: Listener) -> None:
    """The weights stay as they are from now on; a listener of somebody else's may know nothing of graphs."""
    build = getattr(listener, "build_graphs", None)
    if build is not None:
        build()


def hops_of(listener: Listener) -> Sequence[int]:
    """The hops that it can be run with; its own alone, for one that names none."""
    return tuple(getattr(listener, "hops", (listener.hop,)))


def at_hop(listener: Listener, hop: int) -> Listener:
    """The listener, planning every `hop` frames, one of `hops_of`."""
    return listener if hop == listener.hop else cast(Listener, cast(Any, listener).at_hop(hop))


def one_thread() -> None:
    """Make torch repeat itself exactly: one thread, so that sums are added in one order."""
    import torch

    torch.set_num_threads(1)
