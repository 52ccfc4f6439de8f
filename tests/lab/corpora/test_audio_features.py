"""The cache of features: the same sound is computed once, and nothing stale or broken is ever read."""

import numpy as np
import pytest

from sfms_robot.lab.corpora.audio_features import MFCC78, Feature, cached, entry

NOISE = np.random.default_rng(0).normal(0, 0.1, 16_000).astype(np.float32)


def counting(calls: list[int], version: str = "1") -> Feature:
    def compute(samples):
        calls.append(len(samples))
        return samples[: len(samples) // 640 * 640].reshape(-1, 640)[:, :3]

    return Feature(name="three", version=version, dim=3, fps=25, compute=compute)


def test_same_sound_is_computed_once_and_read_back_exactly(tmp_path):
    calls: list[int] = []
    first, again = (cached(NOISE, counting(calls), tmp_path) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(calls) == 1 and not list(tmp_path.rglob("*.part"))


def test_other_sound_and_other_versions_are_other_entries(tmp_path):
    calls: list[int] = []
    for samples, version in ((NOISE, "1"), (NOISE[1:], "1"), (NOISE, "2"), (NOISE, "1")):
        cached(samples, counting(calls, version), tmp_path)
    assert len(calls) == 3 and len(list(tmp_path.rglob("*.npz"))) == 3


@pytest.mark.parametrize("at", [0, 200, -100, None])
def test_broken_entry_is_computed_again_and_mended(tmp_path, at):
    calls: list[int] = []
    whole = cached(NOISE, counting(calls), tmp_path)
    file = entry(NOISE, counting(calls), tmp_path)
    content = bytearray(file.read_bytes())
    if at is None:
        content = content[:50]
    else:
        content[at] ^= 0xFF
    file.write_bytes(content)
    np.testing.assert_array_equal(cached(NOISE, counting(calls), tmp_path), whole)
    cached(NOISE, counting(calls), tmp_path)
    assert len(calls) <= 2 and (at not in (200, None) or len(calls) == 2)


def test_mfcc_is_a_feature_that_can_be_kept(tmp_path):
    assert cached(NOISE, MFCC78, tmp_path).shape == (25, 78)
