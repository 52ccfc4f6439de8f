"""Rotary places of chunks (Su et al. 2021): how far keys and queries of the long range are turned."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles, Floats

BASE = 10_000.0


def rotary(chunks: NDArray[np.integer], size: int) -> Floats:
    """Return cosines and sines (N, 2, size) of chunk numbers (N,), sines of the first half negative.

    The halves are the two coordinates of each plane. Computed in double precision: after days of running the angles of
    two chunks still differ.
    """
    turns, signs = _planes(size)
    angles = chunks[:, None] * turns
    return np.stack([np.cos(angles), np.sin(angles) * signs], axis=1).astype(np.float32)


@lru_cache(maxsize=8)
def _planes(size: int) -> tuple[Doubles, Doubles]:
    """Return radians per chunk (size,), and signs of the sines; not to be changed."""
    half = size // 2
    return np.tile(BASE ** (-np.arange(half) / half), 2), np.where(np.arange(size) < half, -1.0, 1.0)
