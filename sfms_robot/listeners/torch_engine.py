"""Networks computed by torch: as modules, or as graphs, which for a single stream of a small model take a fifth less.

Imports torch. A graph is made by torch.jit, which is on its way out; what takes its place wants a C++ compiler on the
machine that runs, and where speed counts there is `onnx_engine`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any, Final

import torch
from torch import Tensor, nn

from sfms_robot.listeners.engine import Array

WARM_UPS: Final = 3  # a graph is put together in its first two runs


class TorchEngine:
    """`engine.Engine`.

    Args:
        model: whose state `tensors` shows, as it is at any time.
        networks: by name; modules of tensors alone.
        examples: of their inputs, for one stream; what can become a graph.
    """

    def __init__(
        self,
        model: nn.Module,
        networks: Mapping[str, nn.Module],
        examples: Mapping[str, Mapping[str, Tensor]],
    ) -> None:
        self.model = model.eval()
        self.tensors = {name: value.detach().numpy() for name, value in model.state_dict().items() if _plain(value)}
        self._networks, self._examples = networks, examples
        self._graphs: dict[str, Callable[..., Any]] = {}

    @property
    def name(self) -> str:
        return "torch"

    def build_graphs(self) -> None:
        """The weights stay as they are from now on: what a single stream asks becomes graphs."""
        for name, example in self._examples.items():
            self._graphs[name] = graph(self._networks[name], tuple(example.values()))

    @torch.inference_mode()
    def run(self, network: str, *inputs: Array) -> tuple[Array, ...]:
        """See `engine.Engine`."""
        told = [torch.from_numpy(each if each.flags.writeable else each.copy()) for each in inputs]
        streams = max(map(len, told))
        module = self._graphs.get(network) if streams == 1 else None
        outputs = (self._networks[network] if module is None else module)(*told)
        return tuple(output.numpy() for output in outputs)

    def set_threads(self, threads: int) -> None:
        """Of the whole process: torch knows no other."""
        torch.set_num_threads(threads)


def _plain(value: Tensor) -> bool:
    return isinstance(value, Tensor) and not value.is_quantized


@torch.inference_mode()
def graph(part: nn.Module, example: tuple[Tensor, ...]) -> Callable[..., Any]:
    """`part`, a module of tensors alone whose weights stay as they are, as one graph for inputs such as `example`.

    Sizes that the module turns into Python numbers stay those of the example.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traced = torch.jit.trace(part.eval(), example, check_trace=False)  # type: ignore[no-untyped-call]
        made: Callable[..., Any] = torch.jit.freeze(traced)
    for _ in range(WARM_UPS):
        made(*example)
    return made
