"""ARIG: a listener and speaker frame by frame, motion drawn from a diffusion head.

Sections of the paper and the files that follow them:

    3.1, (1), (2)   what a frame is made from            model.py; streaming: stream.py
    3.2             interactive behaviour understanding  modules.py, ShortRange and LongRange
    3.3             conversational states                modules.py, StateUnderstanding
    3.4             progressive motion prediction        modules.py, Progressive
    3.4, (3), (4)   diffusion head                       sampler.py
    ours            curves of events                     event_curves.py
    ours            networks of a stream, 8-bit layers   networks.py
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sfms_robot import config
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.arig.stream import ArigListener
from sfms_robot.listeners.engine import EngineName, engine_of
from sfms_robot.listeners.space import MotionSpace

if TYPE_CHECKING:
    from sfms_robot.listeners.arig.model import ArigModel
    from sfms_robot.listeners.torch_engine import TorchEngine


def load(folder: Path, engine: EngineName = "auto", threads: int | None = None) -> ArigListener:
    """Load the listener of a folder with config.yaml and model.safetensors. Raises ConfigError or ModelError."""
    settings = checkpoint.config_of(folder, config.Arig)
    precision = settings.precision
    runs = engine_of(folder, settings, engine, lambda: torch_engine(settings, load_model(folder)), precision, threads)
    return ArigListener(settings, runs, MotionSpace.of(settings, folder))


def load_model(folder: Path) -> ArigModel:
    """Load the torch model of a folder alone. Raises as `load`."""
    from sfms_robot.listeners.arig.model import ArigModel

    model = ArigModel(checkpoint.config_of(folder, config.Arig))
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return model.eval()


def torch_engine(settings: config.Arig, model: ArigModel) -> TorchEngine:
    """Return an engine for a model in memory, in the precision of the settings. Imports torch; raises ModelError."""
    from sfms_robot.listeners.arig.networks import networks, with_precision
    from sfms_robot.listeners.torch_engine import TorchEngine

    quick = with_precision(model, settings.precision).eval()
    return TorchEngine(quick, networks(quick))


def export_graphs(folder: Path, out: Path, int8: bool = False) -> list[Path]:
    """Write the graphs of a listener's folder below `out` and return the files. Raises ConfigError or ModelError.

    Imports torch. `int8`: write graphs with large layers in 8 bits as well as those in 32.
    """
    from sfms_robot.listeners.arig.model import ArigModel
    from sfms_robot.listeners.arig.networks import large_layers, networks
    from sfms_robot.listeners.torch_engine import EXAMPLE_STREAMS, TorchEngine, export

    settings = checkpoint.config_of(folder, config.Arig)
    model = ArigModel(settings).eval()
    wanted = networks(model, kept=False)
    listener = ArigListener(settings, TorchEngine(model, wanted))
    layers = large_layers(model) if int8 else []
    return export(out, settings, wanted, listener.examples(EXAMPLE_STREAMS), layers)
