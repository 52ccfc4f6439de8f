"""The facial reaction metrics of the REACT challenges, as their published code computes them.

Notation: N contexts, K samples of each, T frames, D channels; predictions (N, K, T, D), or (N, T, D) for K = 1.
`appropriate` is the N x N matrix whose row n marks the truths that suit context n. All arithmetic is float64. The
challenge's own features are 25 attributes: 15 action units, valence and arousal, 8 expression probabilities; say the
feature space next to every number. ReactFace's variants on the 58 coefficients are other numbers under other names.

Sources: reactmultimodalchallenge/baseline_react2023 @ c5a8ff85 and baseline_react2024 @ 0c3ce587 (definitions),
lingjivoo/ReactFace @ fa4b3a42 (MIT, the 58-d variants). What the papers write differently is noted per function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from sfms_robot.frames import Doubles

Reduction = Literal["sum", "mean"]

ATTRIBUTES: Final = 25
# Of the 25 attributes: slice, and what its DTW distance is divided by.
ATTRIBUTE_GROUPS: Final = ((slice(0, 15), 15.0), (slice(15, 17), 1.0), (slice(17, 25), 8.0))
MAX_LAG: Final = 49  # two seconds at 25 fps, less one frame
CCC_EPS: Final = 1e-8
REACTFACE_EPS: Final = 1e-50
REACTFACE_SCALE: Final = 10.0


def _samples(pred: ArrayLike) -> Doubles:
    """(N, K, T, D) in float64. Raises ValueError for another number of dimensions."""
    array = np.asarray(pred, dtype=np.float64)
    if array.ndim == 3:
        array = array[:, None]
    if array.ndim != 4:
        raise ValueError(f"predictions are (N, K, T, D) or (N, T, D), got shape {array.shape}")
    return array


def _clips(x: ArrayLike, like: Doubles, name: str) -> Doubles:
    array = np.asarray(x, dtype=np.float64)
    wanted = (like.shape[0], *like.shape[2:])
    if array.shape != wanted:
        raise ValueError(f"{name} has shape {array.shape}, the predictions ask for {wanted}")
    return array


def ccc(a: ArrayLike, b: ArrayLike, eps: float = CCC_EPS) -> float:
    """Concordance correlation of two tracks (..., T, D): per channel, then the mean over these and the axes before T.

    A channel that is constant in either track counts 0, also when both are equal: so truth against truth may be < 1.
    """
    x, y = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if x.shape != y.shape or x.ndim < 2:
        raise ValueError(f"two tracks (..., T, D) of one shape are needed, got {x.shape} and {y.shape}")
    mean_x, mean_y = x.mean(axis=-2, keepdims=True), y.mean(axis=-2, keepdims=True)
    covariance = ((x - mean_x) * (y - mean_y)).mean(axis=-2, keepdims=True)  # rho * s_x * s_y
    constant = (np.ptp(x, axis=-2, keepdims=True) == 0) | (np.ptp(y, axis=-2, keepdims=True) == 0)
    spread = x.var(axis=-2, keepdims=True) + y.var(axis=-2, keepdims=True) + (mean_x - mean_y) ** 2 + eps
    return float(np.where(constant, 0.0, 2 * covariance / spread).mean())


def dtw(a: ArrayLike, b: ArrayLike) -> float:
    """Dynamic time warping of (T, D) and (U, D): root of the smallest sum of squared frame distances.

    Full window, steps (1, 0), (0, 1), (1, 1). Worked out along anti-diagonals, so that numpy does the inner loop.
    """
    x, y = np.atleast_2d(np.asarray(a, dtype=np.float64)), np.atleast_2d(np.asarray(b, dtype=np.float64))
    cost = cdist(x, y, "sqeuclidean")
    rows, columns = cost.shape
    before, last = np.full(rows + 1, np.inf), np.full(rows + 1, np.inf)  # of diagonals d - 2 and d - 1, by row + 1
    before[0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        best = np.minimum(np.minimum(last[i], last[i + 1]), before[i])
        now = np.full(rows + 1, np.inf)
        now[i + 1] = cost[i, diagonal - i] + best
        before, last = last, now
    return float(np.sqrt(last[rows]))


def _suited(
    pred: ArrayLike,
    target: ArrayLike,
    appropriate: ArrayLike,
    reduction: Reduction,
    score: Callable[[Doubles, Doubles], float],
    best: Callable[[Sequence[float]], float],
) -> float:
    """mean_n reduce_k best_{j: M[n, j] = 1} score(target_j, pred_nk)."""
    samples = _samples(pred)
    truths = _clips(target, samples, "target")
    matrix = np.asarray(appropriate)
    n = len(samples)
    if matrix.shape != (n, n):
        raise ValueError(f"the appropriateness matrix is {matrix.shape}, not ({n}, {n})")
    if reduction not in ("sum", "mean"):
        raise ValueError(f"reduction {reduction!r} is not one of sum, mean")
    totals: list[float] = []
    for row, context in zip(matrix, samples, strict=True):
        suited = np.flatnonzero(row == 1)
        if not len(suited):
            raise ValueError(f"context {len(totals)} has no appropriate reaction")
        values = [best([score(truths[j], sample) for j in suited]) for sample in context]
        totals.append(float(np.sum(values) if reduction == "sum" else np.mean(values)))
    return float(np.mean(totals))


def frc(pred: ArrayLike, target: ArrayLike, appropriate: ArrayLike, reduction: Reduction = "sum") -> float:
    """FRCorr: best CCC with an appropriate truth. The challenge SUMS over the K samples; "mean" is per sample."""
    return _suited(pred, target, appropriate, reduction, ccc, max)


def _attribute_distance(truth: Doubles, sample: Doubles) -> float:
    return sum(dtw(truth[:, part], sample[:, part]) / weight for part, weight in ATTRIBUTE_GROUPS)


def frd(pred: ArrayLike, target: ArrayLike, appropriate: ArrayLike, reduction: Reduction = "sum") -> float:
    """FRDist: smallest weighted DTW to an appropriate truth, summed over the K samples as the challenge does.

    Only on the 25 attributes, whose groups have weights of their own. Raises ValueError for other widths.
    """
    width = _samples(pred).shape[-1]
    if width != ATTRIBUTES:
        raise ValueError(f"frd is defined on the {ATTRIBUTES} attributes, got {width} channels (reactface_frd: any)")
    return _suited(pred, target, appropriate, reduction, _attribute_distance, min)


def reactface_frc(pred: ArrayLike, target: ArrayLike, appropriate: ArrayLike, reduction: Reduction = "mean") -> float:
    """ReactFace's FRCorr on raw coefficients: no epsilon to speak of, and times 10."""
    score = _suited(pred, target, appropriate, reduction, lambda a, b: ccc(a, b, REACTFACE_EPS), max)
    return REACTFACE_SCALE * score


def reactface_frd(pred: ArrayLike, target: ArrayLike, appropriate: ArrayLike, reduction: Reduction = "mean") -> float:
    """ReactFace's FRDist on raw coefficients: one DTW over all channels, and times 10."""
    return REACTFACE_SCALE * _suited(pred, target, appropriate, reduction, dtw, min)


def _mean_square_distance(points: Doubles) -> float:
    """Mean over ordered pairs of (n, M) of the squared distance, over M. 0 for a single point."""
    n, size = points.shape
    if n < 2:
        return 0.0
    centred = points - points.mean(axis=0)  # sum over pairs of |p - q|^2 = 2 n sum |p - mean|^2
    return float(2 * n * (centred**2).sum() / (n * (n - 1)) / size)


def frdiv(pred: ArrayLike) -> float:
    """FRDiv: mean squared difference between the samples of one context; 0 for K = 1. Paper eq. 16 drops the counts."""
    samples = _samples(pred)
    return float(np.mean([_mean_square_distance(one.reshape(len(one), -1)) for one in samples]))


def frdvs(pred: ArrayLike) -> float:
    """FRDvs: mean squared difference between contexts, per sample index."""
    samples = _samples(pred)
    by_sample = samples.transpose(1, 0, 2, 3)
    return float(np.mean([_mean_square_distance(one.reshape(len(one), -1)) for one in by_sample]))


def frvar(pred: ArrayLike) -> float:
    """FRVar: variance over time (ddof 1), mean over everything else. (Paper eq. 17 omits the square.)"""
    return float(_samples(pred).var(axis=2, ddof=1).mean())


def frsyn(
    pred: ArrayLike,
    speaker: ArrayLike,
    nan_policy: Literal["reference", "skip"] = "reference",
    samples: Literal["first", "all"] = "first",
) -> float:
    """FRSyn: mean |lag| in frames at which prediction and speaker correlate best, lags -49..49.

    "reference" lets one constant channel make every lag NaN, which argmax answers with the first: |lag| = 49. "skip"
    leaves constant channels out, and clips that have no other. "first" uses sample 0 only, as the challenge's parallel
    version does. reference + first reproduces the challenge's number, skip + all is the one to trust.
    """
    known = synchrony_lags(pred, speaker, nan_policy, samples)
    known = known[np.isfinite(known)]
    return float(np.mean(known)) if len(known) else float("nan")


def synchrony_lags(
    pred: ArrayLike,
    speaker: ArrayLike,
    nan_policy: Literal["reference", "skip"] = "reference",
    samples: Literal["first", "all"] = "first",
) -> Doubles:
    """(N, K) or (N, 1): the |lag| of every prediction that `frsyn` is the mean of; NaN where there is none."""
    if nan_policy not in ("reference", "skip") or samples not in ("first", "all"):
        raise ValueError(f"nan_policy {nan_policy!r} (reference, skip), samples {samples!r} (first, all)")
    predictions = _samples(pred)
    speakers = _clips(speaker, predictions, "speaker")
    chosen = predictions[:, :1] if samples == "first" else predictions
    lags = [[_best_lag(one, person, nan_policy) for one in clip] for clip, person in zip(chosen, speakers, strict=True)]
    return np.abs(np.array(lags, np.float64))


def _best_lag(pred: Doubles, speaker: Doubles, nan_policy: str) -> int | None:
    frames = len(pred)
    if frames <= MAX_LAG + 1:
        raise ValueError(f"clips of {frames} frames are too short for lags up to {MAX_LAG}")
    curve = []
    for lag in range(-MAX_LAG, MAX_LAG + 1):
        late, early = (pred[lag:], speaker[: frames - lag]) if lag >= 0 else (pred[:lag], speaker[-lag:])
        curve.append(_pearson(late, early))
    per_channel = np.stack(curve)  # (99, D)
    if nan_policy == "reference":
        means = per_channel.mean(axis=1)
    else:
        usable = np.isfinite(per_channel)
        counts = usable.sum(axis=1)
        if not counts.all():
            return None
        means = np.where(usable, per_channel, 0.0).sum(axis=1) / counts
    return int(np.argmax(means)) - MAX_LAG  # argmax takes the first NaN for the largest, as the reference does


def _pearson(a: Doubles, b: Doubles) -> Doubles:
    """Per channel of (T, D); NaN where either is constant."""
    x, y = a - a.mean(axis=0), b - b.mean(axis=0)
    constant = (np.ptp(a, axis=0) == 0) | (np.ptp(b, axis=0) == 0)
    norm = np.sqrt((x**2).sum(axis=0) * (y**2).sum(axis=0))
    values: Doubles = np.where(constant, np.nan, (x * y).sum(axis=0) / np.where(constant, 1.0, norm))
    return values
