"""Quantiles of any number of values in fixed memory: exact while they are few, within one percent after that."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

_EXACT: Final = 4096  # values that are kept exactly
_RATIO: Final = 1.02  # ratio of the ends of a bin, so that its middle is within one percent
_LEAST: Final = 1e-6  # smaller values count as 0
_BINS: Final = 2048  # up to 1e11


class Quantiles:
    """Quantiles of values that are added one at a time.

    Once there are many values, only their counts in bins are kept; the ends of the bins grow by two percent each.
    One thread adds values; any thread may read at the same time.
    """

    def __init__(self) -> None:
        self._values: list[float] = []
        self._bins = np.zeros(0, np.int64)
        self._largest = 0.0
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, value: float) -> None:
        """Add a value, which may not be negative or NaN."""
        self._largest = max(self._largest, value)
        if len(self._bins):
            self._bins[_bin(value)] += 1
        else:
            self._values.append(value)
            if len(self._values) > _EXACT:
                self._bins = np.bincount([_bin(each) for each in self._values], minlength=_BINS)
                self._values = []
        self._count += 1  # last, so that other threads find all values that are counted

    def at(self, percent: float) -> float:
        """Return the value that `percent` of all do not exceed; 100: the largest. Raises ValueError without values."""
        if not self._count:
            raise ValueError("no value was taken")
        values = self._values  # read before the bins, because `add` sets the bins before it clears the values
        if not len(self._bins):
            return float(np.percentile(values, percent))
        if percent >= 100.0:
            return self._largest
        place = int(np.searchsorted(np.cumsum(self._bins), percent / 100.0 * self._count, side="left"))
        middle = _LEAST * _RATIO ** (place - 0.5) if place else 0.0
        return min(middle, self._largest)

    def report(self, **percent: float) -> dict[str, float | None]:
        """Return {"p50": ..., ...}, rounded to three digits after the point; every value is None without values."""
        if not self._count:
            return dict.fromkeys(percent)
        return {name: round(self.at(each), 3) for name, each in percent.items()}


def _bin(value: float) -> int:
    return 0 if value < _LEAST else min(_BINS - 1, 1 + int(math.log(value / _LEAST) / math.log(_RATIO)))
