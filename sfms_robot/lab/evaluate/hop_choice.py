"""`--hop N`: a listener as a run has it, which chooses its hop by what it measures."""

from __future__ import annotations

from pathlib import Path

from sfms_robot.errors import ConfigError
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.registry import at_hop, hops_of, load_listener
from sfms_robot.ports import Listener


def load_at_hop(folder: Path, hop: int | None, engine: EngineName = "torch") -> Listener:
    """A listener that plans every `hop` frames; None: as often as its config.yaml says. Raises ConfigError for a hop
    that it cannot be run with, ModelError.
    """
    listener = load_listener(folder, engine=engine)
    choices = hops_of(listener)
    if hop is not None and hop not in choices:
        raise ConfigError(f"--hop {hop}: {folder.name} cannot be run with it ({', '.join(map(str, choices))})")
    return listener if hop is None else at_hop(listener, hop)
