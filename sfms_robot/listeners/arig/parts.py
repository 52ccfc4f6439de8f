"""Blocks that the modules of ARIG share. N samples (frames of a batch, one when streaming), S tokens, D width."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.listeners.layers import exported_attention, exported_norm


class Part(nn.Module):
    """Called without a module's hooks, which nothing here uses: for one frame they cost as much as a product."""

    def __call__(self, *args: Any) -> Any:
        return self.forward(*args)


class Linear(nn.Linear):
    """Without hooks, as `Part`."""

    __call__ = nn.Linear.forward


class LayerNorm(nn.LayerNorm):
    """Without hooks, as `Part`."""

    __call__ = nn.LayerNorm.forward


def split_heads(x: Tensor, heads: int) -> Tensor:
    """(N, S, D) -> (N, h, S, D/h)."""
    n, s, d = x.shape
    return x.view(n, s, heads, d // heads).transpose(1, 2)


def join_heads(x: Tensor) -> Tensor:
    """(N, h, S, D/h) -> (N, S, D)."""
    n, h, s, d = x.shape
    return x.transpose(1, 2).reshape(n, s, h * d)


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Full attention of (N, h, S, D/h), in 32 bits where training on a CPU runs in 16: its gradient is slow there."""
    if q.dtype == torch.bfloat16 and not q.is_cuda:
        with torch.autocast(q.device.type, enabled=False):
            return F.scaled_dot_product_attention(q.float(), k.float(), v.float())
    return F.scaled_dot_product_attention(q, k, v)


class FeedForward(Part):
    """Widen to `hidden`, GELU, narrow."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.up = Linear(width, hidden)
        self.down = Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.down(F.gelu(self.up(x)))
        return out


class Modulation(Part):
    """adaLN (Peebles and Xie 2023): shifts, scales and gates of a block, from a condition.

    A fresh one leaves its block a plain one: shifts about 0, scales and gates about 1. DiT begins with gates of 0; at
    these depths that only delays learning.
    """

    def __init__(self, width: int, size: int, kinds: str) -> None:
        """Vectors of `size` from a condition of `width`, one per letter of `kinds`: s(hift), c (scale) or g(ate)."""
        super().__init__()
        self.parts = len(kinds)
        self.linear = Linear(width, self.parts * size)
        nn.init.normal_(self.linear.weight, std=0.5 * width**-0.5)
        with torch.no_grad():
            self.linear.bias.copy_(torch.tensor([float(kind != "s") for kind in kinds]).repeat_interleave(size))

    def forward(self, condition: Tensor) -> tuple[Tensor, ...]:
        """Condition (..., D), SiLU already applied -> one (..., size) per letter."""
        return self.linear(condition).chunk(self.parts, dim=-1)

    def of_tokens(self, condition: Tensor) -> tuple[Tensor, ...]:
        """Condition (N, D) -> (N, 1, size) per letter, for all tokens of a sample; of a single sample (size,)."""
        parts = self.linear(condition)
        return (parts[0] if parts.shape[0] == 1 else parts[:, None]).chunk(self.parts, dim=-1)


def modulated(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """LayerNorm of x (..., D) without weights of its own, then scale and shift, which broadcast to x."""
    if torch.compiler.is_exporting():
        return exported_norm(x, scale, shift)
    if shift.dim() == 1:  # one for all: LayerNorm applies it itself
        return torch.layer_norm(x, x.shape[-1:], scale, shift)
    return torch.addcmul(shift, torch.layer_norm(x, x.shape[-1:]), scale)


def weighted_mean(x: Tensor, weights: Tensor | None) -> Tensor:
    """x (..., C) -> (...), each channel by its weight (C,), which add up to 1; None: all alike."""
    return x.mean(-1) if weights is None else (x * weights).sum(-1)


def windows(x: Tensor, size: int) -> Tensor:
    """x (B, T, D) -> (B, T, size, D): each frame and those before it; the first one repeated before the start (A.2)."""
    padded = torch.cat([x[:, :1].expand(-1, size - 1, -1), x], dim=1)
    return padded.unfold(1, size, 1).transpose(-1, -2)


class CrossAttention(Part):
    """A query looks at a few tokens, then a feed-forward; pre-norm, residual.

    Keys and values of a token do not depend on its slot: what a slot means is added to the finished key. So a stream
    projects every token once, however long it stays in view.
    """

    def __init__(self, width: int, hidden: int, heads: int, slots: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = LayerNorm(width)
        self.query = Linear(width, width)
        self.key_value = Linear(width, 2 * width)
        self.slots = nn.Parameter(torch.randn(slots, 2 * width) * 0.02)
        self.out = Linear(width, width)
        self.ffn_norm = LayerNorm(width)
        self.ffn = FeedForward(width, hidden)

    def keys(self, tokens: Tensor) -> Tensor:
        """Tokens (..., D) -> keys and values (..., 2D), for `forward`."""
        out: Tensor = self.key_value(tokens)
        return out

    def forward(self, x: Tensor, keys: Tensor) -> Tensor:
        """x (N, D) looking at keys (N, slots, 2D) -> (N, D)."""
        query, told = self.query(self.norm(x))[:, None], keys + self.slots
        if torch.compiler.is_exporting():
            k, v = told.chunk(2, dim=-1)
            seen = exported_attention(query, k, v, self.heads)
        else:
            k, v = split_heads(told, 2 * self.heads).chunk(2, dim=1)
            seen = join_heads(attend(split_heads(query, self.heads), k, v))
        x = x + self.out(seen[:, 0])
        out: Tensor = x + self.ffn(self.ffn_norm(x))
        return out
