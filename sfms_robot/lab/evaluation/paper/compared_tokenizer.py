"""Any tokenizer of the tables behind one face: standardise, encode, decode, count bits; and its folder on disk."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import torch
import yaml
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.config import load
from sfms_robot.frames import BLENDSHAPES, CHANNELS
from sfms_robot.lab.evaluation.baselines.dense import DenseTokenizer
from sfms_robot.lab.evaluation.baselines.grouped import GroupedTokenizer
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import Strategy

WEIGHTS: Final = checkpoint.WEIGHTS
FREE_PLACES: Final = ("static", "static_paper")  # the reader knows where these keyframes are
CHUNK: Final = 64  # windows at a time

# Least deviation that a channel is divided by: what moves less is noise, and must not be blown up to count as motion.
STILL: Final = {"angle": 0.01, "place": 0.005, "shape": 0.02}  # rad, m, of 0..1


class TableModel(nn.Module):
    """One tokenizer and the scales of the motion it was trained on. The score of a row is in these units."""

    motion_mean: Tensor
    motion_std: Tensor

    def __init__(self, recipe: config.Recipe) -> None:
        super().__init__()
        self.recipe = recipe
        self.register_buffer("motion_mean", torch.zeros(len(CHANNELS)))
        self.register_buffer("motion_std", torch.ones(len(CHANNELS)))
        self.tokenizer = _tokenizer(recipe)

    @property
    def window(self) -> int:
        return self.recipe.model.window_frames

    @property
    def parameters_count(self) -> int:
        return sum(p.numel() for p in self.tokenizer.parameters())

    def fit_scales(self, motion: Tensor) -> None:
        """Means and deviations of motion (N, 58)."""
        self.motion_mean.copy_(motion.mean(0))
        self.motion_std.copy_(torch.maximum(motion.std(0), _floor()))

    def standardise(self, motion: Tensor) -> Tensor:
        return (motion - self.motion_mean) / self.motion_std

    @torch.no_grad()
    def mask(self, motion: Tensor, strategy: Strategy | None = None, k: int | None = None) -> Tensor:
        """Keyframes (W, T, G) of standardised windows; another placement or number may be asked for."""
        tokenizer = self.sparse()
        counts = tokenizer.keyframes if k is None else [k] * len(tokenizer.keyframes)
        return torch.cat([tokenizer.place(some, counts, strategy) for some in torch.split(motion, CHUNK)])

    @torch.no_grad()
    def restore(self, motion: Tensor, strategy: Strategy | None = None, k: int | None = None) -> Tensor:
        """Standardised windows (W, T, C) written as codes and read again."""
        tokenizer = self.tokenizer
        if isinstance(tokenizer, DenseTokenizer):
            parts = [tokenizer.decode(tokenizer.encode(some)) for some in torch.split(motion, CHUNK)]
        else:
            masks = torch.split(self.mask(motion, strategy, k), CHUNK)
            both = zip(torch.split(motion, CHUNK), masks, strict=True)
            parts = [tokenizer.decode(tokenizer.encode(some, at)) for some, at in both]
        return torch.cat(parts)

    def bits(self, strategy: Strategy | None = None, k: int | None = None) -> float:
        """Of a window: codes at fixed length, and the places of keyframes that are not where everybody expects."""
        settings, tokenizer = self.recipe.model, self.tokenizer
        if isinstance(tokenizer, DenseTokenizer):
            return tokenizer.bits_per_window
        if not isinstance(settings, config.Sfms):
            raise TypeError(f"{settings.kind} is no sparse tokenizer")
        counts = tokenizer.keyframes if k is None else [k] * len(tokenizer.keyframes)
        codes = [group.codes for group in settings.groups.values()]
        if (strategy or settings.placement) in FREE_PLACES:
            return sum(n * math.log2(size) for n, size in zip(counts, codes, strict=True))
        return sum(keyframe_bits(self.window, k, n) for k, n in zip(counts, codes, strict=True))

    def sparse(self) -> Tokenizer:
        """The tokenizer, where it has keyframes."""
        if not isinstance(self.tokenizer, Tokenizer):
            raise TypeError(f"{self.recipe.model.kind} has no keyframes")
        return self.tokenizer


def keyframe_bits(frames: int, k: int, codes: int) -> float:
    """One track of a window: which k of its frames (log2 of the binomial) and k codes out of `codes`."""
    if not 0 <= k <= frames:
        raise ValueError(f"{k} keyframes in {frames} frames")
    return math.log2(math.comb(frames, k)) + k * math.log2(codes)


def _tokenizer(recipe: config.Recipe) -> Tokenizer | DenseTokenizer:
    settings = recipe.model
    if isinstance(settings, config.Dense):
        return DenseTokenizer(settings, len(CHANNELS))
    if isinstance(settings, config.Grouped):
        return GroupedTokenizer(settings, len(CHANNELS))
    return Tokenizer(settings)


def _floor() -> Tensor:
    kinds = {"roll": "angle", "pitch": "angle", "yaw": "angle", "x": "place", "y": "place", "z": "place"}
    return torch.tensor([STILL["shape" if name in BLENDSHAPES else kinds[name]] for name in CHANNELS])


def save(folder: Path, model: TableModel) -> None:
    """Write config.yaml and weights, in half precision: codes stay what they are, and a table needs many of them."""
    folder.mkdir(parents=True, exist_ok=True)
    raw = model.recipe.model_dump(mode="json", exclude_defaults=True)
    raw["model"]["kind"] = model.recipe.model.kind
    text = yaml.safe_dump(raw, sort_keys=False, width=110, default_flow_style=None)
    (folder / checkpoint.CONFIG).write_text(text, encoding="utf-8")
    checkpoint.save_weights(folder / WEIGHTS, model, bits=16)


def read(folder: Path) -> TableModel:
    """The tokenizer of a folder. Raises ConfigError or ModelError."""
    model = TableModel(load(config.Recipe, folder / checkpoint.CONFIG))
    checkpoint.load_weights(folder / WEIGHTS, model)
    return model.eval()


def is_there(folder: Path) -> bool:
    return (folder / checkpoint.CONFIG).is_file() and (folder / WEIGHTS).is_file()
