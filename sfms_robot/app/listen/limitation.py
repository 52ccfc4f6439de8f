"""What a listener's motion space cannot show on any head: said by `run` and `head check`."""

from __future__ import annotations

from sfms_robot.config import load_listener
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.plugins import listener_folder


def limitation(listener: str) -> str | None:
    """One line about a listener by name or folder; None: it can show all channels, or another package brings it.

    Raises ConfigError.
    """
    folder = listener_folder(listener)
    return None if folder is None else MotionSpace.of(load_listener(folder / "config.yaml"), folder).limitation
