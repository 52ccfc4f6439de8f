"""Frames of a corpus on disk: one file per field, written once, read when they are drawn.

The processes of a machine share the system's file cache; the first process writes. A folder with frames of an earlier
run is written again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from sfms_robot.errors import ConfigError
from sfms_robot.lab.learning.process_group import ProcessGroup

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_INDEX = "index.json"


@dataclass(frozen=True)
class Scratch:
    """Folder of staged frames, and the process that writes it."""

    folder: Path
    group: ProcessGroup

    def __truediv__(self, name: str) -> Scratch:
        return Scratch(self.folder / name, self.group)


class StagedFrames:
    """Frames that are added dyad by dyad and then read as tensors that lie in files. Raises ConfigError."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows = 0
        self._shapes: dict[str, tuple[str, list[int]]] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for left in [*folder.glob("*.frames"), folder / _INDEX]:
                left.unlink(missing_ok=True)
        except OSError as error:
            raise _unwritten(folder, error) from error

    def add(self, frames: DataclassInstance) -> None:
        """Tensors (N, ...) of one dyad."""
        for field in fields(frames):
            tensor: Tensor = getattr(frames, field.name)
            array = tensor.contiguous().numpy()
            self._shapes[field.name] = (str(array.dtype), list(array.shape[1:]))
            file = self._folder / f"{field.name}.frames"
            try:
                with file.open("ab") as opened:
                    opened.write(array.tobytes())
            except OSError as error:
                raise _unwritten(file, error) from error
        self._rows += len(tensor)

    def close(self, lengths: Sequence[int], scenes: Sequence[str]) -> None:
        """Write what the others need to read them."""
        told = {"rows": self._rows, "shapes": self._shapes, "lengths": list(lengths), "scenes": list(scenes)}
        try:
            (self._folder / _INDEX).write_text(json.dumps(told), encoding="utf-8")
        except OSError as error:
            raise _unwritten(self._folder, error) from error


def read_staged(folder: Path) -> tuple[dict[str, Tensor], tuple[int, ...], tuple[str, ...]]:
    """Tensors by field, lengths and scenes. Raises ConfigError."""
    try:
        told: dict[str, Any] = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{folder}: the first process of this machine has staged no frames ({error})") from error
    found = {name: _mapped(folder / f"{name}.frames", told["rows"], *of) for name, of in told["shapes"].items()}
    return found, tuple(told["lengths"]), tuple(told["scenes"])


def _mapped(file: Path, rows: int, dtype: str, shape: list[int]) -> Tensor:
    kind = torch.from_numpy(np.zeros(0, dtype)).dtype
    count = rows * math.prod(shape)
    if not count:
        return torch.zeros(rows, *shape, dtype=kind)
    return torch.from_file(str(file), shared=False, size=count, dtype=kind).view(rows, *shape)


def _unwritten(file: Path, error: OSError) -> ConfigError:
    return ConfigError(f"--scratch: {file} cannot be written: {error.strerror or error}")
