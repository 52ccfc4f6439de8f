"""Nods, blinks and smiles: what counts as one, at the rates of plans and of loops."""

import numpy as np
import pytest
from hypothesis import given, strategies
from hypothesis.extra import numpy as arrays
from scipy import signal

from sfms_robot.signals.events import band_pass, find_blinks, find_nods, find_peaks, find_smiles, half_widths, runs


@pytest.fixture(params=[25.0, 100.0])
def time_s(request):
    return np.arange(0, 8, 1 / request.param)


def rate_of(time_s):
    return 1 / (time_s[1] - time_s[0])


def test_a_nod_is_found_once_with_its_time_and_size_and_a_shift_or_drift_is_none(time_s):
    swing = np.where((time_s >= 3) & (time_s < 3.6), 0.06 * np.sin(np.pi * (time_s - 3) / 0.6) ** 2, 0.0)
    for pitch in (swing, -swing, swing + 0.02 * time_s):
        ((start_s, end_s, size),) = find_nods(pitch, rate_of(time_s))
        assert start_s == pytest.approx(3.0, abs=0.15) and end_s == pytest.approx(3.6, abs=0.15)
        assert size == pytest.approx(0.06, abs=0.015)
    shift, drift = 0.1 / (1 + np.exp(-20 * (time_s - 4))), 0.1 * np.sin(2 * np.pi * 0.2 * time_s)
    assert not find_nods(shift, rate_of(time_s)) and not find_nods(drift, rate_of(time_s))
    assert not find_nods(swing[:15], 10.0)


def test_a_blink_is_counted_against_lids_that_rest_half_closed_and_a_long_closure_is_none(time_s):
    lids = 0.3 + 0.6 * np.exp(-(((time_s - 3) / 0.06) ** 2)) + 0.65 * np.exp(-(((time_s - 5) / 0.06) ** 2))
    ((start_s, end_s, height), _) = find_blinks(lids, rate_of(time_s))
    assert start_s < 3 < end_s < start_s + 0.3 and height == pytest.approx(0.6, abs=0.05)
    assert not find_blinks(((time_s > 3) & (time_s < 4)).astype(float), rate_of(time_s))
    one_frame = np.zeros(200)
    one_frame[[50, 199]] = 1.0
    assert len(find_blinks(one_frame, 25.0)) == 2


def test_a_smile_lasts_and_ends_where_it_has_fallen_by_half_and_runs_are_half_open(time_s):
    ((start_s, end_s, peak),) = find_smiles(np.clip(1.2 - np.abs(time_s - 4), 0, 1), rate_of(time_s))
    assert (start_s, end_s, peak) == (pytest.approx(2.9, abs=0.05), pytest.approx(5.1, abs=0.05), 1.0)
    assert not find_smiles(np.where(np.abs(time_s - 4) < 0.15, 0.9, 0.15), rate_of(time_s))
    assert runs([1, 1, 0, 1]) == [(0, 2), (3, 4)] and runs([]) == []


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
    assert band_pass(values, 0.8, 6.0, rate_hz) == pytest.approx(signal.sosfiltfilt(sections, values), abs=1e-12, rel=0)
