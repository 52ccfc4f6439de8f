"""ARIG: a listener and speaker frame by frame, motion drawn from a diffusion head."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.arig.stream import ArigListener
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.onnx_engine import engine_of
from sfms_robot.listeners.space import MotionSpace

if TYPE_CHECKING:
    from sfms_robot.listeners.arig.model import ArigModel
    from sfms_robot.listeners.torch_engine import TorchEngine


def load(folder: Path, engine: EngineName = "auto", threads: int | None = None) -> ArigListener:
    """The listener of a folder with config.yaml and model.safetensors. Raises ConfigError or ModelError."""
    settings = _settings(folder)
    runs = engine_of(
        folder,
        settings,
        engine,
        lambda: torch_engine(settings, load_model(folder)),
        settings.precision,
        threads=threads,
    )
    return ArigListener(settings, runs, MotionSpace.of(settings, folder))


def load_model(folder: Path) -> ArigModel:
    """Its torch model alone, as `load` raises."""
    from sfms_robot.listeners.arig.model import ArigModel

    model = ArigModel(_settings(folder))
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return model.eval()


def _settings(folder: Path) -> config.Arig:
    settings = checkpoint.load_config(folder)
    if not isinstance(settings, config.Arig):
        raise ConfigError(f"{folder / checkpoint.CONFIG}: kind = {settings.kind!r} is not arig")
    return settings


def torch_engine(settings: config.Arig, model: ArigModel) -> TorchEngine:
    """What runs a model that is at hand, in the precision of the settings. Imports torch; raises ModelError."""
    from sfms_robot.listeners.arig import fast
    from sfms_robot.listeners.arig.frame import examples, networks
    from sfms_robot.listeners.torch_engine import TorchEngine

    quick = fast.with_precision(model, settings.precision).eval()
    return TorchEngine(quick, networks(quick), examples(settings, 1))


def export_graphs(folder: Path, out: Path, int8: bool = False) -> list[Path]:
    """Write the graphs of a listener's folder below `out`; the files written. Raises ConfigError or ModelError.

    Imports torch. `int8`: those with large layers in 8 bits beside those in 32.
    """
    from sfms_robot.listeners.arig import fast
    from sfms_robot.listeners.arig.frame import examples, networks
    from sfms_robot.listeners.arig.model import ArigModel
    from sfms_robot.listeners.export import EXAMPLE_STREAMS, export

    settings = _settings(folder)
    model = ArigModel(settings).eval()
    layers = fast.large_layers(model) if int8 else []
    wanted = networks(model, kept=False)
    return export(out, settings, model, wanted, examples(settings, EXAMPLE_STREAMS), dict.fromkeys(wanted, layers))
