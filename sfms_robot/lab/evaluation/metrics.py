"""Metrics with the names of their papers, computed as in their reference code, in float64.

N clips or contexts, K samples of each, T frames, D channels. Earlier work uses the same names for different
definitions, so the definition is part of the name or stated at the function. FRRea, a distance between rendered images,
is out of scope.

The Learning2Listen line: clips are (N, T, D), or (T, D) for one, of equal shapes. Sources:
Boese0601/Dyadic-Interaction-Modeling @ 9fc92f72 (DIM), sanjayss34/lm-listener @ 53ce4ecc, evonneng/learning2listen @
a0825d58 (definitions only).

The REACT challenges: predictions are (N, K, T, D), truth and speaker (N, T, D), of more than 50 frames. The only
appropriate reaction to a context is that of its recorded listener. The challenge's features are 25 attributes: 15
action units, valence and arousal, 8 expression probabilities; name the feature space next to every number. ReactFace's
variants on the 58 coefficients are other numbers under other names. Sources:
reactmultimodalchallenge/baseline_react2023 @ c5a8ff85 and baseline_react2024 @ 0c3ce587 (definitions),
lingjivoo/ReactFace @ fa4b3a42 (MIT, the 58-d variants).
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Literal

import numpy as np
from scipy.cluster.vq import kmeans2, vq
from scipy.spatial.distance import cdist

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles, Floats

# Of the tables of the SFMS paper: parts of a face by motion space, clusters of the Shannon index (V-D1).
PARTS: Final = {
    "arkit58": {"expression": slice(6, 58), "rotation": slice(0, 3)},
    "faceverse58": {"expression": slice(0, 52), "rotation": slice(52, 55)},
    "deca56": {"expression": slice(0, 50), "rotation": slice(50, 53)},
}
CLUSTERS: Final = {"expression": 15, "rotation": 9}
NEEDED_FRAMES: Final = {1: 2, 2: 51}  # by table; FRSyn has lags of up to 49 frames in both directions
_ATTRIBUTE_GROUPS: Final = ((slice(0, 15), 15.0), (slice(15, 17), 1.0), (slice(17, 25), 8.0))  # divisor of the DTW
_SID_EPS: Final = 1e-6  # inside the logarithm, as in DIM
_STS_DT: Final = 0.1
_KMEANS_ROUNDS: Final = 100  # scipy's default of 10 ends well before the centres stop moving
_MAX_LAG: Final = 49  # two seconds at 25 fps, less one frame
_CCC_EPS: Final = 1e-8
_log = logging.getLogger(__name__)


def cut(motions: Sequence[Doubles] | Sequence[Floats], frames: int) -> Doubles:
    """Cut motions (..., N_i, D) into consecutive clips (M, ..., frames, D); the rest of each is not used.

    Raises ConfigError when no motion is that long.
    """
    clips = [
        motion[..., at : at + frames, :] for motion in motions for at in range(0, motion.shape[-2] - frames + 1, frames)
    ]
    if not clips:
        raise ConfigError(f"no clip is as long as {frames} frames")
    return np.stack(clips).astype(np.float64)


# --- Learning2Listen ------------------------------------------------------------------------------------------------


def frechet_distance(a: Doubles, b: Doubles) -> float:
    """Return FD of all frames of two sets of clips: |mu|^2 + tr(Sa) + tr(Sb) - 2 tr sqrt(Sa Sb), covariances ddof 1.

    The root is computed from symmetric eigenvalues, so it stays real. Fewer frames than channels make a covariance
    singular, which is logged.
    """
    x, y = (one.reshape(-1, one.shape[-1]) for one in (a, b))
    if min(len(x), len(y)) <= x.shape[1]:
        _log.warning("FD of %d frames in %d dimensions: the covariance is singular", min(len(x), len(y)), x.shape[1])
    gap = x.mean(axis=0) - y.mean(axis=0)
    sx, sy = np.atleast_2d(np.cov(x, rowvar=False)), np.atleast_2d(np.cov(y, rowvar=False))
    values, vectors = np.linalg.eigh(sx)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    cross = np.linalg.eigvalsh(root @ sy @ root)
    return float(gap @ gap + np.trace(sx) + np.trace(sy) - 2 * np.sqrt(np.maximum(cross, 0.0)).sum())


def paired_frechet_distance(target: Doubles, pred: Doubles, speaker: Doubles) -> float:
    """Return P-FD: FD of frames with the channels of both speaker and listener."""
    truth, guess = (np.concatenate([speaker, one], axis=-1) for one in (target, pred))
    return frechet_distance(truth, guess)


def l2(target: Doubles, pred: Doubles) -> float:
    """Return the distance over all channels, mean over clips and frames."""
    return float(np.linalg.norm(target - pred, axis=-1).mean())


def mse(target: Doubles, pred: Doubles) -> float:
    """Return the mean squared error (lm-listener, DIM)."""
    return float(((target - pred) ** 2).mean())


def variance(x: Doubles, definition: Literal["flat", "time", "sum"] = "flat") -> float:
    """Return the variance by one of three definitions.

    "flat" pools clips, frames and channels (DIM); "time" is the variance over time per channel and clip, averaged
    (lm-listener); "sum" adds the pooled variances of the channels (DIM's other definition).
    """
    if definition == "flat":
        return float(x.var())
    return float(x.var(axis=-2).mean() if definition == "time" else x.reshape(-1, x.shape[-1]).var(axis=0).sum())


def shannon_index(pred: Doubles, centres: Doubles, unit: Literal["nats", "bits"] = "nats") -> float:
    """Return SI: the entropy of the clusters (`cluster_centres` (k, D)) that the predicted frames fall into.

    Centres of another k-means differ, so numbers can be compared only if their centres are the same.
    """
    labels, _ = vq(pred.reshape(-1, pred.shape[-1]), centres)
    share = np.bincount(labels) / len(labels)
    share = share[share > 0]
    return float(-(share * (np.log if unit == "nats" else np.log2)(share + _SID_EPS)).sum())


def cluster_centres(reference: Doubles, k: int) -> Doubles:
    """Return the k-means centres (k, D) of the pooled frames of clips, with a fixed seed.

    Raises ConfigError for fewer frames than k, or too many equal frames.
    """
    frames = reference.reshape(-1, reference.shape[-1])
    if len(frames) < k:
        raise ConfigError(f"the clips' own motion: {len(frames)} frames do not make {k} clusters")
    with warnings.catch_warnings(), np.errstate(invalid="raise"):
        warnings.simplefilter("ignore", UserWarning)  # an empty cluster counts 0 in the entropy
        try:
            found, _ = kmeans2(frames, k, iter=_KMEANS_ROUNDS, minit="++", seed=np.random.default_rng(0))
        except FloatingPointError:
            problem = f"{len(frames)} frames differ too little to make {k} clusters"
            raise ConfigError(f"the clips' own motion: {problem}") from None
    return np.asarray(found, np.float64)


def centres_of(truth: Doubles, parts: Mapping[str, slice], clusters: Mapping[str, int]) -> Mapping[str, Doubles]:
    """Return the clusters of the truth (M, T, D) for each part of a face, the same for every row of a table."""
    return {part: cluster_centres(truth[..., where], clusters[part]) for part, where in parts.items()}


def rpcc_flat(target: Doubles, pred: Doubles, speaker: Doubles) -> float:
    """Return DIM's RPCC: |corr(target, speaker) - corr(pred, speaker)|, everything flattened into one vector."""
    truth, guess, person = (one.ravel() for one in (target, pred, speaker))
    return float(abs(np.corrcoef(truth, person)[0, 1] - np.corrcoef(guess, person)[0, 1]))


def rpcc_channels(target: Doubles, pred: Doubles, speaker: Doubles) -> float:
    """Return RPCC per clip and channel, averaged before the difference, without constant channels."""
    truth, guess = (
        float(np.nanmean(values)) if np.isfinite(values).any() else 0.0
        for values in (_pearson(target, speaker), _pearson(pred, speaker))
    )
    return abs(truth - guess)


def _pearson(a: Doubles, b: Doubles) -> Doubles:
    """Return the correlation over time of (..., T, D), (..., D); NaN where either is constant."""
    x, y = a - a.mean(axis=-2, keepdims=True), b - b.mean(axis=-2, keepdims=True)
    constant = (np.ptp(a, axis=-2) == 0) | (np.ptp(b, axis=-2) == 0)
    norm = np.sqrt((x**2).sum(axis=-2) * (y**2).sum(axis=-2))
    return np.where(constant, np.nan, (x * y).sum(axis=-2) / np.where(constant, 1.0, norm))


def sts(target: Doubles, pred: Doubles) -> float:
    """Return DIM's STS: the root of the summed squared differences of the frame steps over 0.1.

    The clips are joined end to end first, so their borders count as steps, as in the reference.
    """
    truth, guess = (one.reshape(-1, one.shape[-1]) for one in (target, pred))
    gap = np.diff(truth, axis=0) - np.diff(guess, axis=0)
    return float(np.sqrt((gap**2 / _STS_DT).sum()))


# --- REACT ----------------------------------------------------------------------------------------------------------


def ccc(x: Doubles, y: Doubles) -> float:
    """Return the concordance correlation of two tracks (..., T, D), per channel, then the mean.

    A channel that is constant in either track counts 0, also when both are equal: truth against truth may be < 1.
    """
    mean_x, mean_y = x.mean(axis=-2, keepdims=True), y.mean(axis=-2, keepdims=True)
    covariance = ((x - mean_x) * (y - mean_y)).mean(axis=-2, keepdims=True)  # rho * s_x * s_y
    constant = (np.ptp(x, axis=-2, keepdims=True) == 0) | (np.ptp(y, axis=-2, keepdims=True) == 0)
    spread = x.var(axis=-2, keepdims=True) + y.var(axis=-2, keepdims=True) + (mean_x - mean_y) ** 2 + _CCC_EPS
    return float(np.where(constant, 0.0, 2 * covariance / spread).mean())


def dtw(one: Doubles, many: Doubles) -> Doubles:
    """Return the dynamic time warping of one track (T, D) with each of (V, U, D): (V,).

    It is the root of the smallest sum of squared frame distances, full window, steps (1, 0), (0, 1), (1, 1), computed
    along anti-diagonals for all tracks at once.
    """
    cost = np.stack([cdist(one, other, "sqeuclidean") for other in many])  # (V, T, U)
    count, rows, columns = cost.shape
    before, last = (np.full((count, rows + 1), np.inf) for _ in range(2))  # of diagonals d - 2 and d - 1, by row + 1
    before[:, 0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        best = np.minimum(np.minimum(last[:, i], last[:, i + 1]), before[:, i])
        now = np.full((count, rows + 1), np.inf)
        now[:, i + 1] = cost[:, i, diagonal - i] + best
        before, last = last, now
    return np.sqrt(last[:, rows])


def _mean_score(pred: Doubles, target: Doubles, score: Callable[[Doubles, Doubles], float]) -> float:
    return float(np.mean([score(true, one) for true, context in zip(target, pred, strict=True) for one in context]))


def frc(pred: Doubles, target: Doubles) -> float:
    """Return FRCorr per sample: the mean CCC with the truth. The challenge sums over the K samples."""
    return _mean_score(pred, target, ccc)


def frd(pred: Doubles, target: Doubles) -> float:
    """Return FRDist per sample: the mean weighted DTW to the truth. The challenge sums over the K samples.

    Defined on the 25 attributes only, whose groups have their own weights.
    """

    def score(truth: Doubles, sample: Doubles) -> float:
        return sum(float(dtw(truth[:, part], sample[None, :, part])[0]) / weight for part, weight in _ATTRIBUTE_GROUPS)

    return _mean_score(pred, target, score)


def reactface_frd(pred: Doubles, target: Doubles) -> float:
    """Return ReactFace's FRDist on raw coefficients: one DTW over all channels, times 10."""
    return 10.0 * _mean_score(pred, target, lambda truth, sample: float(dtw(truth, sample[None])[0]))


def frdiv(pred: Doubles) -> float:
    """Return FRDiv: mean squared difference between the samples of a context. Paper eq. 16 drops the counts."""
    return float(2 * pred.var(axis=1, ddof=1).mean()) if pred.shape[1] > 1 else 0.0


def frdvs(pred: Doubles) -> float:
    """Return FRDvs: mean squared difference between contexts, per sample index."""
    return frdiv(pred.transpose(1, 0, 2, 3))


def frvar(pred: Doubles) -> float:
    """Return FRVar: the variance over time (ddof 1), mean over everything else. Paper eq. 17 omits the square."""
    return float(pred.var(axis=2, ddof=1).mean())


def frsyn(pred: Doubles, speaker: Doubles, as_challenge: bool = True) -> float:
    """Return FRSyn: the mean of the finite `synchrony_lags`; NaN without any."""
    return mean_known(synchrony_lags(pred, speaker, as_challenge))


def mean_known(values: Doubles) -> float:
    """Return the mean of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan


def synchrony_lags(pred: Doubles, speaker: Doubles, as_challenge: bool) -> Doubles:
    """Return the |lag| in frames, up to 49, at which each prediction (N, K) and the speaker correlate best.

    As in the challenge only sample 0 counts, and one constant channel makes every correlation NaN, so that argmax
    returns the first lag: |lag| = 49. Otherwise all samples count without their constant channels, NaN if no channel is
    left; this is the number to trust.
    """
    return np.stack([_best_lags(one, person, as_challenge) for one, person in zip(pred, speaker, strict=True)])


def _best_lags(context: Doubles, speaker: Doubles, as_challenge: bool) -> Doubles:
    """Return the |lag| of each of the samples (K, T, D) of one context, or, if `as_challenge`, of the first sample."""
    samples, frames = context[:1] if as_challenge else context, len(speaker)
    curves = np.stack(
        [
            _pearson(samples[:, max(0, lag) : frames + min(0, lag)], speaker[max(0, -lag) : frames - max(0, lag)])
            for lag in range(-_MAX_LAG, _MAX_LAG + 1)
        ]
    )  # (99, K, D)
    if as_challenge:
        return np.asarray(np.abs(np.argmax(curves.mean(axis=-1), axis=0) - float(_MAX_LAG)))
    usable = np.isfinite(curves)
    counts = usable.sum(axis=-1)
    means = np.where(usable, curves, 0.0).sum(axis=-1) / np.maximum(counts, 1)
    return np.where(counts.all(axis=0), np.abs(np.argmax(means, axis=0) - float(_MAX_LAG)), np.nan)
