"""Graphs of a listener's networks, as `export` leaves them in its folder: onnx/NAME.onnx, without weights.

`graphs.json` beside them says what each wants, and of which configuration they are. So what does not fit is said before
anything runs, in one line: a graph cut short, one of another model, weights of other shapes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sfms_robot import config
from sfms_robot.errors import ModelError

FOLDER: Final = "onnx"
MANIFEST: Final = "graphs.json"
FORMAT: Final = 1
# What a stream does with what networks say, or how they were trained: of that graphs know nothing.
OUTSIDE: Final = (
    "description", "hop", "sampling", "precision", "neutral", "metres_per_unit", "flame_matrix", "wav2vec2", "scores",
    "placement", "max_gap_frames",
)  # fmt: skip
OUTSIDE_GROUPS: Final = ("keyframes", "keyframe_cost", "transition_bias")


@dataclass(frozen=True)
class Graph:
    """One network.

    Attributes:
        data: the ONNX file.
        weights: tensors of model.safetensors that it wants, by name there.
        integers: those of them that it wants in 8 bits (`onnx_engine.integers`).
    """

    data: bytes
    weights: tuple[str, ...]
    integers: tuple[str, ...] = ()


@dataclass(frozen=True)
class GraphFolder:
    """All graphs of a listener, by the network's name, and shape of every tensor of model.safetensors."""

    graphs: Mapping[str, Graph]
    shapes: Mapping[str, tuple[int, ...]]
    real: frozenset[str]

    @property
    def wanted(self) -> dict[str, tuple[tuple[int, ...], bool]]:
        """For `checkpoint.read_weights`."""
        return {name: (shape, name in self.real) for name, shape in self.shapes.items()}


def digest(settings: config.Listener) -> str:
    """Of all that a listener's graphs depend on."""
    known = settings.model_dump(mode="json", exclude=set(OUTSIDE))
    for group in known.get("groups", {}).values():
        for key in OUTSIDE_GROUPS:
            group.pop(key)
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()[:16]


def has_graphs(folder: Path) -> bool:
    """Whether a listener's folder has any, good or bad."""
    return (folder / FOLDER / MANIFEST).is_file()


def read_graphs(folder: Path, settings: config.Listener, integers: bool = False) -> GraphFolder:
    """Those of a listener's folder; with `integers` the networks that have one in 8 bits are that.

    Raises ModelError when a file is missing, cut short, changed, or of another configuration.
    """
    file, remedy = folder / FOLDER / MANIFEST, f"make them anew: sfms-robot export {folder}"
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
        version, of, networks = manifest["format"], manifest["settings"], manifest["networks"]
        shapes = {name: tuple(shape) for name, (shape, _) in manifest["tensors"].items()}
        real = frozenset(name for name, (_, real) in manifest["tensors"].items() if real)
    except OSError:
        raise ModelError(f"{file}: no graphs of this listener for engine onnx; {remedy}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ModelError(f"{file}: not a list of graphs; {remedy}") from None
    if version != FORMAT:
        raise ModelError(f"{file}: graphs of format {version}, this version has {FORMAT}; {remedy}")
    if of != digest(settings):
        raise ModelError(f"{file}: graphs of another configuration than {folder / 'config.yaml'}; {remedy}")
    found = {}
    for name in {network.removesuffix(".int8") for network in networks}:
        chosen = f"{name}.int8" if integers and f"{name}.int8" in networks else name
        found[name] = _graph(folder / FOLDER / f"{chosen}.onnx", networks[chosen], remedy)
    return GraphFolder(found, shapes, real)


def _graph(file: Path, known: Mapping[str, Any], remedy: str) -> Graph:
    try:
        data = file.read_bytes()
    except OSError:
        raise ModelError(f"{file}: no such graph; {remedy}") from None
    if hashlib.sha256(data).hexdigest() != known["sha256"]:
        raise ModelError(f"{file}: cut short, or of another model than {MANIFEST} beside it; {remedy}")
    return Graph(data, tuple(known["weights"]), tuple(known.get("integers", ())))
