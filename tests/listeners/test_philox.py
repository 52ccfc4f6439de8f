"""Draws of many frames at once are those of one after the other."""

import numpy as np
import pytest

from sfms_robot.frames import EVENT_KINDS
from sfms_robot.listeners.events.chance import of_instant, of_instants
from sfms_robot.listeners.lots import uniforms
from sfms_robot.listeners.philox import uniforms_of


@pytest.mark.parametrize("seed", [0, 1, 2**63 + 12345, 2**64 - 1])
@pytest.mark.parametrize("count", [1, 4, 9])
def test_many_at_once_are_one_after_the_other(seed, count):
    frames = np.array([0, 1, 2, 77, 10**6, 2**40])
    found = uniforms_of(seed, frames, 3, count)
    np.testing.assert_array_equal(found, [uniforms(seed, int(frame), 3, count) for frame in frames])


def test_instants_are_every_instant():
    frames = np.arange(1, 50, 2)
    np.testing.assert_array_equal(of_instants(5, frames), [of_instant(5, int(frame)) for frame in frames])
    assert of_instants(5, frames[:0]).shape == (0, len(EVENT_KINDS))
