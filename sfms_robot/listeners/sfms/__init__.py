"""SFMS: listening motion as sparse keyframe tokens, and a next-token predictor of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.onnx_engine import engine_of
from sfms_robot.listeners.sfms.audio_frontend import AudioFrontend
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace

if TYPE_CHECKING:
    from sfms_robot.listeners.sfms.model import SfmsModel
    from sfms_robot.listeners.torch_engine import TorchEngine


def load(folder: Path, engine: EngineName = "auto", threads: int | None = None) -> SfmsListener:
    """The listener of a folder with config.yaml and model.safetensors. Raises ConfigError or ModelError."""
    settings = _settings(folder)
    runs = engine_of(folder, settings, engine, lambda: torch_engine(settings, load_model(folder)), threads=threads)
    return SfmsListener(settings, runs, MotionSpace.of(settings, folder), AudioFrontend.of(settings, folder))


def load_model(folder: Path) -> SfmsModel:
    """Its torch model alone, as `load` raises."""
    from sfms_robot.listeners.sfms.model import SfmsModel

    model = SfmsModel(_settings(folder))
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return model.eval()


def _settings(folder: Path) -> config.Sfms:
    settings = checkpoint.load_config(folder)
    if not isinstance(settings, config.Sfms):
        raise ConfigError(f"{folder / checkpoint.CONFIG}: kind = {settings.kind!r} is not sfms")
    return settings


def torch_engine(settings: config.Sfms, model: SfmsModel) -> TorchEngine:
    """What runs a model that is at hand. Imports torch."""
    from sfms_robot.listeners.sfms.networks import examples, networks
    from sfms_robot.listeners.torch_engine import TorchEngine

    return TorchEngine(model, networks(model, settings), examples(settings, 1))


def export_graphs(folder: Path, out: Path, int8: bool = False) -> list[Path]:
    """Write the graphs of a listener's folder below `out`; the files written. Raises ConfigError or ModelError.

    Imports torch. `int8` changes nothing: layers of this size gain nothing by it.
    """
    from sfms_robot.listeners.export import EXAMPLE_STREAMS, export
    from sfms_robot.listeners.sfms.model import SfmsModel
    from sfms_robot.listeners.sfms.networks import examples, networks

    settings = _settings(folder)
    model = SfmsModel(settings).eval()
    return export(out, settings, model, networks(model, settings), examples(settings, EXAMPLE_STREAMS), {})
