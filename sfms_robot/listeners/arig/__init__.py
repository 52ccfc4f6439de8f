"""ARIG: a listener and speaker frame by frame, motion drawn from a diffusion head."""

from __future__ import annotations

from pathlib import Path

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.stream import ArigListener
from sfms_robot.listeners.space import MotionSpace


def load(folder: Path) -> ArigListener:
    """The listener of a folder with config.yaml and model.safetensors. Raises ConfigError or ModelError."""
    settings = checkpoint.load_config(folder)
    if not isinstance(settings, config.Arig):
        raise ConfigError(f"{folder / checkpoint.CONFIG}: kind = {settings.kind!r} is not arig")
    model = ArigModel(settings)
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return ArigListener(settings, model, MotionSpace.of(settings, folder))
