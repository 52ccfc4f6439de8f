"""Logistic regression with a ridge, by Newton's method: few inputs, many rows, no options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import Doubles, Floats

NEWTON_STEPS: Final = 8
_ROWS: Final = 65_536  # at once


@dataclass(frozen=True)
class Logistic:
    """log-odds = intercept + inputs @ weights (K,)."""

    intercept: float
    weights: Doubles

    def log_odds(self, inputs: Floats) -> Doubles:
        """(N, K) -> (N,)."""
        return np.asarray(self.intercept + inputs @ self.weights, np.float64)


def fit(
    inputs: Floats, happens: Doubles, counts: Doubles, offset: Doubles | None = None, ridge: float = 10.0
) -> Logistic:
    """Maximum likelihood of `happens` (N,) 0 or 1, each row counting `counts` (N,) times, less ridge / 2 * |weights|^2.

    `offset` (N,) is added to the log-odds and not fitted. The intercept is free.
    """
    rows, columns = inputs.shape
    share = float((happens * counts).sum() / counts.sum())
    at = np.r_[np.log(share / (1 - share)), np.zeros(columns)]
    given = np.zeros(rows) if offset is None else offset
    penalty = np.r_[0.0, np.full(columns, ridge)]
    before, fit_before = at, -np.inf
    for _ in range(NEWTON_STEPS):
        goodness, slope, bend = _at(at, inputs, happens, counts, given, penalty)
        while not goodness >= fit_before:  # too far: whoever starts at the mean may overshoot
            at = (at + before) / 2
            goodness, slope, bend = _at(at, inputs, happens, counts, given, penalty)
        before, fit_before = at, goodness - 1e-9 * abs(goodness)
        at = at + np.linalg.solve(bend, slope)
    return Logistic(float(at[0]), at[1:])


def _at(
    at: Doubles, inputs: Floats, happens: Doubles, counts: Doubles, offset: Doubles, penalty: Doubles
) -> tuple[float, Doubles, Doubles]:
    """Penalised log-likelihood, its gradient and its negative curvature."""
    goodness = -0.5 * float(penalty @ at**2)
    slope, bend = -penalty * at, np.diag(penalty + 1e-9)
    for start in range(0, len(inputs), _ROWS):
        part = slice(start, start + _ROWS)
        x = np.concatenate([np.ones((len(inputs[part]), 1)), inputs[part]], axis=1)
        odds = np.clip(x @ at + offset[part], -40, 40)
        chance = 1.0 / (1.0 + np.exp(-odds))
        goodness += float(counts[part] @ (happens[part] * odds - np.log1p(np.exp(odds))))
        slope += x.T @ (counts[part] * (happens[part] - chance))
        bend += x.T @ (x * (counts[part] * chance * (1 - chance))[:, None])
    return goodness, slope, bend
