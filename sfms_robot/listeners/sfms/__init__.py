"""SFMS: listening motion as sparse keyframe tokens, and a next-token predictor of them."""

from __future__ import annotations

from pathlib import Path

from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener


def load(folder: Path) -> SfmsListener:
    """The listener of a folder with config.yaml and model.safetensors. Raises ConfigError or ModelError."""
    settings = checkpoint.load_config(folder)
    model = SfmsModel(settings)
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return SfmsListener(settings, model)
