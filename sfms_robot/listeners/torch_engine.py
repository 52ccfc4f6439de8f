"""Networks on torch: run as modules, as CUDA graphs, or written as ONNX graphs without weights.

`TorchEngine` runs a listener's networks, `BatchEngine` those of many streams together on a GPU. `export` writes them
for `engine.OnnxEngine`: torch.export traces a network for any number of streams, torch.onnx writes it, onnxscript
simplifies it. Weights keep their names from model.safetensors, and graphs contain none of their values. So graphs are
small, and work with all weights trained for the same configuration. `export` needs the extra `export`.
"""

from __future__ import annotations

import copy
import hashlib
import json
import logging
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.errors import ConfigError, ModelError, optional
from sfms_robot.frames import FRAME_S, SILENCE, SpeakerFrame
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.networks import large_layers
from sfms_robot.listeners.arig.networks import networks as arig_networks
from sfms_robot.listeners.arig.stream import ArigListener
from sfms_robot.listeners.checkpoint import WEIGHTS, Array, load_config, load_weights
from sfms_robot.listeners.engine import FOLDER, FORMAT, MANIFEST, Device, RunsOnEngine, digest
from sfms_robot.listeners.layers import Network, Tensors
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.model import networks as sfms_networks
from sfms_robot.listeners.sfms.stream import SfmsListener

Networks = Mapping[str, Network[Any]]  # by name

MODEL: Final = "model."  # prefix of the name of a weight, in every network
MOST_STREAMS: Final = 4096
EXAMPLE_STREAMS: Final = 3
ONE_STREAM: Final = "rest"  # the network that is called once, for one stream, when a listener is loaded


class TorchEngine:
    """An `engine.Engine` on torch.

    Args:
        model: model of the listener; `tensors` shows its current state.
        networks: networks of the model.
    """

    def __init__(self, model: nn.Module, networks: Networks) -> None:
        self.name = "torch"
        self.model = model.eval()
        self.tensors = {name: value.detach().numpy() for name, value in model.state_dict().items()}
        self._networks = networks

    @torch.inference_mode()
    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """Return the outputs of a network, see `engine.Engine.run`."""
        return tuple(output.numpy() for output in self._networks[network](*_tensors(inputs)))

    def set_threads(self, threads: int) -> None:
        """Use this many threads in the whole process: torch has no other setting."""
        torch.set_num_threads(threads)


class BatchEngine(TorchEngine):
    """An engine for many streams: each network is computed for a whole batch at once, on a GPU as one CUDA graph.

    A batch is padded to the next power of two with rows that are computed and dropped, so that few graphs serve all
    numbers of streams. A graph is captured when its size is first needed. No network makes a tensor on the CPU or reads
    a value (a law of the tests), because that cannot be captured.

    Raises MemoryError, from `run` too, if the GPU has too little memory; no stream has advanced then.
    """

    def __init__(self, model: nn.Module, networks: Networks, device: torch.device) -> None:
        super().__init__(model, networks)
        self._device, self._pool = device, None
        self._batches: dict[tuple[object, ...], _NetworkBatch] = {}
        with self._enough_memory(1):
            self.model.to(device)
            if device.type == "cuda":
                self._pool = torch.cuda.graph_pool_handle()
        self.name = f"torch on {torch.cuda.get_device_name(device) if device.type == 'cuda' else 'cpu'}"

    @torch.inference_mode()
    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """Return the outputs of a network, see `engine.Engine.run`."""
        streams = max(map(len, inputs))
        size = 1 << (streams - 1).bit_length()
        tensors = _tensors(inputs)
        key = (network, size, *(each.shape[1:] for each in tensors))
        with self._enough_memory(streams):
            if key not in self._batches:
                pool = None if network == ONE_STREAM else self._pool
                self._batches[key] = _NetworkBatch(self._networks[network], tensors, size, self._device, pool)
            return self._batches[key].run(tensors, streams)

    @contextmanager
    def _enough_memory(self, streams: int) -> Iterator[None]:
        try:
            yield
        except torch.OutOfMemoryError as error:
            self._batches.clear()
            torch.cuda.empty_cache()  # does nothing without a GPU
            raise MemoryError(f"too little memory on the GPU for {streams} heads at once") from error


class _NetworkBatch:
    """Input buffers of a network for `size` streams, and the CUDA graph that computes its outputs from them.

    `pool`: memory of the graph; None: without a graph.
    """

    def __init__(self, network: nn.Module, like: Sequence[Tensor], size: int, device: torch.device, pool: Any) -> None:
        self._network = network
        self._inputs = [torch.zeros((size, *each.shape[1:]), dtype=each.dtype, device=device) for each in like]
        self._graph: torch.cuda.CUDAGraph | None = None
        self._outputs: Tensors = ()
        # Waiting for a blocking event leaves the core to the other processes of `serve`; copying to the CPU would spin.
        self._done = torch.Event(device, blocking=True) if device.type == "cuda" else None
        if pool is not None:
            for _ in range(2):  # tensors that the network makes only once, such as places, are made before the capture
                network(*self._inputs)
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph, pool=pool):
                self._outputs = network(*self._inputs)

    def run(self, inputs: Sequence[Tensor], streams: int) -> tuple[Array, ...]:
        """Return the outputs (streams, ...) of inputs (streams, ...) or (1, ...)."""
        for kept, each in zip(self._inputs, inputs, strict=True):
            # An input is copied while the next one is prepared only if it is in pinned memory.
            kept[:streams].copy_(each.pin_memory() if kept.is_cuda else each, non_blocking=True)
        outputs = self._outputs
        if self._graph is None:
            outputs = self._network(*self._inputs)
        else:
            self._graph.replay()
        if self._done is not None:
            self._done.record()
            self._done.synchronize()
        return tuple(each[:streams].to("cpu", copy=True).numpy() for each in outputs)


class RecordingEngine(TorchEngine):
    """An engine that keeps the inputs of the last call of each network, by name, as examples."""

    def __init__(self, model: nn.Module, networks: Networks) -> None:
        super().__init__(model, networks)
        self.examples: dict[str, dict[str, Tensor]] = {}

    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """Return the outputs of a network, see `engine.Engine.run`."""
        module, streams = self._networks[network], max(map(len, inputs))
        names: list[str] = [*signature(module.forward).parameters]
        if module.further:  # these names replace *parts
            names[-1:] = module.further
        arrays = _tensors(np.broadcast_to(each, (streams, *each.shape[1:])) for each in inputs)
        self.examples[network] = dict(zip(names, arrays, strict=False))
        return super().run(network, *inputs)


def new_model(settings: config.ListenerSettings) -> SfmsModel | ArigModel:
    """Return the model of a configuration with weights drawn by torch's seed."""
    if isinstance(settings, config.Sfms):
        return SfmsModel(settings)
    assert isinstance(settings, config.Arig)
    return ArigModel(settings)


def load_model(folder: Path) -> SfmsModel | ArigModel:
    """Load the torch model of a listener's folder. Raises ConfigError or ModelError."""
    model = new_model(load_config(folder))
    load_weights(folder / WEIGHTS, model)
    return model.eval()


def networks_of(model: SfmsModel | ArigModel) -> Networks:
    """Return the networks of a model by name."""
    return arig_networks(model) if isinstance(model, ArigModel) else sfms_networks(model)


def torch_engine(model: SfmsModel | ArigModel, device: Device = "cpu") -> TorchEngine:
    """Return an engine for a model in memory; a `BatchEngine` for a GPU. Raises ConfigError without a GPU."""
    if device == "cpu":
        return TorchEngine(model, networks_of(model))
    if not torch.cuda.is_available():
        raise ConfigError(f"--device {device}: torch sees no CUDA device here (valid: cpu)")
    return BatchEngine(model, networks_of(model), torch.device(device))


def _tensors(arrays: Iterable[Array]) -> Tensors:
    """Return arrays as tensors of the same memory; read-only arrays, which torch does not support, are copied."""
    return tuple(torch.from_numpy(each if each.flags.writeable else each.copy()) for each in arrays)


# --- Export -----------------------------------------------------------------------------------------------------------
#
# Steps from a network to its graph:
#
#     1. torch.export: a program in which the number of streams N is a symbol. Modules write attention and LayerNorm as
#        the one operator that onnxruntime has for each (`layers.attention`).
#     2. torch.onnx: initialisers hold the weights, "model.NAME", and constants.
#     3. Weights become inputs, onnxscript folds constants and removes unused parts, weights become initialisers again.
#        As initialisers they would be folded into the graph; inputs have no values.
#     4. The file is written with initialisers that have a name, a shape and a type, but refer to model.safetensors for
#        their content, which `engine` hands to the session (`_written`).


def export(
    folder: Path, out: Path, int8: bool = False, moved: Callable[[float, float, str], object] = lambda *_: None
) -> list[Path]:
    """Write the graphs of a listener's folder below `out` and return the files. Takes half a minute to two minutes.

    `moved`: is called before each graph with the number of graphs made, their total number, and the graph's name.
    `int8`: a second graph of each network has its large layers in 8 bits. SFMS, whose layers are small, has none.

    Raises ConfigError, MissingExtra, and ModelError if `out` cannot be written.
    """
    settings = load_config(folder)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = new_model(settings).eval()
    recorder = RecordingEngine(model, networks_of(model))
    listener: RunsOnEngine
    if isinstance(model, ArigModel):
        listener = ArigListener(model.settings, recorder, folder)
    else:
        listener = SfmsListener(model.settings, recorder, folder)
    control = np.zeros((sum(listener.control_frames), listener.control_columns), np.float32)
    speakers = [SpeakerFrame(FRAME_S, SILENCE) for _ in range(EXAMPLE_STREAMS)]
    memories: list[Any] = [listener.start(seed) for seed in range(EXAMPLE_STREAMS)]
    listener.step_each(speakers, memories, [control] * EXAMPLE_STREAMS)
    models: dict[str, SfmsModel | ArigModel] = {"": model}
    if int8 and isinstance(model, ArigModel) and large_layers(model):
        models[".int8"] = in_integers(model)
    graphs: dict[str, Any] = {}
    wanted = [(suffix, *each) for suffix, one in models.items() for each in networks_of(one).items()]
    for suffix, name, network in wanted:
        moved(len(graphs), len(wanted), f"graph {name}{suffix}")
        with torch.no_grad():
            graphs[name + suffix] = _graph(network.eval(), recorder.examples[name], several=name != ONE_STREAM)
    state: dict[str, Tensor] = model.state_dict()
    known: dict[str, Any] = {}
    files: list[Path] = []
    try:
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
        for name, graph in graphs.items():
            data, known[name] = _written(graph, state)
            files.append(out / FOLDER / f"{name}.onnx")
            files[-1].write_bytes(data)
        manifest = {
            "format": FORMAT,
            "settings": digest(settings),
            "tensors": {name: (list(value.shape), value.is_floating_point()) for name, value in state.items()},
            "networks": known,
        }
        files.append(out / FOLDER / MANIFEST)
        files[-1].write_text(json.dumps(manifest, indent=0) + "\n", encoding="utf-8")
    except OSError as error:
        raise ModelError(f"{out / FOLDER}: cannot be written: {error.strerror}") from error
    return files


class IntegerWeight(nn.Module):
    """Names and shapes of a weight in 8 bits, which is rounded when a graph is loaded (`engine.integers`)."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.int8 = nn.Buffer(torch.zeros(weight.T.shape, dtype=torch.int8))
        self.scale = nn.Buffer(torch.zeros(len(weight)))


class IntegerLinear(nn.Module):
    """A linear layer of a graph that multiplies in 8 bits (step 1)."""

    def __init__(self, layer: nn.Linear) -> None:
        super().__init__()
        self.weight, self.bias = IntegerWeight(layer.weight), layer.bias

    def forward(self, x: Tensor) -> Tensor:
        """Return (..., out) of x (..., in)."""
        product, shape = "com.microsoft::DynamicQuantizeMatMul", (*x.shape[:-1], len(self.weight.scale))
        inputs = (x, self.weight.int8, self.weight.scale, None, self.bias)  # None: zero point of 0
        return torch.onnx.ops.symbolic(product, inputs, dtype=x.dtype, shape=shape)


def in_integers(model: ArigModel) -> ArigModel:
    """Return a copy of a model whose `large_layers` multiply in 8 bits, for a graph."""
    model = copy.deepcopy(model)
    for name in large_layers(model):
        parent, own = model.get_submodule(name.rpartition(".")[0].rpartition(".")[0]), name.split(".")[-2]
        setattr(parent, own, IntegerLinear(getattr(parent, own)))
    return model


def _graph(network: Network[Any], example: Mapping[str, Tensor], several: bool) -> Any:
    """Return a simplified `onnx_ir.Model` whose weights are values without content (steps 1 to 3)."""
    with optional("sfms-robot export"):
        import onnxscript
    dynamic: tuple[Any, ...] | None = None
    if several:
        streams, free = (torch.export.Dim(name, min=1, max=MOST_STREAMS) for name in ("streams", "free"))
        dynamic = tuple({0: streams} | ({1: free} if name in network.free else {}) for name in example)
        if network.further:  # in the form of the arguments of `forward`, where *parts is one argument
            named = len(dynamic) - len(network.further)
            dynamic = (*dynamic[:named], dynamic[named:])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        quiet = logging.getLogger("torch.onnx")
        level = quiet.level
        quiet.setLevel(logging.ERROR)
        try:
            program = torch.export.export(network, tuple(example.values()), dynamic_shapes=dynamic, strict=False)
            exported = torch.onnx.export(program, dynamo=True, verbose=False, optimize=False, input_names=list(example))
        finally:
            quiet.setLevel(level)
    if exported is None:
        raise ModelError("torch.onnx made no graph")
    graph: Any = exported.model.graph
    held = [value for name, value in graph.initializers.items() if name.startswith(MODEL)]
    kept = {value.name: value.const_value for value in held}
    for value in held:  # step 3: weights become inputs, which cannot be folded into the graph
        del graph.initializers[value.name]
        value.const_value = None
        graph.inputs.append(value)
    onnxscript.optimizer.optimize_ir(exported.model)
    for value in held:
        graph.inputs.remove(value)
        value.const_value = kept[value.name]
        if value.uses():
            graph.initializers[value.name] = value
    return exported.model


def _written(model: Any, state: Mapping[str, Tensor]) -> tuple[bytes, dict[str, Any]]:
    """Return the file of a graph (step 4) and its entry in the manifest."""
    import onnx
    import onnx_ir

    proto = onnx_ir.to_proto(model)
    graph = proto.graph
    # The file contains nothing about the machine and the source files that made it.
    for part in (proto, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    graph.ClearField("value_info")
    proto.producer_name, proto.producer_version = "sfms-robot", ""
    weights, layers = [], []
    names: dict[str, str] = {}  # old name of each initialiser -> written name
    for tensor in graph.initializer:
        name = tensor.name.removeprefix(MODEL)
        if name.removesuffix(".int8") in state and name.endswith(".int8"):
            layers.append(name.removesuffix(".int8"))
        elif name in state and tensor.name.startswith(MODEL):
            weights.append(name)
        elif not (name.endswith(".scale") and name.removesuffix(".scale") in state):
            continue  # a constant
        names[tensor.name] = name
        shape, kind = list(tensor.dims), tensor.data_type
        tensor.CopyFrom(onnx.TensorProto(name=name, dims=shape, data_type=kind))
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=WEIGHTS)
    for node in graph.node:
        node.input[:] = [names.get(used, used) for used in node.input]
    data = proto.SerializeToString(deterministic=True)
    known = {
        "sha256": hashlib.sha256(data).hexdigest(),
        "weights": sorted(weights + layers),
        "integers": sorted(layers),
    }
    return data, known
