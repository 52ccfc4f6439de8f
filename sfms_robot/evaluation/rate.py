"""What a code costs and how well it is used: bits, perplexity, and the curve of error over bits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.adaptive import fewest, prefixes
from sfms_robot.listeners.sfms.model import Tokenizer


def keyframe_bits(frames: int, k: int, codes: int) -> float:
    """One track of a window: which k of its frames (log2 of the binomial) and k codes out of `codes`."""
    if not 0 <= k <= frames:
        raise ValueError(f"{k} keyframes in {frames} frames")
    return math.log2(math.comb(frames, k)) + k * math.log2(codes)


def bits_per_window(frames: int, keyframes: Sequence[int], codes: Sequence[int]) -> float:
    """All tracks of a window, positions included; the number of keyframes is known to the reader."""
    return sum(keyframe_bits(frames, k, c) for k, c in zip(keyframes, codes, strict=True))


def adaptive_bits(frames: int, k: Tensor, codes: Sequence[int], most: int) -> Tensor:
    """Bits (B,) of windows with k (B, G) keyframes: those of `bits_per_window` and log2(most) a track for k itself."""
    table = torch.tensor([[keyframe_bits(frames, n, c) for c in codes] for n in range(most + 1)], dtype=torch.float64)
    own = table[k, torch.arange(k.shape[1])].sum(1)
    return own + k.shape[1] * math.log2(most)


@dataclass(frozen=True)
class Use:
    """How a group's codebook is used.

    Attributes:
        codes: size; keyframes: how many were looked at.
        used: share of codes that occur. With fewer keyframes than codes it cannot reach 1.
        perplexity: 2 to the entropy of the codes: as many equally frequent ones would be as hard to guess.
    """

    codes: int
    keyframes: int
    used: float
    perplexity: float


def codebook_use(tokens: Tensor, codes: Sequence[int]) -> list[Use]:
    """Use of each group's codes in tokens (..., G)."""
    found = []
    for group, size in enumerate(codes):
        own = tokens[..., group].flatten()
        counts = torch.bincount(own[own > 0] - 1, minlength=size).double()
        share = counts[counts > 0] / counts.sum()
        perplexity = float(2 ** -(share * share.log2()).sum()) if len(share) else 0.0
        found.append(Use(size, int(counts.sum()), len(share) / size, perplexity))
    return found


@dataclass(frozen=True)
class Point:
    """One point of a rate-distortion curve; errors are mean squared, standardised, over `windows` windows.

    `tolerance` is None where every track has the same k.
    """

    windows: int
    tolerance: float | None
    mean_k: float
    bits: float
    mse: float


@torch.no_grad()
def rate_distortion(
    tokenizer: Tokenizer, motion: Tensor, codes: Sequence[int], tolerances: Sequence[float], most: int = 12
) -> list[dict[str, Any]]:
    """Nested prefixes of motion (B, T, C), as plain rows: every fixed k up to `most`, then every tolerance.

    The adaptive points decode the very masks `encode_adaptive` gives and pay for telling each track's k.
    """
    tried = prefixes(tokenizer, motion, most)
    frames, groups = motion.shape[1], len(tokenizer.member)
    share = tokenizer.member.sum(1) / tokenizer.member.sum()
    points = [
        Point(len(motion), None, k, bits_per_window(frames, [k] * groups, codes), float(error))
        for k, error in enumerate((tried.errors @ share).mean(0), start=1)
    ]
    encoded = tokenizer.quantizer.encode(motion)
    for tolerance in tolerances:
        k = fewest(tried.errors, tolerance)
        error = ((tokenizer.inpaint(encoded, tried.masks(k, frames)) - motion) ** 2).mean()
        bits = adaptive_bits(frames, k, codes, most).mean()
        points.append(Point(len(motion), tolerance, float(k.float().mean()), float(bits), float(error)))
    return [asdict(point) for point in points]
