"""Metrics of the Learning2Listen line: Frechet distances, variance, Shannon index, RPCC, STS.

Clips are (N, T, D), or (T, D) for one. Predecessors disagree under the same names, so the definition is an argument or
part of the name. Sources: Boese0601/Dyadic-Interaction-Modeling @ 9fc92f72, sanjayss34/lm-listener @ 53ce4ecc,
evonneng/learning2listen @ a0825d58 (definitions only). Float64 throughout.
"""

from __future__ import annotations

import logging
import warnings
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.cluster.vq import kmeans2, vq

from sfms_robot.frames import Doubles

SID_EPS: Final = 1e-6  # inside the logarithm, as in DIM
STS_DT: Final = 0.1
KMEANS_ROUNDS: Final = 100  # scipy's 10 stop well before the centres do
_log = logging.getLogger(__name__)


def _clips(x: ArrayLike) -> Doubles:
    array = np.asarray(x, dtype=np.float64)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3:
        raise ValueError(f"clips are (N, T, D) or (T, D), got shape {array.shape}")
    return array


def _alike(*clips: ArrayLike) -> list[Doubles]:
    arrays = [_clips(one) for one in clips]
    if len({array.shape for array in arrays}) != 1:
        raise ValueError(f"clips of one shape are needed, got {', '.join(str(array.shape) for array in arrays)}")
    return arrays


def frechet_distance(a: ArrayLike, b: ArrayLike, pool: bool = True) -> float:
    """FD between the frames of two sets of clips: |mu|^2 + tr(Sa) + tr(Sb) - 2 tr sqrt(Sa Sb), covariances with ddof 1.

    `pool` True takes all clips as one distribution, False is the mean of the per-clip values (DIM, lm-listener). The
    root is taken through symmetric eigenvalues, which never turns complex. Fewer frames than channels make a singular
    covariance: that is logged.
    """
    x, y = _clips(a), _clips(b)
    if x.shape[-1] != y.shape[-1]:
        raise ValueError(f"{x.shape[-1]} channels against {y.shape[-1]}")
    if not pool:
        if len(x) != len(y):
            raise ValueError(f"{len(x)} clips against {len(y)}: per-clip values need pairs")
        return float(np.mean([_frechet(one, other) for one, other in zip(x, y, strict=True)]))
    return _frechet(x.reshape(-1, x.shape[-1]), y.reshape(-1, y.shape[-1]))


def _frechet(x: Doubles, y: Doubles) -> float:
    if min(len(x), len(y)) <= x.shape[1]:
        _log.warning("FD of %d frames in %d dimensions: the covariance is singular", min(len(x), len(y)), x.shape[1])
    gap = x.mean(axis=0) - y.mean(axis=0)
    sx, sy = np.atleast_2d(np.cov(x, rowvar=False)), np.atleast_2d(np.cov(y, rowvar=False))
    values, vectors = np.linalg.eigh(sx)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    cross = np.linalg.eigvalsh(root @ sy @ root)
    return float(gap @ gap + np.trace(sx) + np.trace(sy) - 2 * np.sqrt(np.maximum(cross, 0.0)).sum())


def paired_frechet_distance(target: ArrayLike, pred: ArrayLike, speaker: ArrayLike, pool: bool = True) -> float:
    """P-FD: FD of frames that hold speaker and listener side by side."""
    person = _clips(speaker)
    truth, guess = (np.concatenate([person, _clips(one)], axis=-1) for one in (target, pred))
    return frechet_distance(truth, guess, pool)


def l2(target: ArrayLike, pred: ArrayLike, definition: Literal["norm", "mse"] = "norm", start: int = 0) -> float:
    """Error between clips.

    "norm": distance over all channels, mean over clips and frames from `start` on (learning2listen starts at 32).
    "mse": mean squared error (lm-listener, DIM).
    """
    truth, guess = _alike(target, pred)
    gap = truth[:, start:] - guess[:, start:]
    if definition == "norm":
        return float(np.linalg.norm(gap, axis=-1).mean())
    if definition == "mse":
        return float((gap**2).mean())
    raise ValueError(f"definition {definition!r} is not one of norm, mse")


def variance(x: ArrayLike, definition: Literal["flat", "time", "sum"] = "flat") -> float:
    """Three numbers of one name: "flat" pools clips, frames and channels (DIM); "time" is the variance over time per
    channel and clip, averaged (lm-listener); "sum" adds the pooled variances of the channels (DIM's other one)."""
    clips = _clips(x)
    if definition == "flat":
        return float(clips.var())
    if definition == "time":
        return float(clips.var(axis=1).mean())
    if definition == "sum":
        return float(clips.reshape(-1, clips.shape[-1]).var(axis=0).sum())
    raise ValueError(f"definition {definition!r} is not one of flat, time, sum")


def shannon_index(
    pred: ArrayLike,
    reference: ArrayLike,
    k: int,
    unit: Literal["nats", "bits"] = "nats",
    eps: float = SID_EPS,
    centres: ArrayLike | None = None,
    per_clip: bool = False,
) -> float:
    """SI: entropy of which of `k` clusters of the reference frames the predicted frames fall into.

    Clusters are k-means of the pooled reference frames with a fixed seed, unless `centres` (k, D) are given: those of
    another k-means differ, so numbers compare only with the same centres.
    """
    guess, truth = _clips(pred), _clips(reference)
    found = cluster_centres(truth, k) if centres is None else np.asarray(centres, dtype=np.float64)
    if found.shape != (k, truth.shape[-1]):
        raise ValueError(f"centres are {found.shape}, not ({k}, {truth.shape[-1]})")
    sets = list(guess) if per_clip else [guess.reshape(-1, guess.shape[-1])]
    return float(np.mean([_entropy(vq(one, found)[0], k, unit, eps) for one in sets]))


def cluster_centres(reference: ArrayLike, k: int) -> Doubles:
    """(k, D) k-means of the pooled frames of clips, with a fixed seed.

    Raises ValueError for fewer frames than k, or frames of which too many are the same.
    """
    clips = _clips(reference)
    frames = clips.reshape(-1, clips.shape[-1])
    if len(frames) < k:
        raise ValueError(f"{len(frames)} frames make no {k} clusters")
    with warnings.catch_warnings(), np.errstate(invalid="raise"):
        warnings.simplefilter("ignore", UserWarning)  # a cluster that nothing falls into counts 0 in the entropy
        try:
            found, _ = kmeans2(frames, k, iter=KMEANS_ROUNDS, minit="++", seed=np.random.default_rng(0))
        except FloatingPointError:
            raise ValueError(f"{len(frames)} frames differ too little to make {k} clusters") from None
    return np.asarray(found, np.float64)


def _entropy(labels: ArrayLike, k: int, unit: str, eps: float) -> float:
    share = np.bincount(np.asarray(labels), minlength=k) / len(np.asarray(labels))
    share = share[share > 0]
    log = {"nats": np.log, "bits": np.log2}.get(unit)
    if log is None:
        raise ValueError(f"unit {unit!r} is not one of nats, bits")
    return float(-(share * log(share + eps)).sum())


def rpcc_flat(target: ArrayLike, pred: ArrayLike, speaker: ArrayLike) -> float:
    """DIM's RPCC: |corr(target, speaker) - corr(pred, speaker)|, everything flattened into one vector."""
    truth, guess, person = (one.ravel() for one in _alike(target, pred, speaker))
    return float(abs(np.corrcoef(truth, person)[0, 1] - np.corrcoef(guess, person)[0, 1]))


def rpcc_channels(target: ArrayLike, pred: ArrayLike, speaker: ArrayLike) -> float:
    """The same per clip and channel, averaged before the difference; constant channels are left out of the mean."""
    truth, guess, person = _alike(target, pred, speaker)
    return float(abs(_mean_pearson(truth, person) - _mean_pearson(guess, person)))


def _mean_pearson(a: Doubles, b: Doubles) -> float:
    x, y = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    usable = (np.ptp(a, axis=1) > 0) & (np.ptp(b, axis=1) > 0)
    norm = np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1))
    values = (x * y).sum(axis=1)[usable] / norm[usable]
    return float(values.mean()) if len(values) else 0.0


def sts(target: ArrayLike, pred: ArrayLike) -> float:
    """DIM's STS: root of the summed squared differences of the frame steps over 0.1.

    The clips are laid end to end first, so their borders count as steps, as in the reference.
    """
    truth, guess = (one.reshape(-1, one.shape[-1]) for one in _alike(target, pred))
    gap = np.diff(truth, axis=0) - np.diff(guess, axis=0)
    return float(np.sqrt((gap**2 / STS_DT).sum()))
