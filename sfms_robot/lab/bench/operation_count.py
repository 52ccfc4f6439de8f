"""The cost of torch code, counted as it runs, independent of the machine.

An operation is one multiplication or addition of a matrix product, a convolution or an attention (torch's formulas), or
one number produced by any other call. Bytes are those of all tensors that each call reads and writes, as if there were
no caches: the memory traffic for large tensors, an upper bound for small ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

_DRAWING = ("rand", "normal", "uniform", "exponential", "bernoulli", "multinomial")


class OperationCount(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """A context manager that counts the calls inside it.

    Attributes:
        matrix, other: Operations of products, and numbers produced by other calls.
        bytes, calls: Bytes moved and calls made, views of tensors excluded.
        drawn: Random numbers.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._products = FlopCounterMode(display=False)
        aten, self._known = torch.ops.aten, self._products.flop_registry
        self._known |= {  # torch has formulas of attention only for the kernels of other devices
            aten._scaled_dot_product_flash_attention_for_cpu: self._known[aten._scaled_dot_product_flash_attention],
            aten._scaled_dot_product_flash_attention_for_cpu_backward: self._known[
                aten._scaled_dot_product_flash_attention_backward
            ],
        }
        self.other = self.bytes = self.calls = self.drawn = 0

    @property
    def matrix(self) -> int:
        return self._products.get_total_flops()

    @property
    def operations(self) -> int:
        return self.matrix + self.other

    def __enter__(self) -> OperationCount:
        self._products.__enter__()  # type: ignore[no-untyped-call]
        super().__enter__()  # type: ignore[no-untyped-call]
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        super().__exit__(kind, value, at)  # type: ignore[no-untyped-call]
        self._products.__exit__(kind, value, at)  # type: ignore[no-untyped-call]

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        if func.is_view:
            return out
        made = [each for each in tree_leaves(out) if isinstance(each, Tensor)]
        used = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        self.calls += 1
        self.bytes += sum(each.numel() * each.element_size() for each in [*made, *used])
        if func._overloadpacket not in self._known:
            self.other += sum(each.numel() for each in made)
        if func._overloadpacket.__name__.startswith(_DRAWING):
            self.drawn += sum(each.numel() for each in made)
        return out
