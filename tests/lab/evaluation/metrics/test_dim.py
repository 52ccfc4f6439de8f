"""Frechet, variance, entropy and the rest: against scipy and plain loops, and what must hold."""

import numpy as np
import pytest
from scipy import linalg

from sfms_robot.lab.evaluation import metrics

RNG = np.random.default_rng(3)


def test_frechet_equals_the_matrix_root():
    a, b = RNG.normal(size=(3, 200, 6)), RNG.normal(0.5, 2.0, size=(3, 200, 6))
    x, y = a.reshape(-1, 6), b.reshape(-1, 6)
    sx, sy = np.cov(x.T), np.cov(y.T)
    gap = x.mean(0) - y.mean(0)
    expected = gap @ gap + np.trace(sx + sy - 2 * np.real(linalg.sqrtm(sx @ sy)))
    assert metrics.frechet_distance(a, b) == pytest.approx(expected, rel=1e-9)
    per_clip = [metrics.frechet_distance(p, q) for p, q in zip(a, b, strict=True)]
    assert metrics.frechet_distance(a, b, pool=False) == pytest.approx(np.mean(per_clip))


def test_frechet_of_a_set_with_itself_is_zero_and_of_a_shift_its_square():
    a = RNG.normal(size=(2, 100, 4))
    assert metrics.frechet_distance(a, a) == pytest.approx(0.0, abs=1e-9)
    assert metrics.frechet_distance(a, a + [1.0, 0, 2.0, 0]) == pytest.approx(5.0)


def test_too_few_frames_are_said(caplog):
    metrics.frechet_distance(RNG.normal(size=(5, 9)), RNG.normal(size=(5, 9)))
    assert "singular" in caplog.text


def test_paired_frechet_sees_what_frechet_cannot():
    speaker = RNG.normal(size=(4, 500, 2))
    target, other = speaker.copy(), RNG.normal(size=(4, 500, 2))
    assert metrics.frechet_distance(target, other) < 0.02
    assert metrics.paired_frechet_distance(target, other, speaker) > 1.0


def test_the_three_variances():
    x = RNG.normal(size=(5, 30, 4)) * [1, 2, 3, 4] + [0, 10, 20, 30]
    assert metrics.variance(x) == pytest.approx(np.var(x))
    assert metrics.variance(x, "time") == pytest.approx(np.mean([np.var(c, axis=0).mean() for c in x]))
    assert metrics.variance(x, "sum") == pytest.approx(sum(np.var(x[..., d]) for d in range(4)))


def test_l2_definitions():
    a, b = RNG.normal(size=(2, 40, 3)), RNG.normal(size=(2, 40, 3))
    assert metrics.l2(a, b, start=32) == pytest.approx(
        np.mean([np.linalg.norm(x) for x in (a - b)[:, 32:].reshape(-1, 3)])
    )
    assert metrics.l2(a, b, "mse") == pytest.approx(((a - b) ** 2).mean())


def test_shannon_index_of_even_use_is_log_k_and_of_one_cluster_nothing():
    centres = np.arange(8.0)[:, None] * 10
    even = np.repeat(centres, 50, axis=0)[None]
    assert metrics.shannon_index(even, even, 8, eps=0.0, centres=centres) == pytest.approx(np.log(8))
    assert metrics.shannon_index(even, even, 8, unit="bits", eps=0.0, centres=centres) == pytest.approx(3.0)
    still = np.zeros((1, 100, 1))
    assert metrics.shannon_index(still, even, 8, eps=0.0, centres=centres) == 0.0
    assert metrics.shannon_index(even, even, 8) == pytest.approx(np.log(8), abs=0.4)  # own k-means


def test_shannon_index_counts_nearest_centres_pooled_or_clip_by_clip():
    reference, pred = RNG.normal(size=(4, 50, 3)), RNG.normal(size=(4, 50, 3))
    centres = metrics.cluster_centres(reference, 6)

    def entropy(frames):
        nearest = [int(np.argmin([np.linalg.norm(frame - centre) for centre in centres])) for frame in frames]
        shares = [nearest.count(label) / len(nearest) for label in set(nearest)]
        return -sum(share * np.log2(share + 1e-6) for share in shares)

    assert metrics.shannon_index(pred, reference, 6, unit="bits") == pytest.approx(entropy(pred.reshape(-1, 3)))
    each = metrics.shannon_index(pred, reference, 6, unit="bits", centres=centres, per_clip=True)
    assert each == pytest.approx(np.mean([entropy(clip) for clip in pred]))
    with pytest.raises(ValueError, match="200 frames make no 201 clusters"):
        metrics.cluster_centres(reference, 201)
    with pytest.raises(ValueError, match="200 frames differ too little to make 3 clusters"):
        metrics.cluster_centres(np.zeros_like(reference), 3)


def test_centres_are_the_means_of_what_is_nearest_to_them():
    frames = RNG.normal(size=(2, 400, 2))
    centres = metrics.cluster_centres(frames, 5)
    pooled = frames.reshape(-1, 2)
    nearest = np.linalg.norm(pooled[:, None] - centres, axis=2).argmin(axis=1)
    means = np.stack([pooled[nearest == label].mean(axis=0) for label in range(5)])
    np.testing.assert_allclose(centres, means, atol=0.02)


def test_rpcc():
    speaker = RNG.normal(size=(3, 200, 2))
    target, pred = 2 * speaker, RNG.normal(size=(3, 200, 2))
    r = np.corrcoef(pred.ravel(), speaker.ravel())[0, 1]
    assert metrics.rpcc_flat(target, pred, speaker) == pytest.approx(1 - r)
    assert metrics.rpcc_channels(target, target, speaker) == 0.0
    assert metrics.rpcc_channels(target, pred, speaker) == pytest.approx(1.0, abs=0.15)


def test_sts_counts_the_borders_of_clips():
    a = np.zeros((2, 3, 1))
    b = a + np.array([0.0, 1.0])[:, None, None]
    assert metrics.sts(a, b) == pytest.approx(np.sqrt(1 / 0.1))


def test_l2l_std_is_the_std_of_stds():
    x = RNG.normal(size=(6, 20, 2)) * np.arange(1, 7)[:, None, None]
    mean, std = metrics.l2l_mean_std(x)
    assert mean.shape == std.shape == (1, 1, 2)
    assert std[0, 0, 1] == pytest.approx(np.std([np.std(clip[:, 1]) for clip in x]), rel=1e-9)


def test_the_bilateral_filter_is_the_five_tap_kernel_on_small_values():
    x = 0.1 * RNG.normal(size=(1, 50, 2))
    padded = np.pad(x, ((0, 0), (2, 2), (0, 0)), mode="reflect")
    kernel = np.array([1, 3, 5, 3, 1]) / 13
    expected = sum(w * padded[:, i : i + 50] for i, w in enumerate(kernel))
    np.testing.assert_allclose(metrics.l2l_bilateral(x), expected, atol=2e-3)
    np.testing.assert_allclose(metrics.l2l_bilateral(np.full((3, 7, 1), 4.0)), 4.0)


def test_the_bilateral_filter_equals_the_loop_over_a_circle_of_pixels():
    x = 30 * RNG.normal(size=(2, 9, 3))
    expected = np.zeros_like(x)
    for clip, frame, channel in np.ndindex(x.shape):
        total = weights = 0.0
        for down in range(-2, 3):
            for across in range(-2, 3):  # an image one pixel wide: reflection finds the same column
                if down**2 + across**2 > 4:
                    continue
                at = abs(frame + down)
                value = x[clip, min(at, 2 * 8 - at), channel]
                far = (down**2 + across**2 + (value - x[clip, frame, channel]) ** 2) / (2 * 20.0**2)
                total, weights = total + np.exp(-far) * value, weights + np.exp(-far)
        expected[clip, frame, channel] = total / weights
    np.testing.assert_allclose(metrics.l2l_bilateral(x), expected, rtol=1e-10)
