"""Which predictor a folder holds. Families are strings, imported only when chosen."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Final, cast

from sfms_robot.listeners.checkpoint import load_config
from sfms_robot.listeners.plugins import listener_folder, load_plugin
from sfms_robot.ports import Listener

# kind -> module with load(folder) -> Listener
LOADERS: Final = {"sfms": "sfms_robot.listeners.sfms", "arig": "sfms_robot.listeners.arig"}


def load_listener(name: str | Path) -> Listener:
    """A listener by shipped name, of a folder with config.yaml and weights, or of another package.

    Raises ConfigError or ModelError.
    """
    folder = listener_folder(str(name))
    if folder is None:
        return load_plugin(str(name))
    module = import_module(LOADERS[load_config(folder).kind])
    return cast(Listener, module.load(folder))


def one_thread() -> None:
    """Make torch repeat itself exactly: one thread, so that sums are added in one order."""
    import torch

    torch.set_num_threads(1)
