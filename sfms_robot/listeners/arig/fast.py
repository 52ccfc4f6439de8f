"""The fast path: large layers in 8-bit integers, scaled anew for every input (dynamic quantization).

One frame at a time, a layer costs what it takes to read its weights; in bytes that is a quarter. Weights are rounded
per output row, the input by its own range. Small layers stay in 32 bits: they gain nothing. So does the sampler on
torch; in graphs, where a product is no more than what it reads, its blocks in integers stay in the fastest cache.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.errors import ModelError
from sfms_robot.listeners.arig.model import ArigModel

PARTS = ("sound_in", "merge_agent", "merge_user", "short", "long", "states", "progress")
SAMPLER = ("head.modulation.", "head.up.", "head.down.")  # of graphs: all that it multiplies in every step but its ends
SMALLEST = 64 * 1024  # weights of a layer below which integers gain nothing


class Int8Linear(nn.Module):
    """Stands in for an nn.Linear."""

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        weight = linear.weight.detach()
        scale = weight.abs().amax(1).clamp(min=1e-12).double() / 127
        with warnings.catch_warnings():  # torch will rename how such tensors are made; what multiplies them stays
            warnings.simplefilter("ignore", UserWarning)
            zero = torch.zeros(len(scale), dtype=torch.long)
            rounded = torch.quantize_per_channel(weight, scale, zero, 0, torch.qint8)
        self.packed: Any = torch.ops.quantized.linear_prepack(rounded, linear.bias)
        self.half_range = not torch.cpu._is_vnni_supported()  # older processors add pairs of products in 16 bits

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = torch.ops.quantized.linear_dynamic(x, self.packed, self.half_range)
        return out

    __call__ = forward  # as parts.Part


class Bf16Linear(nn.Module):
    """Stands in for an nn.Linear: half of what is read. For benches: integers are faster wherever there are any."""

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        self.weight = linear.weight.detach().bfloat16()
        self.bias = linear.bias.detach().bfloat16()

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x.bfloat16(), self.weight, self.bias).float()

    __call__ = forward  # as parts.Part


def supported() -> bool:
    """Whether this processor multiplies such integers fast."""
    return torch.backends.quantized.engine in ("x86", "fbgemm", "onednn")


def with_precision(model: ArigModel, precision: str) -> ArigModel:
    """The model to run: itself (fp32), or a copy with its large layers in integers (int8, or auto where supported).

    Raises ModelError for int8 where the processor has none.
    """
    if precision == "fp32" or (precision == "auto" and not supported()):
        return model
    if not supported():
        raise ModelError("precision = 'int8' needs an x86 processor (auto, fp32)")
    return with_layers(model, Int8Linear)


def with_layers(model: ArigModel, kind: Callable[[nn.Linear], nn.Module]) -> ArigModel:
    """A copy of the model whose large layers are of another kind; the sampler's stay."""
    out = copy.deepcopy(model)
    for name, part in out.named_children():
        if name in PARTS:
            _replace(part, kind)
    return out


def large_layers(model: ArigModel) -> list[str]:
    """Weights of the layers that graphs have in integers, by name: those of `with_precision` and the sampler's."""
    return [
        f"{name}.weight"
        for name, part in model.named_modules()
        if isinstance(part, nn.Linear)
        and (name.split(".")[0] in PARTS or name.startswith(SAMPLER))
        and part.weight.numel() >= SMALLEST
    ]


def _replace(module: nn.Module, kind: Callable[[nn.Linear], nn.Module]) -> None:
    for name, child in module.named_children():
        if isinstance(child, nn.Linear):
            if child.weight.numel() >= SMALLEST:
                setattr(module, name, kind(child))
        else:
            _replace(child, kind)
