"""Layers that both listeners share: attention, feed-forward, modulation, written out so that each step is visible.

SFMS consists of `Block`s over sequences. ARIG computes one frame at a time: a query attends to a few tokens
(`CrossAttention`).

Shapes: B batch, T frames of the query, S frames of the memory, N samples, D width, h heads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from functools import lru_cache
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.idle import BANDS, head_channels

Tensors = tuple[Tensor, ...]


@lru_cache(maxsize=32)
@torch.inference_mode(False)  # the cached tensor serves training as well
def sinusoidal(length: int, width: int, device: torch.device | None = None) -> Tensor:
    """Return the sinusoidal positions (length, width) of Vaswani et al. 2017, read-only; `width` is even."""
    if device is not None and device.type != "cpu":
        return sinusoidal(length, width).to(device)
    position = torch.arange(length, dtype=torch.float32)[:, None]
    rate = torch.exp(torch.arange(0, width, 2, dtype=torch.float32) * (-math.log(10_000.0) / width))
    return torch.cat([torch.sin(position * rate), torch.cos(position * rate)], dim=-1)


def places_of(x: Tensor) -> Tensor:
    """Return the sinusoidal positions (T, W) of x (B, T, W), in its type and on its device."""
    return sinusoidal(x.shape[1], x.shape[2], x.device).to(x)


# --- Parts of both models ---------------------------------------------------------------------------------------------


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Return two linear layers with a GELU between."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, outputs))


class ListenerModel(nn.Module):
    """Base class of both listeners' weights: scales of motion and sound, and the sway, all set by training."""

    def __init__(self, settings: config.ListenerSettings, sound_width: int) -> None:
        super().__init__()
        channels = len(settings.channels)
        self.motion_mean = nn.Buffer(torch.zeros(channels))
        self.motion_std = nn.Buffer(torch.ones(channels))
        self.sound_mean = nn.Buffer(torch.zeros(sound_width))
        self.sound_std = nn.Buffer(torch.ones(sound_width))
        self.swaying = head_channels(settings.channels) if settings.sway else []
        if settings.sway:
            self.sway_mixture = nn.Buffer(torch.zeros(BANDS, len(self.swaying), len(self.swaying)))
            self.sway_spread = nn.Buffer(torch.zeros(()))

    def standardise(self, motion: Tensor) -> Tensor:
        """Return motion (..., C) of the model's motion space in the units of the model."""
        return (motion - self.motion_mean) / self.motion_std

    def restore(self, motion: Tensor) -> Tensor:
        """Return standardised motion (..., C) in the model's motion space."""
        return motion * self.motion_std + self.motion_mean

    def standardise_sound(self, sound: Tensor) -> Tensor:
        """Return sound features (..., A) in the units of the model."""
        return (sound - self.sound_mean) / self.sound_std


Model = TypeVar("Model", bound=ListenerModel)


class Network(nn.Module, Generic[Model]):
    """A function of tensors of one model. Its weights are named as in model.safetensors, with the prefix "model.".

    Attributes:
        free: names of the inputs (B, K, ...), where K is any number, the same for all of them.
        further: names of the inputs that `forward` accepts as its last argument, `*parts`.
    """

    free: Sequence[str] = ()
    further: Sequence[str] = ()

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model


# --- Operators of onnxruntime -----------------------------------------------------------------------------------------
#
# While a graph is exported, attention and LayerNorm become the one operator that onnxruntime has for each. Otherwise
# torch would write a dozen operators, which cost more than the few frames they compute.


def _operator(name: str, inputs: tuple[Any, ...], attributes: dict[str, Any], like: Tensor, version: int = 1) -> Tensor:
    """Return the output, of the type and shape of `like`, of an ONNX operator."""
    return torch.onnx.ops.symbolic(name, inputs, attributes, dtype=like.dtype, shape=like.shape, version=version)


def split_heads(x: Tensor, heads: int) -> Tensor:
    """Return x (N, S, D) as (N, h, S, D/h)."""
    n, s, d = x.shape
    return x.view(n, s, heads, d // heads).transpose(1, 2)


def join_heads(x: Tensor) -> Tensor:
    """Return x (N, h, S, D/h) as (N, S, D)."""
    return x.transpose(1, 2).flatten(2)


def attention(q: Tensor, k: Tensor, v: Tensor, heads: int, seen: Tensor | None = None) -> Tensor:
    """Return attention (N, T, D) of q (N, T, D) over k, v (N, S, D); `seen` (N, S) is True where q may attend.

    A CPU that trains in 16 bits computes it in 32 bits, because the gradient is slow in 16.
    """
    if torch.compiler.is_exporting():
        mask = None if seen is None else seen.to(torch.int32)
        return _operator("com.microsoft::MultiHeadAttention", (q, k, v, None, mask), {"num_heads": heads}, q)
    mask, half = None if seen is None else seen[:, None, None], q.dtype == torch.bfloat16 and not q.is_cuda
    q, k, v = (split_heads(each.float() if half else each, heads) for each in (q, k, v))
    with torch.autocast(q.device.type, enabled=False) if half else nullcontext():
        return join_heads(F.scaled_dot_product_attention(q, k, v, attn_mask=mask))


# --- Blocks over sequences (SFMS) -------------------------------------------------------------------------------------


class Attention(nn.Module):
    """Multi-head attention of `x` (B, T, D) over `memory` (B, S, D)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor, memory: Tensor, seen: Tensor | None = None) -> Tensor:
        """Return (B, T, D). `seen` (B, S) is True where `x` may attend to the memory, at least once per row."""
        if torch.compiler.is_exporting():
            return self._exported(x, memory, seen)
        k, v = self.key_value(memory).chunk(2, dim=-1)
        out: Tensor = self.out(attention(self.query(x), k, v, self.heads, seen))
        return out

    def _exported(self, x: Tensor, memory: Tensor, seen: Tensor | None) -> Tensor:
        """Return `forward` in as few operators as possible; terms of only weights are folded when a graph loads."""
        own, other = self.query, self.key_value
        if memory is x:  # one operator with the projection of queries, keys and values
            weight, bias = torch.cat([own.weight, other.weight]), torch.cat([own.bias, other.bias])
            mask = None if seen is None else seen.to(torch.int32)
            y = _operator("com.microsoft::Attention", (x, weight.T, bias, mask), {"num_heads": self.heads}, x)
            return F.linear(y, self.out.weight, self.out.bias)
        # softmax(q (k + c)^T) does not depend on c, and a bias of all values is a bias of the result.
        k, v = F.linear(memory, other.weight).chunk(2, dim=-1)
        y = attention(self.query(x), k, v, self.heads, seen)
        bias = self.out.bias + self.out.weight @ other.bias.chunk(2)[1]
        return F.linear(y, self.out.weight, bias)


class NormFeedForward(nn.Module):
    """Norm, widen twofold, GELU, narrow: the residual branch of a block."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.up = nn.Linear(width, 2 * width)
        self.down = nn.Linear(2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return the branch (..., D) of x (..., D), not yet added to it."""
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
        self.forward_part = NormFeedForward(width)

    def forward(
        self,
        x: Tensor,
        memory: Tensor | None = None,
        seen: Tensor | None = None,
        memory_seen: Tensor | None = None,
        last: int | None = None,
    ) -> Tensor:
        """Return (B, T, D) of x (B, T, D); `seen` masks x (B, T), `memory_seen` the memory (B, S).

        `last`: return only that many frames at the end (B, last, D); their queries still see all of x.
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


# --- Layers of single frames (ARIG) -----------------------------------------------------------------------------------


class FeedForward(nn.Module):
    """Widen to `hidden`, GELU, narrow."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.up = nn.Linear(width, hidden)
        self.down = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return (..., D) of x (..., D)."""
        out: Tensor = self.down(F.gelu(self.up(x)))
        return out


class Modulation(nn.Module):
    """adaLN (Peebles and Xie 2023; A.1): shifts, scales and gates of a block, computed from a condition.

    Ours: an untrained modulation hardly changes its block (shifts about 0, scales and gates about 1), because gates of
    0, with which DiT begins, only delay learning at these depths.
    """

    def __init__(self, width: int, kinds: str) -> None:
        """Create a layer from a condition to one vector per letter of `kinds`, s(hift), (s)c(ale) or g(ate).

        The condition and each vector have `width` numbers.
        """
        super().__init__()
        self.parts = len(kinds)
        self.linear = nn.Linear(width, self.parts * width)
        nn.init.normal_(self.linear.weight, std=0.5 * width**-0.5)
        with torch.no_grad():
            self.linear.bias.copy_(torch.tensor([float(kind != "s") for kind in kinds]).repeat_interleave(width))

    def forward(self, condition: Tensor) -> Tensors:
        """Return one vector (..., size) per letter from a condition (..., D) that SiLU was applied to."""
        parts: Tensors = self.linear(condition).chunk(self.parts, dim=-1)
        return parts

    def of_tokens(self, condition: Tensor) -> Tensors:
        """Return one vector (N, 1, size) per letter from a condition (N, D), for all tokens of a sample."""
        parts: Tensors = self.linear(condition)[:, None].chunk(self.parts, dim=-1)
        return parts


def modulated(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """Return LayerNorm of x (..., D) without weights, then scaled and shifted; `shift`, `scale` broadcast to x."""
    if torch.compiler.is_exporting():
        return _operator("LayerNormalization", (x, scale, shift), {"axis": -1, "epsilon": 1e-5}, x, 17)
    return torch.addcmul(shift, torch.layer_norm(x, x.shape[-1:]), scale)


def weighted_mean(x: Tensor, weights: Tensor | None) -> Tensor:
    """Return the mean (...) of x (..., C) over channels, by weights (C,) that add up to 1; None weighs all equally."""
    return x.mean(-1) if weights is None else (x * weights).sum(-1)


def windows(x: Tensor, size: int) -> Tensor:
    """Return windows (B, T, size, D) of x (B, T, D): each frame and those before it, the first one repeated (A.2)."""
    return torch.cat([x[:, :1].expand(-1, size - 1, -1), x], dim=1).unfold(1, size, 1).transpose(-1, -2)


class CrossAttention(nn.Module):
    """Cross attention of a query over a few tokens, then a feed-forward; pre-norm, residual.

    Projecting a token does not depend on its slot: a learned vector of the slot is added to the finished key and value.
    So a stream projects every token once, however long it stays in view.
    """

    def __init__(self, width: int, hidden: int, heads: int, slots: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.slots = nn.Parameter(torch.randn(slots, 2 * width) * 0.02)
        self.out = nn.Linear(width, width)
        self.ffn_norm = nn.LayerNorm(width)
        self.ffn = FeedForward(width, hidden)

    def keys(self, tokens: Tensor) -> Tensor:
        """Return keys and values (..., 2D) of tokens (..., D), for `forward`."""
        out: Tensor = self.key_value(tokens)
        return out

    def forward(self, x: Tensor, keys: Tensor) -> Tensor:
        """Return (N, D) of queries x (N, D) over `keys` (N, slots, 2D)."""
        query, (k, v) = self.query(self.norm(x))[:, None], (keys + self.slots).chunk(2, dim=-1)
        x = x + self.out(attention(query, k, v, self.heads)[:, 0])
        out: Tensor = x + self.ffn(self.ffn_norm(x))
        return out
