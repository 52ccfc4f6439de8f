"""SFMS: listening motion as sparse keyframe tokens, and a predictor of the next tokens.

Sections of the paper and the files that follow them:

    IV-A   features of sound                         audio_frontend.py (shared with ARIG)
    IV-B2  keyframe discovery                        placement.py, piecewise_linear.py
    IV-B4  codes of keyframes                        quantizer.py
    IV-B5  from keyframes to every frame             model.py
    IV-C   predictor of listening motion             predictor.py
    ours   drawing tokens, and running as a stream   draw.py, stream.py
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sfms_robot import config
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.audio_frontend import AudioFrontend
from sfms_robot.listeners.engine import EngineName, engine_of
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace

if TYPE_CHECKING:
    from sfms_robot.listeners.sfms.model import SfmsModel
    from sfms_robot.listeners.torch_engine import TorchEngine


def load(folder: Path, engine: EngineName = "auto", threads: int | None = None) -> SfmsListener:
    """Load the listener of a folder with config.yaml and model.safetensors. Raises ConfigError or ModelError."""
    settings = checkpoint.config_of(folder, config.Sfms)
    runs = engine_of(folder, settings, engine, lambda: torch_engine(settings, load_model(folder)), threads=threads)
    return SfmsListener(settings, runs, MotionSpace.of(settings, folder), AudioFrontend.of(settings, folder))


def load_model(folder: Path) -> SfmsModel:
    """Load the torch model of a folder alone. Raises as `load`."""
    from sfms_robot.listeners.sfms.model import SfmsModel

    model = SfmsModel(checkpoint.config_of(folder, config.Sfms))
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return model.eval()


def torch_engine(settings: config.Sfms, model: SfmsModel) -> TorchEngine:
    """Return an engine for a model in memory. Imports torch."""
    from sfms_robot.listeners.sfms.model import networks
    from sfms_robot.listeners.torch_engine import TorchEngine

    return TorchEngine(model, networks(model, settings))


def export_graphs(folder: Path, out: Path, int8: bool = False) -> list[Path]:
    """Write the graphs of a listener's folder below `out` and return the files. Raises ConfigError or ModelError.

    Imports torch. `int8` changes nothing: layers of this size gain nothing from it.
    """
    from sfms_robot.listeners.sfms.model import SfmsModel, networks
    from sfms_robot.listeners.torch_engine import EXAMPLE_STREAMS, TorchEngine, export

    settings = checkpoint.config_of(folder, config.Sfms)
    model = SfmsModel(settings).eval()
    wanted = networks(model, settings)
    frontend = AudioFrontend(settings.audio, settings.phase)  # without the model of wav2vec2: nothing is heard
    listener = SfmsListener(settings, TorchEngine(model, wanted), frontend=frontend)
    return export(out, settings, wanted, listener.examples(EXAMPLE_STREAMS))
