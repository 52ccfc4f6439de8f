"""Which predictor a folder holds: the kinds of `config.listener_kinds`, imported only when chosen."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from sfms_robot.config import find
from sfms_robot.config.listener_kinds import listener_kind
from sfms_robot.listeners.checkpoint import CONFIG, load_config
from sfms_robot.ports import Listener


def load_listener(name: str | Path) -> Listener:
    """A listener by shipped name, or of a folder with config.yaml and weights. Raises ConfigError or ModelError."""
    folder = find("listeners", str(name), CONFIG)
    return cast(Listener, listener_kind(load_config(folder).kind, folder / CONFIG).load_folder(folder))


def one_thread() -> None:
    """Make torch repeat itself exactly: one thread, so that sums are added in one order."""
    import torch

    torch.set_num_threads(1)
