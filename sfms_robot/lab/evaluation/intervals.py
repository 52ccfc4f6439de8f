"""Confidence intervals of figures over people: 95 %, for other people of the same kind.

Whole people are drawn with replacement, not their minutes or their nods, which depend on one another. For the bootstrap
(`estimates`) a figure is a function of sums over people, so a person is one row of sums, computed once for all draws.
Most sums are pairs: a count and its base. Metrics of the papers that pool all clips are not such functions; `bootstrap`
evaluates these again for each of fewer draws.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles
from sfms_robot.lab.corpora.clips import Dyad, series

LEVEL: Final = 0.95
DRAWS: Final = 2000
_DEFINED: Final = 0.9  # share of the draws in which a figure has to be defined to have an interval
LEAST_SEEDS: Final = 3  # least number of trainings for a verdict on a paper's statement
_LEAST_PEOPLE: Final = 3

Sums = dict[str, Doubles]  # of one person: name -> numbers (K,)
Totals = Mapping[str, Doubles]  # of R sets of people: name -> (R, K)
Figure = Callable[[Totals], Doubles]  # -> (R,), NaN where it is not defined
Chosen = NDArray[np.intp]  # places of clips


@dataclass(frozen=True)
class Estimate:
    """A figure and its interval; None where it is not defined, or there are too few people."""

    value: float | None
    interval: tuple[float, float] | None


def ends(values: Doubles) -> Doubles:
    """Return the ends (2, ...) of the interval of `LEVEL` of draws (R, ...)."""
    return np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Return a figure rounded for a report; None if there is no figure, or if it is not finite."""
    return None if value is None or not np.isfinite(value) else round(float(value), digits)


def mean_interval(values: Doubles) -> list[float | None]:
    """Return the interval of the mean of values (K,), for other values of the same kind."""
    drawn = values[np.random.default_rng(0).integers(len(values), size=(DRAWS, len(values)))]
    return [rounded(end) for end in ends(drawn.mean(axis=1)).tolist()]


def finite(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row for JSON: None in place of numbers that are not finite."""
    return {key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in row.items()}


def draw_people(count: int, seed: int, draws: int = DRAWS) -> NDArray[np.int64]:
    """Draw sets of `count` people with replacement; return how often each is in each set (draws, count)."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), draws)


def added(parts: Iterable[Sums]) -> Sums:
    """Return the sum of each name over all parts."""
    total: Sums = {}
    for part in parts:
        for name, numbers in part.items():
            total[name] = total[name] + numbers if name in total else np.asarray(numbers, np.float64)
    return total


def estimates(
    figures: Mapping[str, Figure], people: Sequence[Sums], seed: int, draws: int = DRAWS
) -> dict[str, Estimate]:
    """Return every figure of all people with its interval (percentiles over `draws` sets of as many people).

    The sums of all people have the same names. The same seed draws the same sets for any figures.
    """
    count = len(people)
    weights = np.concatenate([np.ones((1, count)), draw_people(count, seed, draws)])  # all people once, then the draws
    totals = {name: weights @ np.stack([person[name] for person in people]) for name in people[0]}

    def estimate(values: Doubles) -> Estimate:
        value = float(values[0]) if np.isfinite(values[0]) else None
        defined = values[1:][np.isfinite(values[1:])]
        if value is None or count < 2 or len(defined) < _DEFINED * draws:
            return Estimate(value, None)
        low, high = ends(defined).tolist()
        return Estimate(value, (low, high))

    with np.errstate(divide="ignore", invalid="ignore"):
        return {name: estimate(figure(totals)) for name, figure in figures.items()}


def quotient(name: str) -> Figure:
    """Return the figure of a pair: the count over its base."""
    return lambda totals: totals[name][:, 0] / totals[name][:, 1]


def ratio(above: str, below: str) -> Figure:
    """Return the figure of two pairs: one quotient over the other."""
    return lambda totals: quotient(above)(totals) / quotient(below)(totals)


def _shares(histograms: Doubles) -> Doubles:
    return np.asarray(np.cumsum(histograms, axis=1) / histograms.sum(axis=1, keepdims=True))


def distance(one: str, other: str) -> Figure:
    """Return Kolmogorov and Smirnov's figure of two histograms: the largest difference of their cumulative shares."""
    return lambda totals: np.asarray(np.abs(_shares(totals[one]) - _shares(totals[other])).max(axis=1))


def median(name: str, middles: Doubles) -> Figure:
    """Return the median of a histogram whose bins have these middles (K,)."""

    def figure(totals: Totals) -> Doubles:
        shares = _shares(totals[name])
        return np.where(np.isnan(shares[:, -1]), np.nan, middles[np.argmax(shares >= 0.5, axis=1)])

    return figure


# --- metrics that pool all clips ------------------------------------------------------------------------------------


def people_of(dyads: Sequence[Dyad], lengths: Sequence[int], frames: int) -> list[str]:
    """Return the listener of each clip of `frames` frames, cut out of motions of these lengths.

    In composed dyads this is the seat in a series of meetings, in others the dyad itself.
    """

    def person(dyad: Dyad) -> str:
        meeting, _, rest = dyad.name.partition("_")
        seat, _, start = rest.partition("_")
        return f"{series(meeting)} {seat}" if start.isdigit() else dyad.name

    return [person(dyad) for dyad, length in zip(dyads, lengths, strict=True) for _ in range(length // frames)]


def bootstrap(
    score: Callable[[Chosen], Mapping[str, Any]],
    people: Sequence[str],
    runs: Sequence[int] = (),
    seed: int = 0,
    draws: int = 200,
) -> dict[str, Doubles]:
    """Return each figure of `score(clips)` in `draws` sets of people (R,), NaN where it is not finite.

    The same seed draws the same people for any score, so two results can be subtracted draw by draw. Empty for fewer
    than three people.

    Args:
        score: Figures of the clips at these places, which may repeat.
        people: The listener of each clip.
        runs: The training of each clip's motion, drawn with replacement too; empty: one training.
        seed: Seed of the draws.
        draws: Number of sets.
    """
    names, who = np.unique(np.asarray(people), return_inverse=True)
    kinds, run = np.unique(np.asarray(runs if len(runs) else [0] * len(people)), return_inverse=True)
    if len(names) < _LEAST_PEOPLE:
        return {}
    clips = [[np.flatnonzero((who == one) & (run == kind)) for kind in range(len(kinds))] for one in range(len(names))]
    of_people, of_runs = (np.random.default_rng((seed, number)) for number in range(2))
    found = []
    for _ in range(draws):
        drawn, trained = (rng.integers(n, size=n) for rng, n in ((of_people, len(names)), (of_runs, len(kinds))))
        found.append(score(np.concatenate([clips[one][kind] for one in drawn for kind in trained])))
    return {name: np.array([row[name] for row in found], np.float64) for name in found[0]}


def intervals(draws: Mapping[str, Doubles]) -> dict[str, tuple[float, float]]:
    """Return the interval of each figure of `bootstrap` that nearly all draws define."""
    found = {}
    for name, values in draws.items():
        defined = values[np.isfinite(values)]
        if len(defined) >= _DEFINED * len(values):
            low, high = ends(defined).round(6).tolist()
            found[name] = (low, high)
    return found


# --- what a paper states --------------------------------------------------------------------------------------------

Verdict = Literal["holds", "does not hold", "open"]


def verdict(interval: tuple[float, float] | None, *, comparable: bool = True) -> Verdict:
    """Return the verdict on a paper's statement that a figure with this interval is above 0.

    It holds if the whole interval is above 0, and does not hold if the whole interval is at or below 0. Otherwise it is
    open, also without an interval, or if the compared figures are not `comparable`.
    """
    if interval is None or not comparable:
        return "open"
    return "holds" if interval[0] > 0 else "does not hold" if interval[1] <= 0 else "open"
