"""Finite scalar quantization (Mentzer et al. 2023, arXiv:2309.15505): a code is a point on a small fixed grid.

Every group has its own grid of D dimensions; dimension d of group g has L[g, d] levels, spread evenly over -1..1.
A code's index counts the levels in mixed radix, first dimension fastest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn


def as_levels(levels: Sequence[Sequence[int]]) -> Tensor:
    """(G, D) integer levels, float for the arithmetic."""
    return torch.tensor(levels, dtype=torch.float32)


def quantize(latent: Tensor, levels: Tensor) -> Tensor:
    """Nearest grid point of tanh(latent), (..., G, D) in -1..1, gradient straight through the rounding."""
    bounded = torch.tanh(latent)
    position = (bounded + 1) / 2 * (levels - 1)
    code = torch.round(position) / (levels - 1) * 2 - 1
    return bounded + (code - bounded).detach()


def codes_to_indices(codes: Tensor, levels: Tensor) -> Tensor:
    """(..., G, D) on the grid -> (..., G) int64 in 0..prod(levels) - 1."""
    digits = torch.round((codes + 1) / 2 * (levels - 1)).long()
    return (digits * _radix(levels)).sum(-1)


def indices_to_codes(indices: Tensor, levels: Tensor) -> Tensor:
    """The inverse: (..., G) -> (..., G, D)."""
    digits = indices[..., None] // _radix(levels) % levels.long()
    return digits / (levels - 1) * 2 - 1


def _radix(levels: Tensor) -> Tensor:
    ones = torch.ones_like(levels[:, :1])
    return torch.cat([ones, levels[:, :-1]], dim=-1).cumprod(-1).long()  # (G, D)


class GroupMLP(nn.Module):
    """One two-layer network per group, all groups at once: no group sees another's input."""

    def __init__(self, groups: int, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.w1 = nn.Parameter(torch.randn(groups, inputs, hidden) / math.sqrt(inputs))
        self.b1 = nn.Parameter(torch.zeros(groups, hidden))
        self.w2 = nn.Parameter(torch.randn(groups, hidden, outputs) / math.sqrt(hidden))
        self.b2 = nn.Parameter(torch.zeros(groups, outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, G, inputs) -> (B, T, G, outputs)."""
        y = torch.einsum("btgi,gih->btgh", x, self.w1) + self.b1
        return torch.einsum("btgh,gho->btgo", nn.functional.gelu(y), self.w2) + self.b2


class Quantizer(nn.Module):
    """Motion of one frame -> one code per group -> motion of that frame. Frames do not see each other."""

    member: Tensor
    levels: Tensor

    def __init__(self, member: Tensor, levels: Sequence[Sequence[int]], hidden: int = 48) -> None:
        """`member` (G, C): 1 where channel c belongs to group g."""
        super().__init__()
        groups, channels = member.shape
        self.register_buffer("member", member, persistent=False)
        self.register_buffer("levels", as_levels(levels), persistent=False)
        self.encoder = GroupMLP(groups, channels, hidden, len(levels[0]))
        self.decoder = GroupMLP(groups, len(levels[0]), hidden, channels)

    def encode(self, motion: Tensor) -> Tensor:
        """(B, T, C) standardised -> codes (B, T, G, D) on the grid."""
        return quantize(self.encoder(motion[..., None, :] * self.member), self.levels)

    def decode(self, codes: Tensor) -> Tensor:
        """(B, T, G, D) -> (B, T, C): each channel from its own group's code."""
        out: Tensor = (self.decoder(codes) * self.member).sum(-2)
        return out
