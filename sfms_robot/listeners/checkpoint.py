"""A listener's folder: config.yaml and model.safetensors. Faults in them raise ConfigError or ModelError."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from safetensors import SafetensorError, deserialize, safe_open
from safetensors.numpy import save_file

from sfms_robot import config
from sfms_robot.errors import ModelError

if TYPE_CHECKING:
    from torch import nn

Array = NDArray[Any]
Shapes = Mapping[str, tuple[tuple[int, ...], bool]]  # shape of each tensor by name; True if it holds real numbers
Bits = Literal[8, 16, 32]
CONFIG = "config.yaml"
WEIGHTS = "model.safetensors"
BFLOAT16, INT8 = "BF16", "I8"
PIECE_BYTES = 16 * 2**20
ROW_SCALE: Final = ".row_scale"  # suffix to the name of a matrix in 8 bits: the tensor of its factors
LARGE: Final = 4096  # numbers; a smaller matrix is not worth 8 bits
LARGEST = 1e6  # limit of every value: an unmeasured speed is stored as 1e6, weights are below 200, and 1e30 overflows


def load_config(folder: Path) -> config.ListenerSettings:
    """Read `folder`/config.yaml. Raises ConfigError."""
    return config.load_listener(folder / CONFIG)


def save_config(folder: Path, settings: config.ListenerSettings) -> None:
    """Write `folder`/config.yaml. Raises ModelError if it cannot be written."""
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, width=110, default_flow_style=None)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CONFIG).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ModelError(f"{folder / CONFIG}: cannot be written: {error.strerror}") from error


def save_weights(file: Path, module: nn.Module, bits: Bits = 32) -> None:
    """Write the state of `module`, see `write_tensors`."""
    write_tensors(file, {name: value.cpu().numpy() for name, value in module.state_dict().items()}, bits)


def write_tensors(file: Path, tensors: Mapping[str, Array], bits: Bits = 32) -> None:
    """Write tensors and replace `file` in one step, so that an interrupted run leaves the old file.

    `bits`: 16 halves the size. 8 quarters the size of matrices with `LARGE` numbers or more: they become integers from
    -127 to 127 with one factor per row (NAME.row_scale), and no number is off by more than 1/254 of the largest in its
    row. All other tensors are then stored in 16 bits where that loses nothing. Loading always returns 32 bits.

    Raises ModelError if the file cannot be written; no part of it stays.
    """
    part = file.with_suffix(".part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: np.asarray(value, order="C") for name, value in _packed(tensors, bits)}, part)
        part.chmod(0o644)  # safetensors creates files that only their owner can read
        part.replace(file)
    except (OSError, SafetensorError) as error:
        if part.is_file():
            part.unlink()
        raise ModelError(f"{file}: cannot be written: {error}") from error


def _packed(tensors: Mapping[str, Array], bits: Bits) -> Iterator[tuple[str, Array]]:
    for name, value in tensors.items():
        if value.dtype.kind != "f":
            yield name, value
        elif bits == 8 and value.ndim > 1 and value.size >= LARGE:
            rows = value.reshape(len(value), -1).astype(np.float32)
            scale = np.maximum(np.abs(rows).max(1), np.finfo(np.float32).tiny * 127) / np.float32(127)
            yield name, np.rint(rows / scale[:, None]).astype(np.int8).reshape(value.shape)
            yield name + ROW_SCALE, scale
        else:
            with np.errstate(over="ignore"):
                short = value.astype(np.float16)
            fits = np.isfinite(short).all() if bits == 16 else bits == 8 and np.array_equal(short, value)
            yield name, short if fits else value


def load_weights(file: Path, module: nn.Module) -> None:
    """Fill `module` from a safetensors file. Runs no code of the file. Raises ModelError as `stored_tensors`."""
    import torch

    wanted = {name: (tuple(value.shape), value.is_floating_point()) for name, value in module.state_dict().items()}
    module.load_state_dict({name: torch.from_numpy(value) for name, value in stored_tensors(file, wanted)})


def read_weights(file: Path) -> dict[str, Array]:
    """Return all `stored_tensors` of a file, by name."""
    return dict(stored_tensors(file))


def stored_tensors(file: Path, wanted: Shapes | None = None) -> Iterator[tuple[str, Array]]:
    """Yield names and tensors of a safetensors file, real numbers in 32 bits. Runs no code of the file.

    Tensors are read one after another: a caller that keeps none needs little more memory than the largest one.
    `wanted`: tensors that the file must contain, and no others; None accepts any.

    Raises ModelError if the file or a tensor is missing, cut off, of another shape or type, not finite, or has values
    that no trained model has. For wrong names it is raised before the first tensor is read.
    """
    if not file.is_file():
        raise ModelError(f"{file}: no such weights file")
    try:
        with safe_open(file, "np") as stored:
            kinds = {name: stored.get_slice(name).get_dtype() for name in stored.keys()}  # noqa: SIM118, no mapping
        scales = {name + ROW_SCALE for name, kind in kinds.items() if kind == INT8} & kinds.keys()
        for name in wanted or ():
            if name not in kinds:
                raise ModelError(f"{file}: tensor {name} is missing; the weights belong to another configuration")
        for name in kinds:
            if wanted is not None and name not in wanted and name not in scales:
                raise ModelError(f"{file}: tensor {name} is not part of the configured model")
        for name, value in _read(file, kinds, scales):
            plain = value.astype(np.float32) if value.dtype.kind == "f" else value
            _check(f"{file}: tensor {name}", plain, None if wanted is None else wanted[name])
            yield name, plain
    except (SafetensorError, OSError, TypeError) as error:
        raise ModelError(f"{file}: not a readable safetensors file: {error}") from error


def _check(tensor: str, value: Array, wanted: tuple[tuple[int, ...], bool] | None) -> None:
    """Raise ModelError for a wrong shape or type and for impossible values; its text begins with `tensor`."""
    shape, real = wanted or (value.shape, value.dtype.kind == "f")
    if value.shape != shape:
        raise ModelError(f"{tensor} has shape {value.shape}, the configuration needs {shape}")
    if (value.dtype.kind == "f") != real:
        raise ModelError(f"{tensor} is of {value.dtype}, the model needs {'float32' if real else 'int64'}")
    if not real or not value.size:
        return
    largest = float(max(value.max(), -value.min()))  # NaN if any value is NaN
    if not math.isfinite(largest):
        raise ModelError(f"{tensor} holds values that are not finite")
    if largest > LARGEST:
        raise ModelError(f"{tensor} holds {largest:g}, no trained model is above {LARGEST:g}")


def _read(file: Path, kinds: Mapping[str, str], scales: Set[str]) -> Iterator[tuple[str, Array]]:
    """Yield tensors, those in 8 bits multiplied by their factors.

    The file is reopened every `PIECE_BYTES`, because pages that were read stay in memory while it is mapped.
    """
    names = [name for name, kind in kinds.items() if kind != BFLOAT16 and name not in scales]
    while names:
        with safe_open(file, "np") as stored:
            left = PIECE_BYTES
            while names and left > 0:
                value = stored.get_tensor(name := names.pop(0))
                left -= value.nbytes
                if name + ROW_SCALE in scales:
                    value = _scaled(f"{file}: tensor {name}", value, stored.get_tensor(name + ROW_SCALE))
                yield name, value
    if BFLOAT16 in kinds.values():  # numpy lacks this type: such a number is the upper half of a 32-bit number
        for name, raw in deserialize(file.read_bytes()):  # type: ignore[no-untyped-call]
            if raw["dtype"] == BFLOAT16:
                upper = np.frombuffer(raw["data"], np.uint16).astype(np.uint32) << 16
                yield name, upper.view(np.float32).reshape(raw["shape"])


def _scaled(tensor: str, value: Array, scale: Array) -> Array:
    """Return a matrix in 8 bits as real numbers."""
    if scale.shape != value.shape[:1] or scale.dtype.kind != "f":
        raise ModelError(f"{tensor}{ROW_SCALE} is not {value.shape[:1]} real numbers, one per row")
    with np.errstate(over="ignore", invalid="ignore"):  # `_check` reports values that are not finite
        scaled: Array = value * scale.astype(np.float32).reshape(-1, *[1] * (value.ndim - 1))
    return scaled
