"""Numbers depend on seed, frame and use alone, and are those of numpy's Philox with that key and counter."""

import numpy as np
import pytest

from sfms_robot.listeners.stream_rng import Use, normals, uniforms


def philox(seed: int, frame: int, use: int) -> np.random.Philox:
    return np.random.Philox(key=seed, counter=np.array([0, frame, use, 0], np.uint64))


@pytest.mark.parametrize(("seed", "frame", "use"), [(0, 0, Use.NOISE), (2**63, 1, Use.SWAY), (5, 10**9, Use.STATE)])
def test_numbers_are_those_of_a_new_generator_whatever_was_drawn_before(seed, frame, use):
    for _ in range(2):
        wanted = np.random.Generator(philox(seed, frame, use)).standard_normal((15, 58), np.float32)
        np.testing.assert_array_equal(normals(seed, frame, use, 15, 58), wanted)
        wanted = (philox(seed, frame, use).random_raw(7) >> np.uint64(11)) * 2.0**-53
        np.testing.assert_array_equal(uniforms(seed, frame, use, 7), wanted)
        normals(1, 2, Use.TOKENS, 3)
