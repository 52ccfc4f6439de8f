"""Curves over time as sums of hats: piecewise linear between knots, on a grid that is logarithmic from 0.2 s up.

`hats` gives the weights of the knots, from which a linear model learns the values at the knots; beyond the last knot
that one alone counts, so `math.inf` is "long ago". NaN is nothing: all weights 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.frames import Doubles

SOFT_S: Final = 0.2


def log_time(seconds: ArrayLike) -> Doubles:
    return np.asarray(np.log1p(np.asarray(seconds, np.float64) / SOFT_S), np.float64)


def hats(seconds: Doubles, knots_s: Sequence[float]) -> Doubles:
    """(N,) -> (N, K): weights of the two neighbouring knots, adding up to 1."""
    knots = log_time(knots_s)
    at = log_time(np.minimum(seconds, knots_s[-1]))
    place = np.interp(at, knots, np.arange(len(knots)))
    weights = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(len(knots))))
    return np.asarray(np.where(np.isnan(seconds)[:, None], 0.0, weights), np.float64)
