"""Networks on torch: run as modules, or written as ONNX graphs without weights.

`TorchEngine` runs a listener's networks. `export` writes them for `engine.OnnxEngine`: torch.export traces a network
for any number of streams, torch.onnx writes it, onnxscript simplifies it. Weights keep the names that they have in
model.safetensors and none of their values goes into a graph: so graphs are small, and all weights trained for the same
configuration run on them. `export` needs the extra `export`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import warnings
from collections.abc import Iterable, Mapping
from inspect import signature
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.errors import ModelError, optional
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, SpeakerFrame
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.networks import large_layers
from sfms_robot.listeners.arig.networks import networks as arig_networks
from sfms_robot.listeners.checkpoint import WEIGHTS, Array, load_config, load_weights
from sfms_robot.listeners.engine import FOLDER, FORMAT, MANIFEST, RunsOnEngine, digest
from sfms_robot.listeners.registry import model_of_motion
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.model import networks as sfms_networks
from sfms_robot.signals.control import COLUMNS

Networks = Mapping[str, nn.Module]  # by name; modules whose inputs and outputs are tensors

MODEL: Final = "model."  # before the name of a weight, in every network
MOST_STREAMS: Final = 4096
EXAMPLE_STREAMS: Final = 3
ONE_STREAM: Final = "rest"  # the network that is called once, for one stream, when a listener is loaded


class TorchEngine:
    """An `engine.Engine` on torch.

    Args:
        model: `tensors` shows its current state.
        networks: of the model.
    """

    name = "torch"

    def __init__(self, model: nn.Module, networks: Networks) -> None:
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


class Recorder(TorchEngine):
    """An engine that keeps the inputs of the last call of each network, by name, as examples."""

    def __init__(self, model: nn.Module, networks: Networks) -> None:
        super().__init__(model, networks)
        self.examples: dict[str, dict[str, Tensor]] = {}

    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """Return the outputs of a network, see `engine.Engine.run`."""
        module, streams = self._networks[network], max(map(len, inputs))
        names = [*signature(module.forward).parameters]
        if further := getattr(module, "further", ()):  # in place of *parts
            names[-1:] = further
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


def torch_engine(model: SfmsModel | ArigModel) -> TorchEngine:
    """Return an engine for a model in memory."""
    return TorchEngine(model, networks_of(model))


def _tensors(arrays: Iterable[Array]) -> tuple[Tensor, ...]:
    """Return arrays as tensors of the same memory; read-only ones, which torch does not know, are copied."""
    return tuple(torch.from_numpy(each if each.flags.writeable else each.copy()) for each in arrays)


# --- Export -----------------------------------------------------------------------------------------------------------
#
# What is done to the graph of a network:
#
#     1. torch.export: a program in which the number of streams N is a symbol. Modules write attention and LayerNorm as
#        the one operator that onnxruntime has for each (`layers.exported_attention`).
#     2. torch.onnx: initialisers hold the weights, "model.NAME", and constants.
#     3. Weights become inputs, onnxscript folds constants and removes what is not used, weights become initialisers
#        again. As initialisers they would be folded into the graph; values of inputs are not known.
#     4. For 8 bits, each product of a large layer is replaced (`_with_integers`):
#
#            W -> Transpose -> MatMul(x, .) -> Add(., b)   }
#            Gemm(x, W, b)                                 }  ->  DynamicQuantizeMatMul(x, W.int8, W.scale, -, b)
#
#        onnxruntime rounds x by its own range, multiplies integers and scales the result.
#     5. The file is written with initialisers that have a name, a shape and a type, but refer to model.safetensors for
#        their content, which `engine` hands to the session (`_written`).


def export(folder: Path, out: Path, int8: bool = False) -> list[Path]:
    """Write the graphs of a listener's folder below `out` and return the files. Takes half a minute to two.

    `int8`: a second graph of each network has its large layers in 8 bits. SFMS, whose layers are small, has none.

    Raises ConfigError, MissingExtra, and ModelError where `out` cannot be written.
    """
    settings = load_config(folder)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = new_model(settings).eval()
    layers = large_layers(model) if int8 and isinstance(model, ArigModel) else []
    recorder = Recorder(model, networks_of(model))
    listener: RunsOnEngine = model_of_motion(settings, recorder, folder)
    control = [np.zeros((sum(listener.control_frames), len(COLUMNS)), np.float32)] if settings.events else [None]
    silence = SpeakerFrame(FRAME_S, np.zeros(FRAME_SAMPLES, np.float32))
    memories = [listener.start(seed) for seed in range(EXAMPLE_STREAMS)]
    listener.step_each([silence] * EXAMPLE_STREAMS, memories, control * EXAMPLE_STREAMS)
    graphs: dict[str, Any] = {}
    for name, network in networks_of(model).items():
        with torch.no_grad():
            graphs[name] = _graph(network.eval(), recorder.examples[name], several=name != ONE_STREAM)
        if layers:
            graphs[f"{name}.int8"] = _with_integers(graphs[name], layers)
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


def _graph(network: nn.Module, example: Mapping[str, Tensor], several: bool) -> Any:
    """Return a simplified `onnx_ir.Model` whose weights are values without content (steps 1 to 3)."""
    with optional("sfms-robot export"):
        import onnxscript
    streams = torch.export.Dim("streams", min=1, max=MOST_STREAMS)
    free = torch.export.Dim("free", min=1, max=MOST_STREAMS)
    also = {name: {1: free} for name in getattr(network, "free", ())}
    dynamic = _like_arguments(network, [{0: streams} | also.get(name, {}) for name in example]) if several else None
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
    for value in held:  # step 3: as inputs, whose values cannot be folded into the graph
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


def _like_arguments(network: nn.Module, shapes: list[Any]) -> tuple[Any, ...]:
    """Return shapes in the form of the arguments of `forward`, where all of *parts are one argument."""
    code = network.forward.__code__
    named = code.co_argcount - 1
    rest = code.co_flags & 0x04  # CO_VARARGS
    return (*shapes[:named], tuple(shapes[named:])) if rest else tuple(shapes)


def _written(model: Any, state: Mapping[str, Tensor]) -> tuple[bytes, dict[str, Any]]:
    """Return the file of a graph (step 5) and its entry in the manifest."""
    import onnx
    import onnx_ir

    proto = onnx_ir.to_proto(model)
    graph = proto.graph
    # Nothing about the machine and the source files that made it.
    for part in (proto, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    graph.ClearField("value_info")
    proto.producer_name, proto.producer_version = "sfms-robot", ""
    weights, layers = [], []
    names: dict[str, str] = {}  # of initialisers, as they were and as they are written
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


def _with_integers(model: Any, layers: Iterable[str]) -> Any:
    """Return a copy whose `layers` multiply in 8 bits (step 4)."""
    import onnx_ir
    from onnx_ir.passes.common import RemoveUnusedNodesPass

    model = onnx_ir.from_proto(onnx_ir.to_proto(model))
    graph = model.graph
    for layer in layers:
        weight = graph.initializers.get(MODEL + layer)
        if weight is None:
            continue
        size = [int(each) for each in weight.shape]
        rounded = _placeholder(f"{MODEL}{layer}.int8", size[::-1], onnx_ir.DataType.INT8)
        scale = _placeholder(f"{MODEL}{layer}.scale", size[:1], onnx_ir.DataType.FLOAT)
        graph.initializers.update({rounded.name: rounded, scale.name: scale})
        for node, index in list(weight.uses()):
            if node.op_type == "Gemm" and index == 1:
                _replace(graph, node, node.inputs[0], rounded, scale, node.inputs[2] if len(node.inputs) > 2 else None)
            elif node.op_type == "Transpose":
                for product, _ in list(node.outputs[0].uses()):
                    last, bias = _biased(graph, product)
                    _replace(graph, last, product.inputs[0], rounded, scale, bias)
            else:
                raise ModelError(f"{layer}: used by {node.op_type}, which has no product in 8 bits")
    RemoveUnusedNodesPass()(model)
    for name in [name for name, value in graph.initializers.items() if not value.uses()]:
        del graph.initializers[name]
    model.opset_imports["com.microsoft"] = 1
    return model


def _placeholder(name: str, shape: list[int], kind: Any) -> Any:
    """Return an initialiser that gets its content when the graph is loaded."""
    import onnx_ir

    value = onnx_ir.Value(name=name, shape=onnx_ir.Shape(shape), type=onnx_ir.TensorType(kind))
    value.const_value = onnx_ir.ExternalTensor(WEIGHTS, None, None, kind, shape=onnx_ir.Shape(shape), name=name)
    return value


def _biased(graph: Any, product: Any) -> tuple[Any, Any]:
    """Return the node that adds a bias to a product, and the bias; the product and None where there is none."""
    uses = list(product.outputs[0].uses())
    if len(uses) == 1 and uses[0][0].op_type == "Add":
        node, index = uses[0]
        bias = node.inputs[1 - index]
        if bias.name in graph.initializers and len(bias.shape) == 1:
            return node, bias
    return product, None


def _replace(graph: Any, node: Any, x: Any, rounded: Any, scale: Any, bias: Any) -> None:
    """Put a product in 8 bits in the place of `node`, under the name of its output."""
    import onnx_ir

    inputs = [x, rounded, scale] if bias is None else [x, rounded, scale, None, bias]  # None: zero point of 0
    product = onnx_ir.Node("com.microsoft", "DynamicQuantizeMatMul", inputs)
    product.outputs[0].name = node.outputs[0].name
    graph.insert_before(node, product)
    for user, index in list(node.outputs[0].uses()):
        user.replace_input_with(index, product.outputs[0])
    for index, output in enumerate(graph.outputs):
        if output is node.outputs[0]:
            graph.outputs[index] = product.outputs[0]
    graph.remove(node, safe=True)
