"""The tokenizers that tables III and IV of the SFMS paper compare: recipes by name, networks, one interface, files.

The recipes are those of `configs/tokenizer_tables.yaml`. NAME-seed2 is NAME trained with seed 2. The baselines have one
code a frame, or one every eight frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import torch
import yaml
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.config import load, parse
from sfms_robot.config.base import read
from sfms_robot.config.training import HALVINGS
from sfms_robot.data import data_dir
from sfms_robot.frames import CHANNELS
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.layers import Block, places_of
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import Strategy
from sfms_robot.listeners.sfms.quantizer import Codebook, Grid

SizeName = Literal["small", "paper"]
COMPARED: Final = read(data_dir("configs") / "tokenizer_tables.yaml")
_SEED: Final = "-seed"


def seeded(name: str, seeds: int) -> list[str]:
    """Return the names of one tokenizer trained with seeds 1 to `seeds`."""
    return [name, *(f"{name}{_SEED}{seed}" for seed in range(2, seeds + 1))]


def recipe_of(name: str, size: SizeName = "small", steps: int | None = None) -> config.Recipe:
    """Return the recipe of a tokenizer by name, perhaps with the seed of its name."""
    base, _, seed = name.partition(_SEED)
    recipe, usual = COMPARED["recipes"][base], COMPARED["sizes"][size]
    training = {**usual["training"], "evaluate_every": 0, **recipe.get("training", {})}
    if steps is not None:
        training["steps"] = steps
    model = usual[recipe["model"]["kind"]] | recipe["model"]
    return parse(config.Recipe, {"model": model, "training": training, "seed": int(seed or 1)}, name)


# --- baselines ------------------------------------------------------------------------------------------------------


class Stack(nn.Module):
    """Transformer blocks over x (B, T, width), with sinusoidal positions."""

    def __init__(self, width: int, heads: int, layers: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + places_of(x)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.norm(x)
        return out


class Bottleneck(nn.Module):
    """A map of each time step separately: width -> a code -> width."""

    def __init__(self, settings: config.Baseline) -> None:
        super().__init__()
        self.codebook: Grid | Codebook
        if settings.quantizer == "fsq":
            self.codebook = Grid([settings.levels])
        else:
            self.codebook = Codebook([math.prod(settings.levels)], settings.code_dims)
        self.down = nn.Linear(settings.width, self.codebook.dims)
        self.up = nn.Linear(self.codebook.dims, settings.width)

    def latent(self, x: Tensor) -> Tensor:
        """Map (B, T, width) to (B, T, 1, D)."""
        out: Tensor = self.down(x)[..., None, :]
        return out

    def restore(self, codes: Tensor) -> Tensor:
        """Map (B, T, 1, D) to (B, T, width)."""
        out: Tensor = self.up(codes.flatten(2))
        return out


class DenseTokenizer(nn.Module):
    """One code for every frame: motion (B, T, C), standardised <-> indices (B, T, 1).

    Dense-FSQ-1024 and VQ-only of tables III and IV, after "Finite Scalar Quantization as Facial Tokenizer for Dyadic
    Reaction Generation" ([10] of the SFMS paper), which published no code: a transformer reads the window, each frame
    is quantized, a second transformer restores the window.
    """

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
        """Return the size of the codes of a window; their places are known and need no bits."""
        return self.settings.window_frames * math.log2(self.settings.codes)

    def encode(self, motion: Tensor) -> Tensor:
        return self.bottleneck.codebook.indices(self.bottleneck.codebook.nearest(self.latent(motion)))

    def decode(self, indices: Tensor) -> Tensor:
        return self.synthesise(self.bottleneck.codebook.codes(indices))

    def latent(self, motion: Tensor) -> Tensor:
        """Map (B, T, C) to (B, T, 1, D), not yet codes."""
        return self.bottleneck.latent(self.encoder(self.read(motion)))

    def synthesise(self, codes: Tensor) -> Tensor:
        """Map (B, T, 1, D) to (B, T, C)."""
        out: Tensor = self.write(self.decoder(self.bottleneck.restore(codes)))
        return out


class GroupedTokenizer(DenseTokenizer):
    """One code for every eight frames: motion (B, T, C), standardised <-> indices (B, T / 8, 1); T a multiple of 8.

    The VQ-VAE of Ng et al. 2022, "Learning to Listen", table IV's L2L row, as its published configuration describes it
    (evonneng/learning2listen @ a0825d58): three stages halve the time, one by a strided convolution and two by pooling,
    with transformers on both sides of the codes. Its authors learn 200 vectors, the SFMS paper compares with 256.
    """

    def __init__(self, settings: config.Grouped, channels: int) -> None:
        super().__init__(settings, channels)
        width, kernel, strides = settings.width, 5, (2, 1, 1)
        self.shorten = nn.ModuleList(nn.Conv1d(width, width, kernel, stride, kernel // 2) for stride in strides)
        self.lengthen = nn.ModuleList(nn.Conv1d(width, width, kernel, padding=kernel // 2) for _ in strides)

    @property
    def bits_per_window(self) -> float:
        return super().bits_per_window / (1 << HALVINGS)

    def latent(self, motion: Tensor) -> Tensor:
        x = self.read(motion).transpose(1, 2)
        frames = x.shape[-1]
        for stage in self.shorten:
            frames //= 2
            x = F.leaky_relu(stage(x), 0.2)
            x = x if x.shape[-1] == frames else F.max_pool1d(x, 2)
        return self.bottleneck.latent(self.encoder(x.transpose(1, 2)))

    def synthesise(self, codes: Tensor) -> Tensor:
        x = self.bottleneck.restore(codes).transpose(1, 2)
        for stage in self.lengthen:
            x = F.leaky_relu(stage(x.repeat_interleave(2, dim=-1)), 0.2)
        out: Tensor = self.write(self.decoder(x.transpose(1, 2)))
        return out


def baseline_loss(
    tokenizer: DenseTokenizer, motion: Tensor, commitment: float, generator: torch.Generator | None = None
) -> Tensor:
    """Return the squared error of the window plus the commitment of learned vectors; a `generator` updates the vectors.

    The papers' loss is L1 by parts; the tables compare the squared error, so all tokenizers learn the squared error.
    """
    latent = tokenizer.latent(motion)
    codebook = tokenizer.bottleneck.codebook
    everywhere = torch.ones_like(latent[..., 0])
    if generator is not None and isinstance(codebook, Codebook):
        codebook.learn(latent, everywhere, generator)
    restored = tokenizer.synthesise(codebook.nearest(latent))
    return F.mse_loss(restored, motion) + commitment * codebook.commitment(latent, everywhere)


# --- one interface --------------------------------------------------------------------------------------------------

_CHUNK: Final = 64  # windows at a time
_FREE_PLACES: Final = ("static", "static_paper")  # a decoder knows the places of these keyframes
# Smallest deviation by which a channel is divided: rad, m, fraction of 0..1. Smaller motion is noise.
_STILL: Final = [0.01] * 3 + [0.005] * 3 + [0.02] * 52


class TableModel(nn.Module):
    """One tokenizer and the scales of the motion it was trained on. The score of a row is in these units."""

    motion_mean: Tensor
    motion_std: Tensor

    def __init__(self, recipe: config.Recipe) -> None:
        super().__init__()
        self.recipe = recipe
        self.register_buffer("motion_mean", torch.zeros(len(CHANNELS)))
        self.register_buffer("motion_std", torch.ones(len(CHANNELS)))
        settings = recipe.model
        self.tokenizer: Tokenizer | DenseTokenizer
        if isinstance(settings, config.Dense):
            self.tokenizer = DenseTokenizer(settings, len(CHANNELS))
        elif isinstance(settings, config.Grouped):
            self.tokenizer = GroupedTokenizer(settings, len(CHANNELS))
        else:
            self.tokenizer = Tokenizer(settings)

    @property
    def window(self) -> int:
        return self.recipe.model.window_frames

    def fit_scales(self, motion: Tensor) -> None:
        """Set means and deviations from motion (N, 58)."""
        self.motion_mean.copy_(motion.mean(0))
        self.motion_std.copy_(torch.maximum(motion.std(0), torch.tensor(_STILL)))

    def standardise(self, motion: Tensor) -> Tensor:
        return (motion - self.motion_mean) / self.motion_std

    @torch.no_grad()
    def mask(self, motion: Tensor, strategy: Strategy | None = None) -> Tensor:
        """Return the keyframes (W, T, G) of standardised windows, with another placement if given."""
        tokenizer = self.sparse()
        parts = [tokenizer.place(some, tokenizer.keyframes, strategy) for some in torch.split(motion, _CHUNK)]
        return torch.cat(parts)

    @torch.no_grad()
    def restore(self, motion: Tensor, mask: Tensor | None = None, *, rounded: bool = True) -> Tensor:
        """Encode and decode standardised windows (W, T, C), with keyframes at a mask (W, T, G) if given.

        If not `rounded`, decode the encoder's output before a code is chosen; only for sparse tokenizers.
        """
        tokenizer = self.tokenizer
        if isinstance(tokenizer, DenseTokenizer):
            return torch.cat([tokenizer.decode(tokenizer.encode(some)) for some in torch.split(motion, _CHUNK)])
        mask = self.mask(motion) if mask is None else mask
        both = zip(*(torch.split(each, _CHUNK) for each in (motion, mask)), strict=True)
        if rounded:
            return torch.cat([tokenizer.decode(tokenizer.encode(some, at)) for some, at in both])
        quantizer = tokenizer.quantizer
        bound = torch.tanh if isinstance(quantizer.codebook, Grid) else torch.nn.Identity()
        return torch.cat([tokenizer.inpaint(bound(quantizer.latent(some)), at) for some, at in both])

    def bits(self, strategy: Strategy | None = None, keyframes: Sequence[int] = ()) -> float:
        """Return the bits of a window: codes at fixed length, and the places of keyframes unless they are known.

        `keyframes`: Their number for each group, if it is not that of the recipe.
        """
        settings = self.recipe.model
        if isinstance(self.tokenizer, DenseTokenizer):
            return self.tokenizer.bits_per_window
        assert isinstance(settings, config.Sfms)
        free = (strategy or settings.placement) in _FREE_PLACES  # then there is only one way to place them
        counts = zip(
            keyframes or self.tokenizer.keyframes, (group.codes for group in settings.groups.values()), strict=True
        )
        return sum(keyframe_bits(n if free else self.window, n, size) for n, size in counts)

    def sparse(self) -> Tokenizer:
        """Return the tokenizer if it has keyframes. Raises TypeError."""
        if not isinstance(self.tokenizer, Tokenizer):
            raise TypeError(f"{self.recipe.model.kind} has no keyframes")
        return self.tokenizer


def keyframe_bits(frames: int, k: int, codes: int) -> float:
    """Return the bits of a track of a window: which k of its frames (log2 of the binomial), and k of `codes` codes."""
    if not 0 <= k <= frames:
        raise ValueError(f"keyframes: expected 0 to {frames}, got {k}")
    return math.log2(math.comb(frames, k)) + k * math.log2(codes)


# --- files ----------------------------------------------------------------------------------------------------------


def save_tokenizer(folder: Path, model: TableModel) -> None:
    """Write config.yaml and weights, in half precision: the codes stay the same, and a table needs many tokenizers."""
    folder.mkdir(parents=True, exist_ok=True)
    raw = model.recipe.model_dump(mode="json", exclude_defaults=True)
    raw["model"]["kind"] = model.recipe.model.kind
    text = yaml.safe_dump(raw, sort_keys=False, width=110, default_flow_style=None)
    (folder / checkpoint.CONFIG).write_text(text, encoding="utf-8")
    checkpoint.save_weights(folder / checkpoint.WEIGHTS, model, bits=16)


def load_tokenizer(folder: Path) -> TableModel:
    """Read the tokenizer of a folder. Raises ConfigError or ModelError."""
    model = TableModel(load(config.Recipe, folder / checkpoint.CONFIG))
    checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    return model.eval()
