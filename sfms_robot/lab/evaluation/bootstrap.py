"""Figures over people, each with the interval in which it would lie had other people been met.

People are drawn anew with replacement, not their minutes or their nods, which hang together. A figure is a function of
sums over people, so a person is a row of sums that is made once, however often he is drawn. Most sums are pairs: how
many, of how much.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import Doubles

LEVEL: Final = 0.95
DRAWS: Final = 2000
_DEFINED: Final = 0.9  # share of the draws in which a figure has to exist to have an interval

Sums = dict[str, Doubles]  # of one person: name -> numbers (K,)
Totals = Mapping[str, Doubles]  # of R sets of people: name -> (R, K)
Figure = Callable[[Totals], Doubles]  # -> (R,), NaN where there is nothing to tell it by


@dataclass(frozen=True)
class Estimate:
    """A figure, and its interval: None where it cannot be told, or by too few people."""

    value: float | None
    interval: tuple[float, float] | None


def added(parts: Iterable[Sums]) -> Sums:
    """The sum of each name over all parts."""
    total: Sums = {}
    for part in parts:
        for name, numbers in part.items():
            total[name] = total[name] + numbers if name in total else np.asarray(numbers, np.float64)
    return total


def estimates(
    figures: Mapping[str, Figure], people: Sequence[Sums], seed: int, draws: int = DRAWS
) -> dict[str, Estimate]:
    """Every figure of all people, with its 95 % interval (percentiles over `draws` sets of as many people).

    People have the same names. The same seed draws the same sets, whatever the figures are.
    """
    count = len(people)
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(count, np.full(count, 1 / count), draws)
    weights = np.concatenate([np.ones((1, count)), drawn])  # everybody once, then the draws
    totals = {name: weights @ np.stack([person[name] for person in people]) for name in people[0]}
    with np.errstate(divide="ignore", invalid="ignore"):
        return {name: _estimate(figure(totals), count) for name, figure in figures.items()}


def _estimate(values: Doubles, people: int) -> Estimate:
    """From the figure of everybody, and of every draw behind it."""
    value = float(values[0]) if np.isfinite(values[0]) else None
    defined = values[1:][np.isfinite(values[1:])]
    if value is None or people < 2 or len(defined) < _DEFINED * (len(values) - 1):
        return Estimate(value, None)
    low, high = np.quantile(defined, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(value, (float(low), float(high)))


def quotient(name: str) -> Figure:
    """Of a pair: how many over of how much."""
    return lambda totals: totals[name][:, 0] / totals[name][:, 1]


def ratio(above: str, below: str) -> Figure:
    """Of two pairs: one quotient over the other."""
    return lambda totals: quotient(above)(totals) / quotient(below)(totals)


def distance(one: str, other: str) -> Figure:
    """Kolmogorov and Smirnov's, of two histograms: the largest difference of their cumulative shares."""

    def figure(totals: Totals) -> Doubles:
        shares = [np.cumsum(totals[name], axis=1) / totals[name].sum(axis=1, keepdims=True) for name in (one, other)]
        return np.asarray(np.abs(shares[0] - shares[1]).max(axis=1))

    return figure


def median(name: str, middles: Doubles) -> Figure:
    """Of a histogram whose bins have these middles (K,)."""

    def figure(totals: Totals) -> Doubles:
        shares = np.cumsum(totals[name], axis=1) / totals[name].sum(axis=1, keepdims=True)
        return np.where(np.isnan(shares[:, -1]), np.nan, middles[np.argmax(shares >= 0.5, axis=1)])

    return figure
