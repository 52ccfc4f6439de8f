"""SFMS: listening motion as sparse keyframe tokens, and a next-token predictor of them."""

from __future__ import annotations

from pathlib import Path

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.audio_frontend import AudioFrontend
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace


def load(folder: Path) -> SfmsListener:
    """The listener of a folder with config.yaml and model.safetensors. Raises ConfigError or ModelError."""
    settings = checkpoint.load_config(folder)
    if not isinstance(settings, config.Sfms):
        raise ConfigError(f"{folder / checkpoint.CONFIG}: kind = {settings.kind!r} is not sfms")
    model = SfmsModel(settings)
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return SfmsListener(settings, model, MotionSpace.of(settings, folder), AudioFrontend.of(settings, folder))
