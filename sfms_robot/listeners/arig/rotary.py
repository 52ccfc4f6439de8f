"""Rotary places of chunks (Su et al. 2021): how far keys and queries of the long range are turned."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from sfms_robot.frames import Doubles, Floats

BASE = 10_000.0


def rates(size: int) -> Doubles:
    """(size,) radians per chunk of a head's numbers; its halves are the two coordinates of each plane."""
    half = size // 2
    return np.tile(BASE ** (-np.arange(half) / half), 2)


def rotary(chunks: Doubles, size: int) -> Floats:
    """Chunk numbers (N,) -> cosines and sines (N, 2, size), those of the first half negative.

    Computed in double precision: after days of running the angles still differ by what the chunks do.
    """
    turns, signs = _planes(size)
    angles = chunks[:, None] * turns
    return np.stack([np.cos(angles), np.sin(angles) * signs], axis=1).astype(np.float32)


@lru_cache(maxsize=8)
def _planes(size: int) -> tuple[Doubles, Doubles]:
    """`rates`, and signs of the sines; not to be changed."""
    return rates(size), np.where(np.arange(size) < size // 2, -1.0, 1.0)
