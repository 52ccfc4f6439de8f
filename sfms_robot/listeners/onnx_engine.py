"""Networks computed by onnxruntime: no torch, a tenth of its start-up, and small models in half its time.

A session is made of a graph without weights (`graph_folder`) and of the weights, which come from model.safetensors.
Large layers may be in 8-bit integers, which one stream of a large model takes a quarter of the time for: a layer costs
what it takes to read its weights. Those are rounded per output row as they are loaded; the input by its own range.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot import config
from sfms_robot.errors import ModelError, optional
from sfms_robot.frames import Floats
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.engine import Array, Engine, EngineName, one_of
from sfms_robot.listeners.graph_folder import Graph, GraphFolder, has_graphs, read_graphs

log = logging.getLogger(__name__)

KEPT: Final = 4096  # numbers of a tensor that streams may ask for: scales, not weights
ROWS: Final = 64  # of a weight that are rounded at a time: what the cache holds takes half as long
FULL, HALF = 127, 64  # older x86 processors add pairs of products in 16 bits, where whole integers do not fit


class OnnxEngine:
    """`engine.Engine`.

    Args:
        folder: of the listener, for messages.
        graphs: of its networks.
        weights: tensors of model.safetensors with their names, one after another; asked for again whenever the number
            of threads changes.
        threads: that each network may use.
    """

    def __init__(
        self, folder: Path, graphs: GraphFolder, weights: Callable[[], Iterable[tuple[str, Array]]], threads: int = 1
    ) -> None:
        self._folder, self._graphs, self._weights = folder, graphs, weights
        self.tensors: Mapping[str, Array] = {}
        self._threads = 0
        self._sessions: dict[str, Any] = {}
        self._inputs: dict[str, list[str]] = {}
        self.set_threads(threads)

    @property
    def name(self) -> str:
        precision = " int8" if any(graph.integers for graph in self._graphs.graphs.values()) else ""
        return f"onnx{precision}, {self._threads} thread{'s' * (self._threads > 1)}"

    def build_graphs(self) -> None:
        """They are graphs already."""

    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """See `engine.Engine`."""
        streams = max(map(len, inputs))
        names = self._inputs[network]
        told = {name: one_of(each, streams) for name, each in zip(names, inputs, strict=True)}
        return tuple(self._sessions[network].run(None, told))

    def set_threads(self, threads: int) -> None:
        """Use so many from now on; takes as long as loading."""
        if threads == self._threads:
            return
        values, small = _Values(self._graphs.graphs.values()), {}
        for name, weight in self._weights():
            values.add(name, weight)
            if weight.size <= KEPT:
                small[name] = weight
        self.tensors = small
        _trim()
        for name, graph in self._graphs.graphs.items():
            self._sessions[name] = _session(self._folder, name, graph, values, threads)
            self._inputs[name] = [each.name for each in self._sessions[name].get_inputs()]
        self._threads = threads
        del values
        _trim()


def _trim() -> None:
    """Give the system back what loading has left free in between: with large layers half of all memory.

    A C library that has no way to is left alone.
    """
    if sys.platform == "linux":
        import ctypes

        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


class _Values:
    """Weights as onnxruntime takes them; of one in integers only those are kept."""

    def __init__(self, graphs: Collection[Graph]) -> None:
        self._real = {name for graph in graphs for name in graph.weights if name not in graph.integers}
        self._integers = {name for graph in graphs for name in graph.integers}
        self._made: dict[str, Any] = {}

    def add(self, name: str, weight: Array) -> None:
        """Take one, in all forms that graphs want of it."""
        if name in self._real:
            self._made[name] = _value(weight)
        if name in self._integers:
            self._made[f"{name}.int8"], self._made[f"{name}.scale"] = map(_value, integers(weight))

    def of(self, graph: Graph) -> tuple[list[str], list[Any]]:
        """Names of the initialisers of a graph, and their values."""
        names = [name for name in graph.weights if name not in graph.integers]
        names += [f"{name}.{part}" for name in graph.integers for part in ("int8", "scale")]
        return names, [self._made[name] for name in names]


def _value(array: Array) -> Any:
    return _onnxruntime().OrtValue.ortvalue_from_numpy(np.asarray(array, order="C"))


def _session(folder: Path, name: str, graph: Graph, values: _Values, threads: int) -> Any:
    onnxruntime = _onnxruntime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # the servo loop has the other core
    options.log_severity_level = 3
    options.add_external_initializers(*values.of(graph))
    try:
        return onnxruntime.InferenceSession(graph.data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no class of its own for what is wrong with a file
        why = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelError(f"{folder}: onnxruntime cannot use graph {name}: {why}") from error


def _onnxruntime() -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # it looks up its maker's host
    import onnxruntime

    return onnxruntime


def integers(weight: Floats) -> tuple[Array, Floats]:
    """A layer's weight (out, in) -> (in, out) int8, and (out,) scale of each output."""
    most = FULL if whole_integers() else HALF
    rounded, scale = np.empty(weight.shape[::-1], np.int8), np.empty(len(weight), np.float32)
    for row in range(0, len(weight), ROWS):
        part = weight[row : row + ROWS]
        of_rows = np.maximum(np.abs(part).max(1), 1e-12) / most
        rounded[:, row : row + ROWS] = np.rint(part / of_rows[:, None]).astype(np.int8).T
        scale[row : row + ROWS] = of_rows
    return rounded, scale


@lru_cache(maxsize=1)
def whole_integers() -> bool:
    """Whether this processor adds products of 8-bit integers in 32 bits (VNNI, or ARM's dot products)."""
    import platform

    if platform.machine().lower() in ("aarch64", "arm64"):
        return True
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False
    return "avx512_vnni" in flags or "avx_vnni" in flags


# --- Choice of an engine ----------------------------------------------------------------------------------------------
#
# `auto` is onnx where onnxruntime is installed and the folder has graphs that fit, torch elsewhere. The loading
# process (`process`) measures whether one thread or all free cores are faster. No probe imports torch only to
# find that it is slower: that costs two seconds and 200 MB.


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
    with optional(f"{folder}: a listener without graphs of engine onnx"):
        engine = torch_engine()
    if threads is not None:
        engine.set_threads(threads)
    return engine


def _graphs(folder: Path, settings: config.Listener, wanted: EngineName, precision: str) -> GraphFolder | None:
    """The graphs to run; None for torch."""
    if wanted == "torch" or (wanted == "auto" and not has_graphs(folder)):
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
