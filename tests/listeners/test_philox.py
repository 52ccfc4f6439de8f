"""Draws of many frames at once are those of one after the other."""

import numpy as np
import pytest

from sfms_robot.listeners.lots import uniforms, uniforms_of


@pytest.mark.parametrize("seed", [0, 1, 2**63 + 12345, 2**64 - 1])
@pytest.mark.parametrize("count", [1, 4, 9])
def test_many_at_once_are_one_after_the_other(seed, count):
    frames = np.array([0, 1, 2, 77, 10**6, 2**40])
    found = uniforms_of(seed, frames, 3, count)
    np.testing.assert_array_equal(found, [uniforms(seed, int(frame), 3, count) for frame in frames])
    assert uniforms_of(seed, frames[:0], 3, count).shape == (0, count)
