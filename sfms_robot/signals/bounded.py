"""Least squares with a floor and a ceiling for every unknown, many right-hand sides at once."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfms_robot.frames import Doubles

STEPS: Final = 400
_SETTLED: Final = 1e-8  # largest change of an unknown in one step


def bounded_least_squares(matrix: Doubles, wanted: Doubles, low: Doubles, high: Doubles) -> Doubles:
    """The x (N, n) with low <= x <= high that makes ||matrix x - wanted||^2 smallest, for each row of `wanted` (N, m).

    matrix (m, n) of full column rank (add rows of a ridge where it is not); low, high (n,) or (N, n). Accelerated
    projected gradient with restarts (O'Donoghue and Candes 2015): every step is one matrix product for all N.
    """
    gram = matrix.T @ matrix
    target = wanted @ matrix  # (N, n)
    step = 1.0 / float(np.linalg.eigvalsh(gram)[-1])
    here: Doubles = np.clip(np.linalg.solve(gram, target.T).T, low, high)
    ahead, momentum = here, np.ones((len(wanted), 1))
    for _ in range(STEPS):
        slope = ahead @ gram - target
        there: Doubles = np.clip(ahead - step * slope, low, high)
        moved = there - here
        uphill = (slope * moved).sum(axis=1, keepdims=True) > 0
        momentum = np.where(uphill, 1.0, momentum)
        following = (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        ahead = there + np.where(uphill, 0.0, (momentum - 1.0) / following) * moved
        here, momentum = there, following
        if np.abs(moved).max(initial=0.0) < _SETTLED:
            break
    return here
