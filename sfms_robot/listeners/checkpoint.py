"""A listener's folder: config.yaml, model.safetensors. Everything that can be wrong with it is one ModelError."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import yaml
from safetensors import SafetensorError, deserialize, safe_open
from safetensors.numpy import save_file

from sfms_robot import config
from sfms_robot.errors import ModelError
from sfms_robot.listeners.engine import Array

if TYPE_CHECKING:
    from torch import nn

Bits = Literal[8, 16, 32]
CONFIG = "config.yaml"
WEIGHTS = "model.safetensors"
BFLOAT16, INT8 = "BF16", "I8"
PIECE_BYTES = 16 * 2**20
ROW_SCALE: Final = ".row_scale"  # behind the name of a matrix in 8 bits
LARGE: Final = 4096  # numbers of a matrix: less than that is not worth 8 bits
LARGEST = 1e6  # of a tensor; a speed nobody measured is stored as this, weights are below 200, and 1e30 overflows


def save_config(folder: Path, settings: config.Listener) -> None:
    """Write `folder`/config.yaml. Raises ModelError where it cannot be written."""
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, width=110, default_flow_style=None)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CONFIG).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ModelError(f"{folder / CONFIG}: cannot be written: {error.strerror}") from error


def save_weights(file: Path, module: nn.Module, bits: Bits = 32) -> None:
    """`write_tensors` of the state of `module`."""
    write_tensors(file, {name: value.cpu().numpy() for name, value in module.state_dict().items()}, bits)


def write_tensors(file: Path, tensors: Mapping[str, Array], bits: Bits = 32) -> None:
    """Write them, replacing `file` in one move so that an interrupted run leaves the old one.

    `bits`: 16 takes half the room of 32. 8 takes a quarter, for matrices of `LARGE` numbers and more: whole numbers of
    -127 to 127, and beside them NAME.row_scale, one real number a row to multiply them by, so that none is off by more
    than a 254th of the largest of its row; all else in 16 where that loses nothing. What loads them computes in 32.

    Raises ModelError where it cannot be written, and leaves no part of it.
    """
    part = file.with_suffix(".part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: np.asarray(value, order="C") for name, value in _packed(tensors, bits)}, part)
        part.chmod(0o644)  # safetensors leaves it readable by its owner alone
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
    """Fill `module` from a safetensors file: plain numbers, no code is run. Raises ModelError as `read_weights`."""
    import torch

    wanted = module.state_dict()
    shapes = {name: (tuple(value.shape), value.is_floating_point()) for name, value in wanted.items()}
    found = read_weights(file, shapes)
    module.load_state_dict({name: torch.from_numpy(value) for name, value in found.items()})


def read_weights(file: Path, wanted: Mapping[str, tuple[tuple[int, ...], bool]] | None = None) -> dict[str, Array]:
    """All `stored_tensors` of a file, by name."""
    return dict(stored_tensors(file, wanted))


def stored_tensors(
    file: Path, wanted: Mapping[str, tuple[tuple[int, ...], bool]] | None = None
) -> Iterator[tuple[str, Array]]:
    """Names and tensors of a safetensors file, one after another, real numbers in 32 bits: plain numbers, no code is
    run. Whoever keeps none of them needs little more memory than the largest takes.

    `wanted`: shape of every tensor, and whether it is of real numbers; None: whatever there is.

    Raises ModelError when the file or a tensor is missing, cut off, of another shape or type, not finite, or of values
    that no trained model has; where names are wrong, before the first tensor.
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
            _check(file, name, value, None if wanted is None else wanted[name])
            yield name, value
    except (SafetensorError, OSError, TypeError) as error:
        raise ModelError(f"{file}: not a readable safetensors file: {error}") from error


def _check(file: Path, name: str, value: Array, wanted: tuple[tuple[int, ...], bool] | None) -> None:
    if wanted is not None:
        shape, real = wanted
        if value.shape != shape:
            raise ModelError(f"{file}: tensor {name} has shape {value.shape}, the configuration needs {shape}")
        if (value.dtype.kind == "f") != real:
            needs = "float32" if real else "int64"
            raise ModelError(f"{file}: tensor {name} is of {value.dtype}, the model needs {needs}")
    if value.dtype.kind != "f" or not value.size:
        return
    largest = float(max(value.max(), -value.min()))  # NaN where there is any
    if not math.isfinite(largest):
        raise ModelError(f"{file}: tensor {name} holds values that are not finite")
    if largest > LARGEST:
        raise ModelError(f"{file}: tensor {name} holds {largest:g}, no trained model is above {LARGEST:g}")


def _read(file: Path, kinds: Mapping[str, str], scales: Set[str]) -> Iterator[tuple[str, Array]]:
    """Tensors, opening the file anew every `PIECE_BYTES`: it is mapped, and what was read stays resident until then."""
    names = [name for name, kind in kinds.items() if kind != BFLOAT16 and name not in scales]
    while names:
        with safe_open(file, "np") as stored:
            left = PIECE_BYTES
            while names and left > 0:
                value = stored.get_tensor(name := names.pop(0))
                left -= value.nbytes
                if name + ROW_SCALE in scales:
                    value = _scaled(file, name, value, stored.get_tensor(name + ROW_SCALE))
                yield name, _plain(value)
    if BFLOAT16 in kinds.values():
        yield from _read_bfloat16(file)


def _read_bfloat16(file: Path) -> Iterator[tuple[str, Array]]:
    """Tensors of a kind that numpy does not know: the upper half of a 32-bit number."""
    for name, stored in deserialize(file.read_bytes()):  # type: ignore[no-untyped-call]
        if stored["dtype"] == BFLOAT16:
            upper = np.frombuffer(stored["data"], np.uint16).astype(np.uint32) << 16
            yield name, upper.view(np.float32).reshape(stored["shape"])


def _scaled(file: Path, name: str, value: Array, scale: Array) -> Array:
    """A matrix in 8 bits as real numbers."""
    if scale.shape != value.shape[:1] or scale.dtype.kind != "f":
        raise ModelError(f"{file}: tensor {name}{ROW_SCALE} is not {value.shape[:1]} real numbers, one a row of {name}")
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is told as such
        scaled: Array = value * scale.astype(np.float32).reshape(-1, *[1] * (value.ndim - 1))
    return scaled


def _plain(value: Array) -> Array:
    return value.astype(np.float32) if value.dtype.kind == "f" else value


def load_config(folder: Path) -> config.Listener:
    """Read `folder`/config.yaml. Raises ConfigError."""
    return config.load_listener(folder / CONFIG)
