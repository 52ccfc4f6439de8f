"""What computes a listener's networks: the seam between a stream, which is numpy, and the library that multiplies.

A stream asks networks by name: arrays in, arrays out, nothing kept. An engine holds their weights. There are two,
`torch_engine` and `onnx_engine`; the second one never imports torch, and starts in a fraction of the time and memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ModelError
from sfms_robot.frames import Floats

Array = NDArray[Any]
EngineName = Literal["auto", "torch", "onnx"]


class Engine(Protocol):
    """Networks of one listener, by name.

    Attributes:
        name: "torch" or "onnx", and what else tells how it computes: "onnx int8, 2 threads".
        tensors: the listener's tensors that are no weights of a network, by their name in model.safetensors: scales of
            its motion and sound, what streams draw from. Not to be changed.
    """

    @property
    def name(self) -> str: ...

    @property
    def tensors(self) -> Mapping[str, Array]: ...

    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """Outputs of a network, each (N, ...), N streams.

        `inputs` are (N, ...) in the network's order; one of (1, ...) is the same for all streams.
        """
        ...

    def build_graphs(self) -> None:
        """The weights stay as they are from now on: what a single stream asks is made as fast as it gets.

        Takes a second with torch, nothing with onnx.
        """

    def set_threads(self, threads: int) -> None:
        """Use so many from now on."""


class RunsOnEngine:
    """What listeners share whose networks an engine runs."""

    engine: Engine

    def standardise(self, motion: Floats) -> Floats:
        """Return motion (..., C) of the motion space in the units of the model."""
        tensors = self.engine.tensors
        return np.asarray((motion - tensors["motion_mean"]) / tensors["motion_std"], np.float32)

    @property
    def model(self) -> Any:
        """The torch model behind it. Raises ModelError where it runs on another engine."""
        try:
            return self.engine.model  # type: ignore[attr-defined]
        except AttributeError:
            name = self.engine.name
            raise ModelError(f"this listener runs on {name}: what looks into its model needs torch") from None

    def build_graphs(self) -> Self:
        """See `Engine`. Itself."""
        self.engine.build_graphs()
        return self


def stacked(parts: Sequence[Array]) -> Array:
    """Return (N, ...) of N arrays (...), not to be changed: a single one is not copied."""
    return parts[0][None] if len(parts) == 1 else np.stack(parts)


def one_of(array: Array, streams: int) -> Array:
    """An input (N or 1, ...) as an array of its own of (N, ...)."""
    if len(array) == streams:
        return array if array.flags.c_contiguous else np.ascontiguousarray(array)
    return np.ascontiguousarray(np.broadcast_to(array, (streams, *array.shape[1:])))
