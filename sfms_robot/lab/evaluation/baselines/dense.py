"""One code for every frame: Dense-FSQ-1024 and VQ-only of tables III and IV.

After "Finite Scalar Quantization as Facial Tokenizer for Dyadic Reaction Generation" ([10] of the SFMS paper), which
published no code: a transformer reads the window, each frame is quantized, a second transformer restores the window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.layers import Block, sinusoidal
from sfms_robot.listeners.sfms.quantizer import Codebook, Grid


class Stack(nn.Module):
    """Transformer blocks over x (B, T, width), with sinusoidal positions."""

    def __init__(self, width: int, heads: int, layers: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + sinusoidal(x.shape[1], x.shape[2]).to(x)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.norm(x)
        return out


class Bottleneck(nn.Module):
    """width -> a code -> width, one step of time at a time."""

    def __init__(self, settings: config.Baseline) -> None:
        super().__init__()
        self.codebook = _codebook(settings.quantizer, settings.levels, settings.code_dims)
        self.down = nn.Linear(settings.width, self.codebook.dims)
        self.up = nn.Linear(self.codebook.dims, settings.width)

    def latent(self, x: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, 1, D)."""
        out: Tensor = self.down(x)[..., None, :]
        return out

    def restore(self, codes: Tensor) -> Tensor:
        """(B, T, 1, D) -> (B, T, width)."""
        out: Tensor = self.up(codes.flatten(2))
        return out


def _codebook(kind: str, levels: Sequence[int], dims: int) -> Grid | Codebook:
    return Grid([levels]) if kind == "fsq" else Codebook([math.prod(levels)], dims)


class DenseTokenizer(nn.Module):
    """Motion (B, T, C), standardised <-> indices (B, T, 1)."""

    def __init__(self, settings: config.Baseline, channels: int) -> None:
        super().__init__()
        self.settings = settings
        self.read = nn.Linear(channels, settings.width)
        self.encoder = Stack(settings.width, settings.heads, settings.layers)
        self.bottleneck = Bottleneck(settings)
        self.decoder = Stack(settings.width, settings.heads, settings.layers)
        self.write = nn.Linear(settings.width, channels)

    @property
    def bits_per_window(self) -> float:
        """Codes of a whole window; their places are known."""
        return self.settings.window_frames * math.log2(self.settings.codes)

    def encode(self, motion: Tensor) -> Tensor:
        """(B, T, C) -> indices (B, T, 1)."""
        return self.bottleneck.codebook.indices(self.bottleneck.codebook.nearest(self.latent(motion)))

    def decode(self, indices: Tensor) -> Tensor:
        """The inverse, as near as the codes allow."""
        return self.synthesise(self.bottleneck.codebook.codes(indices))

    def latent(self, motion: Tensor) -> Tensor:
        """(B, T, C) -> (B, T, 1, D), not yet codes."""
        return self.bottleneck.latent(self.encoder(self.read(motion)))

    def synthesise(self, codes: Tensor) -> Tensor:
        """(B, T, 1, D) -> (B, T, C)."""
        out: Tensor = self.write(self.decoder(self.bottleneck.restore(codes)))
        return out


def baseline_loss(
    tokenizer: DenseTokenizer, motion: Tensor, commitment: float, generator: torch.Generator | None = None
) -> Tensor:
    """Squared error of the window, and the commitment of learned vectors, which move when a `generator` is given.

    The papers' loss is L1 by parts; what is compared is the squared error, so all tokenizers learn that.
    """
    latent = tokenizer.latent(motion)
    codebook = tokenizer.bottleneck.codebook
    everywhere = torch.ones_like(latent[..., 0])
    if generator is not None and isinstance(codebook, Codebook):
        codebook.learn(latent, everywhere, generator)
    restored = tokenizer.synthesise(codebook.nearest(latent))
    return F.mse_loss(restored, motion) + commitment * codebook.commitment(latent, everywhere)
