"""Engines, which compute a listener's networks: the interface between a stream (numpy) and onnxruntime or torch.

A stream calls networks by name: arrays in, arrays out, no state kept. There are two engines. `OnnxEngine` runs graphs
in onnxruntime without torch: it starts in a tenth of torch's time and runs small models in half its time. `TorchEngine`
(`torch_engine`) runs the modules, for listeners without graphs and for the lab; its subclass `BatchEngine` runs many
streams at once on a GPU.

A listener's folder holds its graphs as onnx/NAME.onnx, without weights, and onnx/graphs.json, which lists the weights
that each graph needs and the configuration that they belong to. So a graph that is cut short, belongs to another model
or to weights of other shapes is reported in one line before anything runs.
"""

from __future__ import annotations

import copy
import ctypes
import hashlib
import json
import logging
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Literal, Protocol, Self

import numpy as np
from pydantic import BaseModel

from sfms_robot import config
from sfms_robot.errors import ModelError, first_line
from sfms_robot.frames import Floats, Plan, SpeakerFrame
from sfms_robot.listeners.checkpoint import WEIGHTS, Array, Shapes, stored_tensors

EngineName = Literal["auto", "torch", "onnx"]
Device = Literal["cpu", "cuda"]

KEPT: Final = 4096  # numbers of the largest tensor that streams may read: scales, not weights
ROWS: Final = 64  # rows of a weight that are rounded at a time: rows that fit the cache take half as long
FULL, HALF = 127, 64  # older x86 processors add pairs of products in 16 bits, where full-range integers overflow

log = logging.getLogger(__name__)


class Engine(Protocol):
    """The networks of one listener.

    Attributes:
        name: "torch" or "onnx" with precision, threads or device, such as "onnx int8, 2 threads".
        tensors: tensors of model.safetensors by name that are not weights of a network: scales of motion and sound,
            distributions that streams draw from. Read-only.
    """

    @property
    def name(self) -> str: ...

    @property
    def tensors(self) -> Mapping[str, Array]: ...

    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """Return the outputs of a network, each (N, ...), for N streams.

        `inputs` are (N, ...) in the network's order; an input (1, ...) is the same for all streams.
        """
        ...

    def set_threads(self, threads: int) -> None:
        """Use this many threads from now on."""


class RunsOnEngine:
    """A listener whose networks an engine runs. Its only state is the weights, which the engine holds.

    Attributes:
        hop: frames from one plan to the next; hops: values that `at_hop` accepts.
        horizon: frames of a plan.
        control_frames: numbers of control rows of a step, up to the newest frame and after it; (0, 0) without events.
        control_columns: numbers in such a row; 0 without events.
    """

    engine: Engine
    hop = 1
    hops: Sequence[int] = (1,)
    horizon = 1
    control_frames = (0, 0)
    control_columns = 0

    def at_hop(self, hop: int) -> Self:
        """Return a listener with the same weights that plans every `hop` frames; `hop` is one of `hops`."""
        other = copy.copy(self)
        other.hop = hop
        return other

    def is_due(self, memory: Any) -> bool:
        """Return whether the next frame brings a plan."""
        return True

    def start(self, seed: int) -> Any:
        """Return the memory of a new stream."""
        raise NotImplementedError

    def step(self, speaker: SpeakerFrame, memory: Any, control: Floats | None = None) -> tuple[Plan | None, Any]:
        """Process one frame; return a Plan if one is due, and the next memory. Never changes `memory` in place.

        `control`: rows of `signals.control`, as many as in `control_frames` up to this frame and after it; None
        without events, and for a frame that brings no plan.

        Raises ValueError unless the frame has 640 samples or none and control has the right shape.
        """
        return self.step_each([speaker], [memory], [control])[0]

    def step_each(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[Any], controls: Sequence[Floats | None] | None = None
    ) -> list[tuple[Plan | None, Any]]:
        """Run `step` of N streams of different people, one frame and one memory each, in a fraction of the time.

        Every stream has the same results as alone, in fp32 except for the last digits (sums are added in another
        order): its own plan, or None if none is due. Never changes memories in place. Raises as `step` for the first
        frame that is refused; then no stream has advanced.
        """
        raise NotImplementedError

    def told(self, controls: Sequence[Floats | None]) -> Floats:
        """Stack the `control` of `step` of N streams to (N, P + A, K), 0 for None; (N, 0, 0) without events.

        Raises ValueError for another shape.
        """
        wanted = sum(self.control_frames), self.control_columns
        rows = [np.zeros(wanted, np.float32) if control is None else control for control in controls]
        for row in rows:
            if row.shape != wanted:
                raise ValueError(f"control has shape {row.shape}, not {wanted}")
        return stacked(rows).astype(np.float32)

    def standardise(self, motion: Floats) -> Floats:
        """Return motion (..., C) of the motion space in the units of the model."""
        tensors = self.engine.tensors
        return np.asarray((motion - tensors["motion_mean"]) / tensors["motion_std"], np.float32)

    @property
    def model(self) -> Any:
        """Return the torch model of the engine. Raises ModelError for an engine that has none."""
        model = getattr(self.engine, "model", None)
        if model is None:
            raise ModelError(f"this listener runs on {self.engine.name}: its model can be read with engine torch only")
        return model


def stacked(parts: Sequence[Array]) -> Array:
    """Stack N arrays (...) to (N, ...), read-only: a single array is not copied."""
    return parts[0][None] if len(parts) == 1 else np.stack(parts)


# --- Graphs in a listener's folder ------------------------------------------------------------------------------------

FOLDER: Final = "onnx"
MANIFEST: Final = "graphs.json"
FORMAT: Final = 1
# Settings that graphs do not depend on: they are for the use of the networks' outputs, and for training.
OUTSIDE: Final = frozenset(
    "description hop sampling precision neutral metres_per_unit flame_matrix wav2vec2 scores placement "
    "max_gap_frames".split()
)
OUTSIDE_GROUPS: Final = ("keyframes", "keyframe_cost", "transition_bias")
# Keys that were added after graphs had been exported: their defaults describe those graphs.
LATER: Final[Mapping[str, object]] = {"squashed": False, "schedule": "cosine"}


class Graph(BaseModel):
    """One network.

    Attributes:
        sha256: hash of its ONNX file.
        weights: tensors of model.safetensors that it needs, by name.
        integers: weights among them that it needs in 8 bits (see the function `integers`).
        data: content of its ONNX file, once that was read.
    """

    sha256: str
    weights: tuple[str, ...]
    integers: tuple[str, ...] = ()
    data: bytes = b""


class GraphFolder(BaseModel):
    """The graphs of a listener, as listed in graphs.json.

    Attributes:
        settings: hash of the settings that they belong to (`digest`).
        networks: graphs by name.
        tensors: tensors that model.safetensors must contain (`checkpoint.stored_tensors`).
    """

    format: int
    settings: str
    networks: dict[str, Graph]
    tensors: Shapes

    @property
    def in_integers(self) -> bool:
        """Return whether any graph has layers in 8 bits."""
        return any(graph.integers for graph in self.networks.values())


def digest(settings: config.ListenerSettings) -> str:
    """Return a hash of all settings that a listener's graphs depend on."""
    known = settings.model_dump(mode="json", exclude=set(OUTSIDE))
    for group in known.get("groups", {}).values():
        for key in OUTSIDE_GROUPS:
            group.pop(key)
    for part in (known, known.get("diffusion", {})):
        for key, default in LATER.items():
            if part.get(key) == default:
                del part[key]
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()[:16]


def has_graphs(folder: Path) -> bool:
    """Return whether a listener's folder has graphs, usable or not."""
    return (folder / FOLDER / MANIFEST).is_file()


def read_graphs(folder: Path, settings: config.ListenerSettings, integers: bool = False) -> GraphFolder:
    """Read the graphs of a listener's folder; with `integers` each network that has a graph in 8 bits uses that graph.

    Raises ModelError if a file is missing, cut short, changed, or of another configuration.
    """
    file, remedy = folder / FOLDER / MANIFEST, f"export them again: sfms-robot export {folder}"
    try:
        listed = GraphFolder.model_validate_json(file.read_bytes())
    except OSError:
        raise ModelError(f"{file}: no graphs of this listener for engine onnx; {remedy}") from None
    except ValueError:
        raise ModelError(f"{file}: not a list of graphs; {remedy}") from None
    if listed.format != FORMAT:
        raise ModelError(f"{file}: graphs of format {listed.format}, this version has {FORMAT}; {remedy}")
    if listed.settings != digest(settings):
        raise ModelError(f"{file}: graphs of another configuration than {folder / 'config.yaml'}; {remedy}")
    networks, listed.networks = listed.networks, {}
    for name in {network.removesuffix(".int8") for network in networks}:
        chosen = f"{name}.int8" if integers and f"{name}.int8" in networks else name
        graph = folder / FOLDER / f"{chosen}.onnx"
        try:
            network = networks[chosen]
            network.data = graph.read_bytes()
        except (OSError, KeyError):
            raise ModelError(f"{graph}: no such graph; {remedy}") from None
        if hashlib.sha256(network.data).hexdigest() != network.sha256:
            raise ModelError(f"{graph}: cut short, or of another model than {MANIFEST} next to it; {remedy}")
        listed.networks[name] = network
    return listed


# --- onnxruntime ------------------------------------------------------------------------------------------------------
#
# A session is made of a graph without weights and of the weights of model.safetensors. Large layers may be in 8-bit
# integers: for one stream, the cost of a layer is the time to read its weights, and bytes take a quarter of it. Weights
# are rounded per output row when they are loaded, inputs by their range at each call.


class OnnxEngine:
    """An `Engine` on onnxruntime.

    Args:
        folder: folder of the listener; its weights are read again whenever the number of threads changes.
        graphs: graphs of its networks.
        threads: number of threads that each network may use.

    Raises ModelError as `checkpoint.stored_tensors`, and for a graph that onnxruntime does not accept.
    """

    def __init__(self, folder: Path, graphs: GraphFolder, threads: int = 1) -> None:
        self._folder, self._graphs = folder, graphs
        self.tensors: Mapping[str, Array] = {}
        self._threads = 0
        self._sessions: dict[str, tuple[Any, list[str]]] = {}  # session of each network, and the names of its inputs
        self.set_threads(threads)

    @property
    def name(self) -> str:
        """Return "onnx", the precision and the number of threads."""
        precision = " int8" if self._graphs.in_integers else ""
        return f"onnx{precision}, {self._threads} thread{'s' * (self._threads > 1)}"

    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """Return the outputs of a network, see `Engine.run`."""
        streams = max(map(len, inputs))
        session, names = self._sessions[network]
        arrays = (
            each if len(each) == streams else np.broadcast_to(each, (streams, *each.shape[1:])) for each in inputs
        )
        return tuple(session.run(None, dict(zip(names, map(np.ascontiguousarray, arrays), strict=True))))

    def set_threads(self, threads: int) -> None:
        """Use this many threads from now on; takes as long as loading."""
        if threads == self._threads:
            return
        graphs = self._graphs.networks
        plain = {name for graph in graphs.values() for name in {*graph.weights} - {*graph.integers}}
        rounded = {name for graph in graphs.values() for name in graph.integers}
        values, small = {}, {}
        for name, weight in stored_tensors(self._folder / WEIGHTS, self._graphs.tensors):
            if name in plain:
                values[name] = _value(weight)
            if name in rounded:
                values[f"{name}.int8"], values[f"{name}.scale"] = map(_value, integers(weight))
            if weight.size <= KEPT:
                small[name] = weight
        self.tensors = small
        _trim()
        for name, graph in graphs.items():
            session = _session(f"{self._folder}: onnxruntime cannot use graph {name}", graph, values, threads)
            self._sessions[name] = session, [each.name for each in session.get_inputs()]
        self._threads = threads
        del values
        _trim()


def _trim() -> None:
    """Return memory freed after loading to the system, if the C library can; with large layers that is half of all."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def _value(array: Array) -> Any:
    return _onnxruntime().OrtValue.ortvalue_from_numpy(np.asarray(array, order="C"))


def _session(failure: str, graph: Graph, values: Mapping[str, Any], threads: int) -> Any:
    """Return a session of a graph. Raises ModelError, whose text begins with `failure`."""
    onnxruntime = _onnxruntime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # the servo loop uses the other core
    options.log_severity_level = 3
    names = [name for name in graph.weights if name not in graph.integers]
    names += [f"{name}.{part}" for name in graph.integers for part in ("int8", "scale")]
    options.add_external_initializers(names, [values[name] for name in names])
    try:
        return onnxruntime.InferenceSession(graph.data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no exception class for faults of a file
        raise ModelError(f"{failure}: {first_line(error)}") from error


def _onnxruntime() -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # otherwise it looks up a host of its maker
    import onnxruntime

    return onnxruntime


def integers(weight: Floats) -> tuple[Array, Floats]:
    """Return a layer's weight (out, in) as int8 (in, out), and the scale (out,) of each output."""
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
    """Return whether this processor adds products of 8-bit integers in 32 bits (VNNI, or ARM's dot products)."""
    if platform.machine().lower() in ("aarch64", "arm64"):
        return True
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False
    return "avx512_vnni" in flags or "avx_vnni" in flags


# --- Choice of an engine ----------------------------------------------------------------------------------------------
#
# `auto` is onnx if the folder has graphs that fit, else torch. The loading process (`process`) measures whether one
# thread or all free cores are faster. torch is never imported only to measure that it is slower: that would cost two
# seconds and 200 MB.


def graphs_to_run(folder: Path, settings: config.ListenerSettings, wanted: EngineName) -> GraphFolder | None:
    """Return the graphs to run; None for torch. `precision: auto` selects graphs in 8 bits where there are any.

    Raises ModelError.
    """
    precision = settings.precision if isinstance(settings, config.Arig) else "fp32"
    found = None
    if wanted == "onnx" or (wanted == "auto" and has_graphs(folder)):
        try:
            found = read_graphs(folder, settings, integers=precision != "fp32")
        except ModelError as error:
            if wanted == "onnx" or find_spec("torch") is None:
                raise
            log.warning("torch in place of onnx: %s", error)
    if precision == "int8" and (found is None or not found.in_integers):
        raise ModelError(f"{folder}: precision int8, and no graphs in 8 bits: sfms-robot export --int8 {folder}")
    return found
