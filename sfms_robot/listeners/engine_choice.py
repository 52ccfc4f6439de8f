"""Which engine computes the networks of a listener's folder.

`auto` is onnx where onnxruntime is installed and the folder has graphs that fit, torch elsewhere. Whether they run in
one thread or in as many as the machine can spare is measured, by who loads them (`process`): no probe imports torch
only to find that it is slower, which costs two seconds and 200 MB.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from sfms_robot import config
from sfms_robot.errors import MissingExtra, ModelError
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.engine import Engine, EngineName
from sfms_robot.listeners.graph_folder import GraphFolder, has_graphs, read_graphs
from sfms_robot.listeners.onnx_engine import OnnxEngine, available

log = logging.getLogger(__name__)


def engine_of(
    folder: Path,
    settings: config.Listener,
    wanted: EngineName,
    torch_engine: Callable[[], Engine],
    precision: str = "fp32",
    threads: int | None = None,
) -> Engine:
    """The engine of a listener's folder, loaded.

    Args:
        torch_engine: makes that of torch, with the folder's weights.
        precision: of large layers: fp32, int8, or auto, which is int8 where there are graphs of it.
        threads: None for one, and with torch for as many as it uses.

    Raises ModelError, and ConfigError where what `wanted` needs is not installed.
    """
    graphs = _graphs(folder, settings, wanted, precision)
    if graphs is not None:
        file = folder / checkpoint.WEIGHTS
        return OnnxEngine(folder, graphs, lambda: checkpoint.stored_tensors(file, graphs.wanted), threads or 1)
    if find_spec("torch") is None:
        raise MissingExtra(f"{folder}: no graphs for engine onnx, and torch is not installed: pip install torch")
    engine = torch_engine()
    if threads is not None:
        engine.set_threads(threads)
    return engine


def _graphs(folder: Path, settings: config.Listener, wanted: EngineName, precision: str) -> GraphFolder | None:
    """The graphs to run; None for torch."""
    if wanted == "torch" or (wanted == "auto" and not (available() and has_graphs(folder))):
        return None
    try:
        graphs = read_graphs(folder, settings, integers=precision != "fp32")
    except ModelError as error:
        if wanted == "onnx" or find_spec("torch") is None:
            raise
        log.warning("torch in place of onnx: %s", error)
        return None
    if precision == "int8" and not any(graph.integers for graph in graphs.graphs.values()):
        raise ModelError(f"{folder}: precision int8, and no graphs in 8 bits: sfms-robot export --int8 {folder}")
    return graphs
