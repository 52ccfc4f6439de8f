"""A listener's networks as ONNX graphs without weights, beside its model.safetensors; `onnx_engine` runs them.

torch.export traces a network for any number of streams, torch.onnx writes it down, onnxscript simplifies it. Weights
keep the names that they have in model.safetensors and nothing of their values goes into a graph: so graphs are small,
and whatever is trained for the same configuration runs on them. Needs torch and the extra `export`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.errors import ModelError, optional
from sfms_robot.listeners.graph_folder import FOLDER, FORMAT, MANIFEST, digest

MODEL: Final = "model."  # before the name of a weight, in every network
MOST_STREAMS: Final = 4096
EXAMPLE_STREAMS: Final = 3
ASKED_ONCE: Final = "rest"  # of one stream, when a listener is loaded


def export(
    folder: Path,
    settings: config.Listener,
    model: nn.Module,
    networks: Mapping[str, nn.Module],
    examples: Mapping[str, Mapping[str, Tensor]],
    integers: Mapping[str, Iterable[str]],
) -> list[Path]:
    """Write the graphs of a listener into its folder; the files written. Takes half a minute to two.

    Args:
        model: of the networks, which have it as their attribute `model`.
        examples: inputs of every network, of several streams.
        integers: layers of a network, by name of their weight, that become a second graph of it in 8 bits.

    Raises MissingExtra, and ModelError where the folder cannot be written.
    """
    graphs: dict[str, Any] = {}
    for name, network in networks.items():
        with torch.no_grad():
            network(*examples[name].values())  # what is worked out once and kept must not be traced
            graphs[name] = _graph(network.eval(), examples[name], several=name != ASKED_ONCE)
        if wanted := list(integers.get(name, ())):
            graphs[f"{name}.int8"] = _with_integers(graphs[name], wanted)
    state = model.state_dict()
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "settings": digest(settings),
        "tensors": {name: (list(value.shape), value.is_floating_point()) for name, value in state.items()},
        "networks": {},
    }
    files = []
    try:
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        for name, graph in graphs.items():
            data, known = _written(graph, state)
            manifest["networks"][name] = known
            files.append(folder / FOLDER / f"{name}.onnx")
            files[-1].write_bytes(data)
        files.append(folder / FOLDER / MANIFEST)
        files[-1].write_text(json.dumps(manifest, indent=0) + "\n", encoding="utf-8")
    except OSError as error:
        raise ModelError(f"{folder / FOLDER}: cannot be written: {error.strerror}") from error
    return files


def _graph(network: nn.Module, example: Mapping[str, Tensor], several: bool) -> Any:
    """An `onnx_ir.Model` whose weights are values without content; simplified, without a word of where it is from."""
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
    for value in held:  # as inputs, whose values nobody can fold into the graph
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
    """Shapes of the arguments of `forward`: what it takes as *parts is one argument."""
    code = network.forward.__code__
    named = code.co_argcount - 1
    rest = code.co_flags & 0x04  # CO_VARARGS
    return (*shapes[:named], tuple(shapes[named:])) if rest else tuple(shapes)


def _written(model: Any, state: Mapping[str, Tensor]) -> tuple[bytes, dict[str, Any]]:
    """The file of a graph, and what the manifest says of it."""
    import onnx
    import onnx_ir

    proto = onnx_ir.to_proto(model)
    graph = proto.graph
    for part in (proto, graph, *graph.node, *graph.input, *graph.output, *graph.value_info):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    graph.ClearField("value_info")
    proto.producer_name, proto.producer_version = "sfms-robot", ""
    weights, layers = [], []
    for tensor in graph.initializer:
        tensor.ClearField("metadata_props")
        tensor.ClearField("doc_string")
        name = tensor.name.removeprefix(MODEL)
        if name.removesuffix(".int8") in state and name.endswith(".int8"):
            layers.append(name.removesuffix(".int8"))
        elif name in state and tensor.name.startswith(MODEL):
            weights.append(name)
        elif not (name.endswith(".scale") and name.removesuffix(".scale") in state):
            continue
        _rename(graph, tensor.name, name)
        shape, kind = list(tensor.dims), tensor.data_type
        tensor.CopyFrom(onnx.TensorProto(name=name, dims=shape, data_type=kind))
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="model.safetensors")
    data = proto.SerializeToString(deterministic=True)
    known = {
        "sha256": hashlib.sha256(data).hexdigest(),
        "weights": sorted(weights + layers),
        "integers": sorted(layers),
    }
    return data, known


def _rename(graph: Any, old: str, new: str) -> None:
    for node in graph.node:
        for index, name in enumerate(node.input):
            if name == old:
                node.input[index] = new


def _with_integers(model: Any, layers: Iterable[str]) -> Any:
    """A copy whose `layers` multiply in 8 bits: onnxruntime's DynamicQuantizeMatMul in place of the product."""
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
    """An initialiser whose content comes when the graph is loaded."""
    import onnx_ir

    value = onnx_ir.Value(name=name, shape=onnx_ir.Shape(shape), type=onnx_ir.TensorType(kind))
    value.const_value = onnx_ir.ExternalTensor(
        "model.safetensors", None, None, kind, shape=onnx_ir.Shape(shape), name=name
    )
    return value


def _biased(graph: Any, product: Any) -> tuple[Any, Any]:
    """The last node of a product with what is added to it, and its bias; itself and None without."""
    uses = list(product.outputs[0].uses())
    if len(uses) == 1 and uses[0][0].op_type == "Add":
        node, index = uses[0]
        bias = node.inputs[1 - index]
        if bias.name in graph.initializers and len(bias.shape) == 1:
            return node, bias
    return product, None


def _replace(graph: Any, node: Any, x: Any, rounded: Any, scale: Any, bias: Any) -> None:
    import onnx_ir

    product = onnx_ir.Node(
        "com.microsoft",
        "DynamicQuantizeMatMul",
        [x, rounded, scale, None, bias] if bias is not None else [x, rounded, scale],
    )
    product.outputs[0].name = node.outputs[0].name
    graph.insert_before(node, product)
    for user, index in list(node.outputs[0].uses()):
        user.replace_input_with(index, product.outputs[0])
    for index, output in enumerate(graph.outputs):
        if output is node.outputs[0]:
            graph.outputs[index] = product.outputs[0]
    graph.remove(node, safe=True)
