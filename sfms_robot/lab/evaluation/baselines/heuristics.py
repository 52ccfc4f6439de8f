"""Listeners that learn nothing: what tables 1 and 2 measure everybody against.

Random, Mime and MeanFr as the REACT challenge's `run_baselines` has them (baseline_react2023 @ c5a8ff85),
Median as Learning2Listen names it. Each gives (N, K, T, D): K times the same but for Random.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import BLENDSHAPES, SPACE_CHANNELS, Doubles


@dataclass(frozen=True)
class Heuristic:
    """What a heuristic may look at.

    Attributes:
        train: (M, T, D) listeners of the training set.
        speaker: (N, T, D) of the clips to answer.
        space: of the motion: blendshapes lie in 0..1, other channels in the range that the training set shows.
        samples: K.
        seed: of Random.
    """

    train: Doubles
    speaker: Doubles
    space: str
    samples: int
    seed: int = 0


def random(given: Heuristic) -> Doubles:
    """Every number by itself, evenly from its channel's range: FRVar 1/12, FRDiv and FRDvs 1/6 in units of it."""
    shapes = np.array([channel in BLENDSHAPES for channel in SPACE_CHANNELS[given.space]])
    low = np.where(shapes, 0.0, given.train.min(axis=(0, 1)))
    high = np.where(shapes, 1.0, given.train.max(axis=(0, 1)))
    n, t, d = given.speaker.shape
    return np.random.default_rng(given.seed).uniform(low, high, (n, given.samples, t, d))


def median(given: Heuristic) -> Doubles:
    """The median frame of the training set."""
    return _still(given, np.median(given.train, axis=(0, 1)))


def mean_frame(given: Heuristic) -> Doubles:
    """MeanFr: the mean frame of the training set."""
    return _still(given, given.train.mean(axis=(0, 1)))


def mime(given: Heuristic) -> Doubles:
    """Mime: what the speaker does."""
    return _repeated(given, given.speaker)


def _still(given: Heuristic, frame: Doubles) -> Doubles:
    return _repeated(given, np.broadcast_to(frame, given.speaker.shape))


def _repeated(given: Heuristic, clips: Doubles) -> Doubles:
    """(N, T, D) -> (N, K, T, D)."""
    return np.repeat(clips[:, None], given.samples, axis=1)


HEURISTICS: Final[Mapping[str, Callable[[Heuristic], Doubles]]] = {
    "Random": random,
    "Median": median,
    "Mime": mime,
    "MeanFr": mean_frame,
}
