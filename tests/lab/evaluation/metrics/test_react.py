"""REACT metrics against plain loops over their definitions, and against what analysis says they must be."""

import numpy as np
import pytest

from sfms_robot.lab.evaluation import metrics

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
    assert metrics.dtw(a, b) == pytest.approx(naive_dtw(a, b), rel=1e-9)


def test_dtw_forgives_a_pause():
    x = RNG.normal(size=(30, 4))
    held = np.concatenate([x[:10], np.repeat(x[10:11], 7, axis=0), x[11:]])
    assert metrics.dtw(x, held) == pytest.approx(0.0, abs=1e-6)


def test_ccc_equals_its_definition_and_counts_constant_channels_as_zero():
    x, y = RNG.normal(size=(40, 5)), RNG.normal(size=(40, 5))
    x[:, 2] = y[:, 2] = 0.3
    assert metrics.ccc(x, y) == pytest.approx(naive_ccc(x, y), rel=1e-9)
    assert metrics.ccc(x, x) == pytest.approx(4 / 5, abs=1e-6)


def test_ccc_of_many_tracks_is_the_mean_of_theirs():
    x, y = RNG.normal(size=(2, 3, 40, 5)), RNG.normal(size=(2, 3, 40, 5))
    each = [metrics.ccc(a, b) for a, b in zip(x.reshape(6, 40, 5), y.reshape(6, 40, 5), strict=True)]
    assert metrics.ccc(x, y) == pytest.approx(np.mean(each), rel=1e-12)


@pytest.mark.parametrize("nan_policy", ["reference", "skip"])
@pytest.mark.parametrize("samples", ["first", "all"])
def test_frsyn_equals_the_loop_over_lags(nan_policy, samples):
    pred, speaker = RNG.normal(size=(2, 3, 70, 4)).cumsum(axis=2), RNG.normal(size=(2, 70, 4)).cumsum(axis=1)
    pred[1, :, :, 2] = 0.25
    offsets = []
    for clip, person in zip(pred[:, :1] if samples == "first" else pred, speaker, strict=True):
        for sample in clip:
            means = []
            for lag in range(-49, 50):
                late, early = (sample[lag:], person[: 70 - lag]) if lag >= 0 else (sample[:lag], person[-lag:])
                of = [
                    np.corrcoef(a, b)[0, 1] if np.ptp(a) > 0 else np.nan for a, b in zip(late.T, early.T, strict=True)
                ]
                means.append(np.mean(of) if nan_policy == "reference" else np.nanmean(of))
            offsets.append(abs(49 - int(np.argmax(means))))
    assert metrics.frsyn(pred, speaker, nan_policy, samples) == pytest.approx(np.mean(offsets))


def test_dtw_of_a_track_with_itself_is_exactly_zero_wherever_it_lies():
    x = np.pi + 1e-3 * RNG.normal(size=(40, 3))
    assert metrics.dtw(x, x) == 0.0


def test_frc_and_frd_take_the_best_appropriate_truth_and_sum_over_samples():
    pred, target = RNG.random((3, 2, 12, 25)), RNG.random((3, 12, 25))
    matrix = np.array([[1, 1, 0], [0, 1, 0], [1, 0, 1]])
    frc = frd = 0.0
    for n in range(3):
        for sample in pred[n]:
            suited = [target[j] for j in range(3) if matrix[n, j]]
            frc += max(naive_ccc(truth, sample) for truth in suited)
            frd += min(
                naive_dtw(t[:, :15], sample[:, :15]) / 15
                + naive_dtw(t[:, 15:17], sample[:, 15:17])
                + naive_dtw(t[:, 17:], sample[:, 17:]) / 8
                for t in suited
            )
    assert metrics.frc(pred, target, matrix) == pytest.approx(frc / 3, rel=1e-9)
    assert metrics.frc(pred, target, matrix, reduction="mean") == pytest.approx(frc / 6, rel=1e-9)
    assert metrics.frd(pred, target, matrix) == pytest.approx(frd / 3, rel=1e-9)


def test_reactface_variants_scale_by_ten_and_take_any_width():
    pred, target = RNG.random((2, 10, 58)), RNG.random((2, 10, 58))
    own = np.eye(2)
    expected = np.mean([naive_dtw(target[n], pred[n]) for n in range(2)])
    assert metrics.reactface_frd(pred, target, own) == pytest.approx(10 * expected, rel=1e-9)
    assert metrics.reactface_frc(target, target, own) == pytest.approx(10.0)


def test_uniform_noise_has_the_analytic_diversities():
    noise = RNG.random((40, 10, 100, 25))
    assert metrics.frvar(noise) == pytest.approx(1 / 12, rel=0.01)
    assert metrics.frdiv(noise) == pytest.approx(1 / 6, rel=0.01)
    assert metrics.frdvs(noise) == pytest.approx(1 / 6, rel=0.01)


def test_diversities_equal_the_sums_over_pairs():
    x = RNG.normal(size=(4, 3, 6, 5))
    pairs = [((x[n, i] - x[n, j]) ** 2).sum() / 30 for n in range(4) for i in range(3) for j in range(3) if i != j]
    assert metrics.frdiv(x) == pytest.approx(np.sum(pairs) / 6 / 4)
    between = [((x[n, k] - x[m, k]) ** 2).sum() / 30 for k in range(3) for n in range(4) for m in range(4) if n != m]
    assert metrics.frdvs(x) == pytest.approx(np.sum(between) / 12 / 3)
    assert metrics.frdiv(x[:, :1]) == 0.0


@pytest.mark.parametrize("lag", [-20, -3, 0, 5, 49])
def test_frsyn_finds_the_lag(lag):
    speaker = RNG.normal(size=(1, 400, 3))
    pred = np.roll(speaker, lag, axis=1)
    for policy in ("reference", "skip"):
        assert metrics.frsyn(pred, speaker, nan_policy=policy) == abs(lag)


def test_one_constant_channel_makes_the_challenges_frsyn_49_and_is_skipped_by_the_other():
    speaker = RNG.normal(size=(2, 300, 3))
    pred = np.repeat(np.roll(speaker, 4, axis=1)[:, None], 2, axis=1)
    pred[..., 1] = 0.5
    assert metrics.frsyn(pred, speaker) == 49.0
    assert metrics.frsyn(pred, speaker, nan_policy="skip", samples="all") == 4.0
    assert np.isnan(metrics.frsyn(np.zeros_like(pred), speaker, nan_policy="skip"))


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="25 attributes"):
        metrics.frd(np.zeros((2, 5, 58)), np.zeros((2, 5, 58)), np.eye(2))
    with pytest.raises(ValueError, match="target has shape"):
        metrics.frc(np.zeros((2, 5, 25)), np.zeros((3, 5, 25)), np.eye(2))
    with pytest.raises(ValueError, match="no appropriate"):
        metrics.frc(np.zeros((2, 5, 25)), np.zeros((2, 5, 25)), np.zeros((2, 2)))
