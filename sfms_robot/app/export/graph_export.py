"""Graphs of a listener's networks, for onnxruntime."""

from __future__ import annotations

from pathlib import Path

from sfms_robot.config.listener_kinds import LISTENER_KINDS
from sfms_robot.data import find
from sfms_robot.listeners.checkpoint import load_config


def export_listener(name: str, out: Path | None, int8: bool) -> list[Path]:
    """Write the graphs of a listener by shipped name or folder, below its own folder or `out`; the files written.

    `int8`: those with large layers in 8 bits too. Takes a minute. Raises ConfigError, MissingExtra, ModelError.
    """
    folder = find("listeners", name, "config.yaml")
    return LISTENER_KINDS[load_config(folder).kind].export_folder(folder, folder if out is None else out, int8)
