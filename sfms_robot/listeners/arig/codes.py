"""The discrete ablation (table 4): motion as one of N codes, drawn from a softmax, in place of diffusion.

The codebook is that of finite scalar quantization (`listeners.sfms.quantizer`), one for the whole face. It is learned
beside the model: its own loss is how well motion survives it, and no gradient of the softmax reaches it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.listeners.arig.parts import Linear, weighted_mean
from sfms_robot.listeners.sfms.quantizer import as_levels, codes_to_indices, indices_to_codes, quantize


class CodeHead(nn.Module):
    """The same face as `diffusion.Denoiser`: a loss, and a sample from given noise."""

    levels: Tensor

    def __init__(self, channels: int, width: int, condition: int, levels: tuple[int, ...]) -> None:
        super().__init__()
        self.register_buffer("levels", as_levels([levels]), persistent=False)
        self.encode = nn.Sequential(Linear(channels, width), nn.GELU(), Linear(width, len(levels)))
        self.decode = nn.Sequential(Linear(len(levels), width), nn.GELU(), Linear(width, channels))
        self.classify = Linear(condition, math.prod(levels))

    def loss(
        self, z: Tensor, motion: Tensor, generator: torch.Generator | None = None, weights: Tensor | None = None
    ) -> Tensor:
        """z (N, D), motion (N, C), weights (C,) -> cross-entropy of its code plus squared error of the code, (N,)."""
        code = quantize(self.encode(motion)[:, None], self.levels)  # (N, 1, dims)
        rebuilt = weighted_mean((self.decode(code[:, 0]) - motion).square(), weights)
        index = codes_to_indices(code.detach(), self.levels)[:, 0]
        wrong: Tensor = F.cross_entropy(self.classify(z), index, reduction="none")
        return rebuilt + wrong

    def sample(self, z: Tensor, noise: Tensor) -> Tensor:
        """Conditions z (N, D), noise (N, 1, 1) standard normal -> motion (N, C) of a code drawn by the softmax."""
        share = torch.special.ndtr(noise[:, 0].double())  # standard normal -> uniform
        mass = torch.softmax(self.classify(z).double(), dim=-1).cumsum(-1)
        index = (mass <= share * mass[:, -1:]).sum(-1, keepdim=True).clamp(max=mass.shape[-1] - 1)
        out: Tensor = self.decode(indices_to_codes(index, self.levels)[:, 0])
        return out
