"""Export of a listener: graphs of its networks for onnxruntime, weights in few bits."""

from __future__ import annotations

from pathlib import Path
from typing import cast, get_args

from sfms_robot.app.output_paths import made_folder
from sfms_robot.data import find
from sfms_robot.errors import ConfigError, optional
from sfms_robot.listeners.checkpoint import WEIGHTS, Bits, read_weights, write_tensors


def export_listener(name: str, out: Path | None, int8: bool, weight_bits: int | None = None) -> list[Path]:
    """Write the graphs of a listener, by shipped name or folder, below its folder or `out`, and return the files.

    `int8`: also graphs with large layers in 8 bits. `weight_bits`: also the weights, stored in 8, 16 or 32 bits (see
    `checkpoint.write_tensors`). Takes a minute. Raises ConfigError, MissingExtra, ModelError.
    """
    if weight_bits not in (None, *get_args(Bits)):
        raise ConfigError(f"--weight-bits {weight_bits}: must be 8, 16 or 32")
    folder = find("listeners", name, "config.yaml")
    target = folder if out is None else made_folder(out, "--out")
    weights = None if weight_bits is None else read_weights(folder / WEIGHTS)
    with optional("sfms-robot export"):
        from sfms_robot.listeners.torch_engine import export
    files = export(folder, target, int8)
    if weights is not None:
        write_tensors(target / WEIGHTS, weights, cast("Bits", weight_bits))
        files = [*files, target / WEIGHTS]
    return files
