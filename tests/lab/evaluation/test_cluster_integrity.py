"""Kinds of motion before and after a tokenizer: what counts as kept apart."""

import numpy as np
import pytest

from sfms_robot.lab.evaluation.metrics import dtw
from sfms_robot.lab.evaluation.paper.cluster_integrity import Clusters, integrity, warped


def kinds(each: int = 5, seed: int = 0) -> np.ndarray:
    """(3 * each, 30, 4): three kinds of motion, each time at another pace and a little different."""
    rng, out = np.random.default_rng(seed), []
    for kind in range(3):
        for _ in range(each):
            phase = np.linspace(0, 2 * np.pi * rng.uniform(0.9, 1.1), 30)[:, None]
            shape = np.sin((kind + 1) * phase + np.arange(4)) * (kind + 1)
            out.append(shape + rng.normal(0, 0.05, (30, 4)))
    return np.stack(out)


def test_distances_are_those_of_the_metric():
    motion = kinds(2)
    found = warped(motion[:2], motion[2:5])
    assert found == pytest.approx(np.array([[dtw(a, b) for b in motion[2:5]] for a in motion[:2]]))


def test_kinds_are_found():
    labels = Clusters.of(kinds(), 3).labels
    assert [len(set(labels[rows])) for rows in np.split(np.arange(15), 3)] == [1, 1, 1] and len(set(labels)) == 3


def test_what_is_restored_as_it_was_keeps_all_of_it():
    motion = kinds()
    clusters = Clusters.of(motion, 3)
    kept = integrity(motion, motion, clusters)
    assert kept.separation == pytest.approx(1) and kept.silhouette > 0.5


def test_codes_that_pull_kinds_together_are_seen():
    motion = kinds()
    clusters, mean = Clusters.of(motion, 3), motion.mean(0)
    kept = integrity(motion, motion, clusters)
    rng = np.random.default_rng(1)
    pulled = integrity(mean + 0.3 * (motion - mean) + rng.normal(0, 0.3, motion.shape), motion, clusters)
    assert pulled.separation < 0.7 and pulled.silhouette < kept.silhouette - 0.2


def test_few_windows_make_few_clusters_or_none():
    assert len(Clusters.of(kinds(2)).medoids) == 3
    with pytest.raises(ValueError, match="3 windows make no clusters"):
        Clusters.of(kinds(1))
