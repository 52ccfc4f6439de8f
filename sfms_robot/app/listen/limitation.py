"""What a listener's motion space cannot show on any head: said by `run` and `head check`."""

from __future__ import annotations

from sfms_robot.config import find, load_listener
from sfms_robot.listeners.space import MotionSpace


def limitation(listener: str) -> str | None:
    """One line about a listener by name or folder, or None: it can show all channels. Raises ConfigError."""
    folder = find("listeners", listener, "config.yaml")
    return MotionSpace.of(load_listener(folder / "config.yaml"), folder).limitation
