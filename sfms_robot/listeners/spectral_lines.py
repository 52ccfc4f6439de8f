"""Stationary motion as a sum of lines: Shinozuka's spectral representation, by which sway and idle motion are drawn.

A line a cos 2 pi f t + b sin 2 pi f t is one cosine, |(a, b)| cos(2 pi f t - atan2(b, a)): as such it is kept. The sum
is a function of time alone: any frame of the future is known, and nothing adds up. It sets in over the first `EASE_S`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles

EASE_S: Final = 3.0


def as_cosines(a: Doubles, b: Doubles) -> tuple[Doubles, Doubles]:
    """Size and phase [rad] of lines with the factors a of the cosine and b of the sine."""
    return np.hypot(a, b), np.arctan2(b, a)


def sum_of_lines(times_s: NDArray[np.floating], frequency: Doubles, size: Doubles, phase: Doubles) -> Doubles:
    """Lines (..., L, K), frequency [rad/s], at times (T, 1) of all, (..., T, 1) of each, or (..., T, K), where every
    column goes by a clock of its own -> (..., T, K).
    """
    turn = times_s[..., None, :] * frequency[..., None, :, :]  # (..., T, L, K)
    turn -= phase[..., None, :, :]
    waves: Doubles = size[..., None, :, :] * np.cos(turn, out=turn)
    return np.asarray(waves.sum(-2))


def set_in(times_s: NDArray[np.floating]) -> Doubles:
    """0 before a stream begins, 1 from `EASE_S` on, smooth in between."""
    begun = np.minimum(np.maximum(times_s / EASE_S, 0), 1)
    return np.asarray(begun**2 * (3 - 2 * begun))
