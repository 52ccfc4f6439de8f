"""Between its samples a signal is what it was before it was sampled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.signals.audio import at_positions

RATE_HZ = 16_000


@given(frequency_hz=st.floats(50, 6_400), first=st.floats(100, 200), ratio=st.floats(0.1, 1.1))
def test_a_tone_goes_on_between_its_samples(frequency_hz, first, ratio):
    turn = 2 * np.pi * frequency_hz / RATE_HZ
    tone = np.sin(turn * np.arange(1000)).astype(np.float32)
    positions = first + ratio * np.arange(500)
    np.testing.assert_allclose(at_positions(tone, positions), np.sin(turn * positions), atol=1e-3)


@given(seed=st.integers(0, 100), shift=st.integers(-50, 50))
def test_at_whole_positions_samples_are_what_they_are_and_0_around_them(seed, shift):
    samples = np.random.default_rng(seed).normal(size=40).astype(np.float32)
    positions = np.arange(shift, shift + 40, dtype=float)
    expected = np.pad(samples, 100)[100 + shift : 140 + shift]
    np.testing.assert_allclose(at_positions(samples, positions), expected, atol=1e-6)


def test_of_nothing_asked_there_is_nothing():
    assert at_positions(np.ones(3, np.float32), np.zeros(0)).shape == (0,)


def test_a_constant_stays_one():
    assert at_positions(np.ones(200, np.float32), np.linspace(50, 150, 333)) == pytest.approx(np.ones(333), abs=1e-6)
