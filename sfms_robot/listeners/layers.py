"""Transformer parts shared by the listeners: pre-norm blocks, written out so that a step is the same everywhere.

Shapes: B batch, T frames of the query, S frames of the memory, D width.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # what is kept has to serve training as well
def sinusoidal(length: int, width: int) -> Tensor:
    """Sinusoidal positions (length, width) of Vaswani et al. 2017, not to be changed; `width` is even."""
    position = torch.arange(length, dtype=torch.float32)[:, None]
    rate = torch.exp(torch.arange(0, width, 2, dtype=torch.float32) * (-math.log(10_000.0) / width))
    return torch.cat([torch.sin(position * rate), torch.cos(position * rate)], dim=-1)


def exported_attention(q: Tensor, k: Tensor, v: Tensor, heads: int, seen: Tensor | None = None) -> Tensor:
    """Full attention of q (B, T, D) over k, v (B, S, D) as the one operator that onnxruntime has for it, (B, T, D).

    For graphs alone: in place of a dozen, which for a few frames cost more than what they compute. `seen` (B, S).
    """
    mask = None if seen is None else seen.to(torch.int32)
    out: Tensor = torch.onnx.ops.symbolic(
        "com.microsoft::MultiHeadAttention", (q, k, v, None, mask), {"num_heads": heads}, dtype=q.dtype, shape=q.shape,
        version=1,
    )  # fmt: skip
    return out


def exported_self_attention(x: Tensor, weight: Tensor, bias: Tensor, heads: int, seen: Tensor | None = None) -> Tensor:
    """`exported_attention` of x (B, T, D) over itself with the product that makes queries, keys and values of it:
    weight (3D, D), bias (3D,), in this order.
    """
    mask = None if seen is None else seen.to(torch.int32)
    out: Tensor = torch.onnx.ops.symbolic(
        "com.microsoft::Attention", (x, weight.T, bias, mask), {"num_heads": heads}, dtype=x.dtype, shape=x.shape,
        version=1,
    )  # fmt: skip
    return out


def exported_norm(x: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """LayerNorm of x (..., D), then `scale` and `shift`, which broadcast to x, as one operator: for graphs alone."""
    out: Tensor = torch.onnx.ops.symbolic(
        "LayerNormalization", (x, scale, shift), {"axis": -1, "epsilon": 1e-5}, dtype=x.dtype, shape=x.shape, version=17
    )
    return out


class Attention(nn.Module):
    """Multi-head attention of `x` (B, T, D) over `memory` (B, S, D)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor, memory: Tensor, seen: Tensor | None = None) -> Tensor:
        """`seen` (B, S): True where the memory may be looked at; at least one per row."""
        if torch.compiler.is_exporting():
            return self._exported(x, memory, seen)
        (b, t, d), s = x.shape, memory.shape[1]
        q = self.query(x).view(b, t, self.heads, -1).transpose(1, 2)  # (B, h, T, D/h)
        k, v = self.key_value(memory).view(b, s, 2, self.heads, -1).permute(2, 0, 3, 1, 4)  # (B, h, S, D/h)
        mask = None if seen is None else seen[:, None, None, :]
        y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        out: Tensor = self.out(y.transpose(1, 2).reshape(b, t, d))
        return out

    def _exported(self, x: Tensor, memory: Tensor, seen: Tensor | None) -> Tensor:
        """`forward` in as few operators as there are; what hangs on weights alone is worked out with the graph."""
        own, other = self.query, self.key_value
        if memory is x:
            weight, bias = torch.cat([own.weight, other.weight]), torch.cat([own.bias, other.bias])
            y = exported_self_attention(x, weight, bias, self.heads, seen)
            return F.linear(y, self.out.weight, self.out.bias)
        # A bias of all keys changes no softmax, and one of all values is a bias of what is seen of them.
        k, v = F.linear(memory, other.weight).chunk(2, dim=-1)
        y = exported_attention(self.query(x), k, v, self.heads, seen)
        bias = self.out.bias + self.out.weight @ other.bias.chunk(2)[1]
        return F.linear(y, self.out.weight, bias)


class FeedForward(nn.Module):
    """Norm, widen twofold, narrow: the residual branch of a block."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.up = nn.Linear(width, 2 * width)
        self.down = nn.Linear(2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.down(F.gelu(self.up(self.norm(x))))
        return y


class Block(nn.Module):
    """Self-attention, attention over a memory when `cross`, feed-forward; pre-norm, residual."""

    def __init__(self, width: int, heads: int, cross: bool = False) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.attention = Attention(width, heads)
        self.cross_norm = nn.LayerNorm(width) if cross else None
        self.cross = Attention(width, heads) if cross else None
        self.forward_part = FeedForward(width)

    def forward(
        self,
        x: Tensor,
        memory: Tensor | None = None,
        seen: Tensor | None = None,
        memory_seen: Tensor | None = None,
        last: int | None = None,
    ) -> Tensor:
        """x (B, T, D) -> (B, T, D); `seen` masks x (B, T), `memory_seen` the memory (B, S).

        `last`: only so many frames at the end of x are wanted (B, last, D); they look at all of it nevertheless.
        """
        y = self.norm(x)
        if last is None:
            x = x + self.attention(y, y, seen)
        else:
            x = x[:, -last:] + self.attention(y[:, -last:], y, seen)
        if self.cross is not None and self.cross_norm is not None and memory is not None:
            x = x + self.cross(self.cross_norm(x), memory, memory_seen)
        out: Tensor = x + self.forward_part(x)
        return out
