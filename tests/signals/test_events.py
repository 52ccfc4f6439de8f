"""The few lines that stand in for scipy.signal, held against it."""

import numpy as np
import pytest
from hypothesis import given, strategies
from hypothesis.extra import numpy as arrays
from scipy import signal

from sfms_robot.signals.events import band_pass, find_peaks, half_widths

LEVELS = strategies.one_of(strategies.integers(-3, 3).map(float), strategies.floats(-2, 2, width=16))


@given(arrays.arrays(np.float64, strategies.integers(3, 60), elements=LEVELS), strategies.sampled_from([0.1, 0.5, 1.0]))
def test_peaks_prominences_and_widths_are_those_of_scipy(values, least):
    theirs, found = signal.find_peaks(values, prominence=least)
    peaks, prominences = find_peaks(values, least)
    assert peaks.tolist() == theirs.tolist() and prominences.tolist() == found["prominences"].tolist()
    if len(peaks):
        _, _, left, right = signal.peak_widths(values, theirs, rel_height=0.5)
        assert half_widths(values, peaks, prominences) == (pytest.approx(left), pytest.approx(right))


@pytest.mark.parametrize("seed", range(20))
def test_the_highest_of_peaks_that_are_too_close_stays(seed):
    values = np.random.default_rng(seed).normal(0, 1, 80)
    for distance in (1, 3, 8):
        assert find_peaks(values, 0.2, distance)[0].tolist() == (
            signal.find_peaks(values, prominence=0.2, distance=distance)[0].tolist()
        )


@pytest.mark.parametrize("rate_hz", [25.0, 50.0, 100.0, 200.0])
@pytest.mark.parametrize("seconds", [1.0, 3.0, 36.0])
def test_the_band_pass_is_scipys_forwards_and_backwards(rate_hz, seconds):
    values = np.random.default_rng(1).normal(0, 0.01, int(rate_hz * seconds)).cumsum() + 0.4
    sections = signal.butter(2, (0.8, 6.0), "bandpass", fs=rate_hz, output="sos")
    np.testing.assert_allclose(
        band_pass(values, 0.8, 6.0, rate_hz), signal.sosfiltfilt(sections, values), atol=1e-12, rtol=0
    )
