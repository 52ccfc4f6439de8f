"""Peaks of a signal and a zero-phase band-pass: what the loop of a head needs of scipy.signal, without loading it.

scipy takes 1.5 s and 60 MB to load, in a process that drives servos a hundred times a second. These say the same
numbers (tests hold one against the other).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles

Indices = NDArray[np.intp]

_SETTLED: Final = 1e-12  # of what is left of a step when the filter counts as settled
_EDGE: Final = 15  # samples mirrored at both ends, as scipy.signal.sosfiltfilt does for this order


def find_peaks(values: Doubles, prominence: float, distance: int = 1) -> tuple[Indices, Doubles]:
    """Local maxima of (N,) that stand out by `prominence`, at least `distance` samples apart, and by how much.

    The middle of a plateau is its peak. Of two that are too close the higher one stays, of equal ones the later.
    """
    peaks = _maxima(values)
    peaks = peaks[_far_apart(peaks, values[peaks], distance)]
    prominences = _prominences(values, peaks)
    keep = prominences >= prominence
    return peaks[keep], prominences[keep]


def half_widths(values: Doubles, peaks: Indices, prominences: Doubles) -> tuple[Doubles, Doubles]:
    """Where (N,) crosses half of each peak's prominence, left and right of it, between samples by a straight line."""
    left, right = np.zeros(len(peaks)), np.zeros(len(peaks))
    for row, (peak, height) in enumerate(zip(peaks, values[peaks] - prominences / 2, strict=True)):
        a = b = int(peak)
        while values[a] > height:
            a -= 1
        while values[b] > height:
            b += 1
        left[row] = a + (height - values[a]) / (values[a + 1] - values[a]) if values[a] < height else a
        right[row] = b - (height - values[b]) / (values[b - 1] - values[b]) if values[b] < height else b
    return left, right


def band_pass(values: Doubles, low_hz: float, high_hz: float, rate_hz: float) -> Doubles:
    """(N,), N > 15, through a Butterworth band-pass of second order forwards and backwards, so that nothing is late.

    As scipy.signal.sosfiltfilt does: both ends are mirrored through their last value, and before and after that the
    signal counts as constant, of which a band-pass lets nothing through. So both passes begin at rest.
    """
    start, end = 2 * values[0] - values[_EDGE:0:-1], 2 * values[-1] - values[-2 : -_EDGE - 2 : -1]
    mirrored = np.concatenate([start, values, end])
    for _ in range(2):
        mirrored = _once(mirrored, low_hz, high_hz, rate_hz)[::-1]
    return mirrored[_EDGE:-_EDGE]


def _once(values: Doubles, low_hz: float, high_hz: float, rate_hz: float) -> Doubles:
    """One causal pass, by way of the spectrum; padded until the filter has settled, so that nothing wraps around."""
    low, high = (np.tan(np.pi * edge_hz / rate_hz) for edge_hz in (low_hz, high_hz))  # prewarped for the bilinear map
    settled = int(-np.log(_SETTLED) / min(low, high - low)) + 1
    size = 1 << int(len(values) + settled - 1).bit_length()
    s = 1j * np.tan(np.pi * np.arange(size // 2 + 1) / size)  # on the unit circle; infinite at half the rate
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        p = (s * s + low * high) / ((high - low) * s)  # low-pass prototype -> band-pass
        response = 1.0 / (p * p + np.sqrt(2) * p + 1.0)
    response[[0, -1]] = 0.0
    passed: Doubles = np.fft.irfft(np.fft.rfft(values - values[0], size) * response, size)[: len(values)]
    return passed


def _maxima(values: Doubles) -> Indices:
    """Samples higher than both neighbours; the middle of a plateau, the lower of two middles."""
    if len(values) < 3:
        return np.zeros(0, dtype=np.intp)
    starts = np.flatnonzero(np.r_[True, np.diff(values) != 0])  # of stretches of equal values
    ends = np.r_[starts[1:], len(values)] - 1
    level = values[starts]
    inner = np.arange(1, len(level) - 1)
    top = inner[(level[inner] > level[inner - 1]) & (level[inner] > level[inner + 1])]
    middles: Indices = (starts[top] + ends[top]) // 2
    return middles


def _far_apart(peaks: Indices, heights: Doubles, distance: int) -> NDArray[np.bool_]:
    keep = np.ones(len(peaks), dtype=np.bool_)
    for best in np.argsort(heights)[::-1]:
        if keep[best]:
            near = np.abs(peaks - peaks[best]) < distance
            near[best] = False
            keep[near] = False
    return keep


def _prominences(values: Doubles, peaks: Indices) -> Doubles:
    """How far one has to come down from each peak, on either side, before one can climb higher.

    Only turning points are walked: a tick of the loop may wait for it.
    """
    turns = np.unique(np.r_[0, _maxima(values), _maxima(-values), len(values) - 1])
    levels = values[turns].tolist()
    before, after = _lowest_since_higher(levels), _lowest_since_higher(levels[::-1])[::-1]
    at = np.searchsorted(turns, peaks)
    prominences: Doubles = values[peaks] - np.maximum(np.array(before)[at], np.array(after)[at])
    return prominences


def _lowest_since_higher(levels: Sequence[float]) -> list[float]:
    """Of each level, the lowest one since a higher one came, its own included."""
    lowest: list[float] = []
    falling: list[tuple[float, float]] = []  # levels that are still in sight, each with its lowest
    for level in levels:
        low = level
        while falling and falling[-1][0] <= level:
            low = min(low, falling.pop()[1])
        falling.append((level, low))
        lowest.append(low)
    return lowest
