"""Intervals of a table's figures over the people in its clips: each is left out once (the jackknife).

Most of the papers' metrics pool what all clips hold, so they are no means that could be drawn from; leaving one person
out at a time asks each of them as often as there are people, where a bootstrap would ask thousands of times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student_t

from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.splits import series

LEVEL: Final = 0.95
LEAST: Final = 3  # people, below which no interval is told
Chosen = NDArray[np.intp]  # places of clips


def person_of(dyad: Dyad) -> str:
    """Who listens: of composed dyads the seat in a series of meetings, of others the dyad itself."""
    meeting, _, rest = dyad.name.partition("_")
    seat, _, start = rest.partition("_")
    return f"{series(meeting)} {seat}" if start.isdigit() else dyad.name


def people_of(dyads: Sequence[Dyad], lengths: Sequence[int], frames: int) -> list[str]:
    """Who listens in each clip of so many frames that is cut out of motions of these lengths."""
    return [person_of(dyad) for dyad, length in zip(dyads, lengths, strict=True) for _ in range(length // frames)]


def intervals(score: Callable[[Chosen], Mapping[str, Any]], people: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Of every figure that `score` tells of some clips: its 95 % interval; nothing of those that are no number.

    Nothing at all of fewer than three people.
    """
    who = np.asarray(people)
    everybody = np.unique(who)
    if len(everybody) < LEAST:
        return {}
    whole = score(np.arange(len(who)))
    parts = [score(np.flatnonzero(who != one)) for one in everybody]
    wide = float(student_t.ppf((1 + LEVEL) / 2, len(parts) - 1))
    found = {}
    for name, value in whole.items():
        without = np.array([part[name] for part in parts], np.float64)
        if value is None or not np.isfinite(without).all() or not np.isfinite(value):
            continue
        reach = wide * float(np.sqrt((len(parts) - 1) * np.var(without)))
        found[name] = (float(value) - reach, float(value) + reach)
    return found
