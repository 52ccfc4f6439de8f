"""What a sparse code costs in bits, the places of its keyframes included."""

from __future__ import annotations

import math
from collections.abc import Sequence


def keyframe_bits(frames: int, k: int, codes: int) -> float:
    """One track of a window: which k of its frames (log2 of the binomial) and k codes out of `codes`."""
    if not 0 <= k <= frames:
        raise ValueError(f"{k} keyframes in {frames} frames")
    return math.log2(math.comb(frames, k)) + k * math.log2(codes)


def bits_per_window(frames: int, keyframes: Sequence[int], codes: Sequence[int]) -> float:
    """All tracks of a window, positions included; the number of keyframes is known to the reader."""
    return sum(keyframe_bits(frames, k, c) for k, c in zip(keyframes, codes, strict=True))
