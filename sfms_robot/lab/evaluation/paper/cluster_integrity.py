"""Do kinds of motion stay apart when they are written as codes? Figures 9 and 10 of the SFMS paper, in numbers.

The paper plots pairs of clusters before and after. Here windows are clustered by dynamic time warping, as in its figure
10, round medoids that lie as far from one another as can be ("highly distinctive"), and every tokenizer is asked: is a
window, written and read again, still nearer to its own medoid than to the next one (silhouette), and how far are the
medoids from one another, beside how far they were (separation: below 1 they have moved toward each other)?

W windows of T frames and C channels, K clusters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles

CLUSTERS: Final = 8
ROUNDS: Final = 20


@dataclass(frozen=True)
class Clusters:
    """Of windows: the number of each cluster's medoid (K,), and of the cluster that a window is in (W,)."""

    medoids: NDArray[np.intp]
    labels: NDArray[np.intp]

    @classmethod
    def of(cls, motion: Doubles, count: int = CLUSTERS) -> Clusters:
        """Of windows (W, T, C): medoids far from one another to begin with, then each the most central of its own.

        No more than half as many as there are windows. Raises ValueError for fewer than four windows.
        """
        if len(motion) < 4:
            raise ValueError(f"{len(motion)} windows make no clusters")
        between = warped(motion, motion)
        chosen = [int(between.sum(1).argmin())]
        while len(chosen) < min(count, len(motion) // 2):
            chosen.append(int(between[:, chosen].min(1).argmax()))
        medoids = np.array(chosen)
        for _ in range(ROUNDS):
            labels = between[:, medoids].argmin(1)
            own = [np.flatnonzero(labels == cluster) for cluster in range(len(medoids))]
            central = np.array([rows[between[np.ix_(rows, rows)].sum(1).argmin()] for rows in own])
            if (central == medoids).all():
                break
            medoids = central
        return cls(medoids, between[:, medoids].argmin(1))


@dataclass(frozen=True)
class Integrity:
    """Of windows written and read again.

    Attributes:
        silhouette: mean of (b - a) / max(a, b), a the distance to the own medoid, b to the nearest other, -1..1.
        separation: mean distance from medoid to medoid, over what it was.
    """

    silhouette: float
    separation: float


def integrity(restored: Doubles, motion: Doubles, clusters: Clusters) -> Integrity:
    """Of windows `restored` (W, T, C) of `motion` (W, T, C), both standardised; medoids are read again, too."""
    after = warped(restored, restored[clusters.medoids])  # (W, K)
    rows = np.arange(len(after))
    own = after[rows, clusters.labels]
    other = after.copy()
    other[rows, clusters.labels] = np.inf
    nearest = other.min(1)
    others = ~np.isin(rows, clusters.medoids)  # a medoid is at no distance of itself, whatever became of it
    widths = (nearest - own) / np.maximum(np.maximum(nearest, own), 1e-12)
    apart = ~np.eye(len(clusters.medoids), dtype=bool)
    before = warped(motion[clusters.medoids], motion[clusters.medoids])[apart].mean()
    return Integrity(float(widths[others].mean()), float(after[clusters.medoids][apart].mean() / before))


def warped(a: Doubles, b: Doubles) -> Doubles:
    """Dynamic time warping (`metrics.dtw`) of every window of a (W, T, C) with every one of b (V, T, C), (W, V)."""
    return np.stack([_to_each(one, b) for one in a])


def _to_each(one: Doubles, many: Sequence[Doubles] | Doubles) -> Doubles:
    """One window (T, C) with each of many (V, T, C), (V,); along anti-diagonals, all of them at once."""
    others = np.asarray(many)
    squares = (one**2).sum(1)[None, :, None] + (others**2).sum(2)[:, None, :]
    cost = np.maximum(squares - 2 * np.einsum("tc,vuc->vtu", one, others, optimize=True), 0.0)  # (V, T, T)
    count, rows, columns = cost.shape
    before, last = (np.full((count, rows + 1), np.inf) for _ in range(2))  # of diagonals d - 2 and d - 1, by row + 1
    before[:, 0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        best = np.minimum(np.minimum(last[:, i], last[:, i + 1]), before[:, i])
        now = np.full((count, rows + 1), np.inf)
        now[:, i + 1] = cost[:, i, diagonal - i] + best
        before, last = last, now
    return np.asarray(np.sqrt(last[:, rows]), np.float64)
