"""The papers' metrics against scipy and plain loops over their definitions, and their laws."""

import numpy as np
import pytest
from scipy import linalg

from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora.external.l2l import l2l_mean_std
from sfms_robot.lab.evaluation import metrics

RNG = np.random.default_rng(3)


def test_frechet_equals_the_matrix_root_and_paired_sees_what_it_cannot():
    a, b = RNG.normal(size=(3, 200, 6)), RNG.normal(0.5, 2.0, size=(3, 200, 6))
    x, y = a.reshape(-1, 6), b.reshape(-1, 6)
    sx, sy = np.cov(x.T), np.cov(y.T)
    gap = x.mean(0) - y.mean(0)
    expected = gap @ gap + np.trace(sx + sy - 2 * np.real(linalg.sqrtm(sx @ sy)))
    assert metrics.frechet_distance(a, b) == pytest.approx(expected, rel=1e-9)
    speaker = RNG.normal(size=(4, 500, 2))
    target, other = speaker.copy(), RNG.normal(size=(4, 500, 2))
    assert metrics.frechet_distance(target, other) < 0.02
    assert metrics.paired_frechet_distance(target, other, speaker) > 1.0


def test_shannon_index_is_log_k_of_even_use_and_counts_nearest_centres():
    centres = np.arange(8.0)[:, None] * 10
    even = np.repeat(centres, 50, axis=0)[None]
    assert metrics.shannon_index(even, centres) == pytest.approx(np.log(8), abs=1e-4)
    assert metrics.shannon_index(even, centres, "bits") == pytest.approx(3.0, abs=1e-4)
    assert metrics.shannon_index(np.zeros((1, 100, 1)), centres) == pytest.approx(0.0, abs=1e-5)
    reference, pred = RNG.normal(size=(4, 50, 3)), RNG.normal(size=(4, 50, 3))
    centres = metrics.cluster_centres(reference, 6)

    def entropy(frames):
        nearest = [int(np.argmin([np.linalg.norm(frame - centre) for centre in centres])) for frame in frames]
        shares = [nearest.count(label) / len(nearest) for label in set(nearest)]
        return -sum(share * np.log2(share + 1e-6) for share in shares)

    assert metrics.shannon_index(pred, centres, "bits") == pytest.approx(entropy(pred.reshape(-1, 3)))
    with pytest.raises(ConfigError, match="200 frames do not make 201 clusters"):
        metrics.cluster_centres(reference, 201)
    with pytest.raises(ConfigError, match="200 frames differ too little to make 3 clusters"):
        metrics.cluster_centres(np.zeros_like(reference), 3)


def test_rpcc_and_sts_are_their_definitions():
    speaker = RNG.normal(size=(3, 200, 2))
    target, pred = 2 * speaker, RNG.normal(size=(3, 200, 2))
    r = np.corrcoef(pred.ravel(), speaker.ravel())[0, 1]
    assert metrics.rpcc_flat(target, pred, speaker) == pytest.approx(1 - r)
    assert metrics.rpcc_channels(target, target, speaker) == 0.0
    assert metrics.rpcc_channels(target, pred, speaker) == pytest.approx(1.0, abs=0.15)
    a = np.zeros((2, 3, 1))
    b = a + np.array([0.0, 1.0])[:, None, None]
    assert metrics.sts(a, b) == pytest.approx(np.sqrt(1 / 0.1))


def test_l2l_std_is_the_std_of_stds():
    x = RNG.normal(size=(6, 20, 2)) * np.arange(1, 7)[:, None, None]
    mean, std = l2l_mean_std(x)
    assert mean.shape == std.shape == (1, 1, 2)
    assert std[0, 0, 1] == pytest.approx(np.std([np.std(clip[:, 1]) for clip in x]), rel=1e-9)


RNG = np.random.default_rng(7)


def naive_dtw(a, b):
    cost = np.full((len(a) + 1, len(b) + 1), np.inf)
    cost[0, 0] = 0
    for i in range(1, len(a) + 1):
        for j in range(1, len(b) + 1):
            step = ((a[i - 1] - b[j - 1]) ** 2).sum()
            cost[i, j] = step + min(cost[i - 1, j], cost[i, j - 1], cost[i - 1, j - 1])
    return np.sqrt(cost[-1, -1])


def naive_ccc(x, y):
    total = 0.0
    for a, b in zip(x.T, y.T, strict=True):
        rho = np.corrcoef(a, b)[0, 1] if a.std() > 0 and b.std() > 0 else 0.0
        total += 2 * rho * a.std() * b.std() / (a.var() + b.var() + (a.mean() - b.mean()) ** 2 + 1e-8)
    return total / x.shape[1]


@pytest.mark.parametrize("sizes", [(1, 1), (1, 9), (13, 8), (20, 20)])
def test_dtw_equals_the_textbook_loop(sizes):
    a, b = RNG.normal(size=(sizes[0], 3)), RNG.normal(size=(sizes[1], 3))
    others = np.stack([b, b[::-1]])
    assert metrics.dtw(a, others) == pytest.approx([naive_dtw(a, other) for other in others], rel=1e-9)


def test_ccc_equals_its_definition_and_counts_constant_channels_as_zero():
    x, y = RNG.normal(size=(40, 5)), RNG.normal(size=(40, 5))
    x[:, 2] = y[:, 2] = 0.3
    assert metrics.ccc(x, y) == pytest.approx(naive_ccc(x, y), rel=1e-9)
    assert metrics.ccc(x, x) == pytest.approx(4 / 5, abs=1e-6)


@pytest.mark.parametrize("as_challenge", [True, False])
def test_frsyn_equals_the_loop_over_lags(as_challenge):
    pred, speaker = RNG.normal(size=(2, 3, 70, 4)).cumsum(axis=2), RNG.normal(size=(2, 70, 4)).cumsum(axis=1)
    pred[1, :, :, 2] = 0.25
    offsets = []
    for clip, person in zip(pred[:, :1] if as_challenge else pred, speaker, strict=True):
        for sample in clip:
            means = []
            for lag in range(-49, 50):
                late, early = (sample[lag:], person[: 70 - lag]) if lag >= 0 else (sample[:lag], person[-lag:])
                of = [np.corrcoef(a, b)[0, 1] if np.ptp(a) else np.nan for a, b in zip(late.T, early.T, strict=True)]
                means.append(np.mean(of) if as_challenge else np.nanmean(of))
            offsets.append(abs(49 - int(np.argmax(means))))
    assert metrics.frsyn(pred, speaker, as_challenge) == pytest.approx(np.mean(offsets))


def test_frc_and_frd_are_means_over_samples_and_contexts():
    pred, target = RNG.random((3, 2, 12, 25)), RNG.random((3, 12, 25))
    frc = frd = 0.0
    for n in range(3):
        for sample in pred[n]:
            truth = target[n]
            frc += naive_ccc(truth, sample)
            frd += (
                naive_dtw(truth[:, :15], sample[:, :15]) / 15
                + naive_dtw(truth[:, 15:17], sample[:, 15:17])
                + naive_dtw(truth[:, 17:], sample[:, 17:]) / 8
            )
    assert metrics.frc(pred, target) == pytest.approx(frc / 6, rel=1e-9)
    assert metrics.frd(pred, target) == pytest.approx(frd / 6, rel=1e-9)


def test_reactface_scales_by_ten_and_dtw_forgives_a_pause():
    pred, target = RNG.random((2, 1, 10, 58)), RNG.random((2, 10, 58))
    expected = np.mean([naive_dtw(target[n], pred[n, 0]) for n in range(2)])
    assert metrics.reactface_frd(pred, target) == pytest.approx(10 * expected, rel=1e-9)
    x = RNG.normal(size=(30, 4))
    held = np.concatenate([x[:10], np.repeat(x[10:11], 7, axis=0), x[11:]])
    assert metrics.dtw(x, held[None]) == pytest.approx([0.0], abs=1e-6)


def test_diversities_equal_the_sums_over_pairs():
    x = RNG.normal(size=(4, 3, 6, 5))
    pairs = [((x[n, i] - x[n, j]) ** 2).sum() / 30 for n in range(4) for i in range(3) for j in range(3) if i != j]
    assert metrics.frdiv(x) == pytest.approx(np.sum(pairs) / 6 / 4)
    between = [((x[n, k] - x[m, k]) ** 2).sum() / 30 for k in range(3) for n in range(4) for m in range(4) if n != m]
    assert metrics.frdvs(x) == pytest.approx(np.sum(between) / 12 / 3) and metrics.frdiv(x[:, :1]) == 0.0


def test_one_constant_channel_makes_the_challenges_frsyn_49_and_is_skipped_by_the_other():
    speaker = RNG.normal(size=(2, 300, 3))
    pred = np.repeat(np.roll(speaker, 4, axis=1)[:, None], 2, axis=1)
    pred[..., 1] = 0.5
    assert metrics.frsyn(pred, speaker) == 49.0 and metrics.frsyn(pred, speaker, as_challenge=False) == 4.0
    assert np.isnan(metrics.frsyn(np.zeros_like(pred), speaker, as_challenge=False))
