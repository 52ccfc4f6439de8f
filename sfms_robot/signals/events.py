"""Detection of nods, blinks and smiles in a motion.

Pure functions on arrays sampled at `rate_hz` (25 in this project). An event is (start_s, end_s, size).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.frames import BLINKS, CHANNEL_INDEX, SMILE_CORNERS, Doubles, Indices, Reals

Event = tuple[float, float, float]
_NOD_RAD: Final = np.deg2rad(1.6)
_BLINK, _SMILE = 0.35, 0.2
_SHORTEST: Final = 16  # samples that the zero-phase filter needs


def find_nods(pitch_rad: ArrayLike, rate_hz: float) -> list[Event]:
    """Find nods in a head pitch (N,): swings down and back (or back and down) of 1.6 degrees peak to peak or more.

    Returns (start_s, end_s, peak-to-peak rad) in order. Only swings faster than about 0.8 Hz count, and only
    those that come back: a gaze shift goes one way, a drift is slow. Swings less than 0.3 s apart are one nod.
    """
    pitch = np.asarray(pitch_rad, np.float64)
    if len(pitch) < max(int(rate_hz), _SHORTEST):
        return []
    swing = band_pass(pitch, 0.8, min(6.0, 0.45 * rate_hz), rate_hz)
    highs, lows = (find_peaks(way, 0.35 * _NOD_RAD)[0] for way in (swing, -swing))
    turns = sorted({0, len(swing) - 1, *highs.tolist(), *lows.tolist()})
    found: list[Event] = []
    for a, b, c in zip(turns[:-2], turns[1:-1], turns[2:], strict=True):
        down, up = abs(swing[b] - swing[a]), abs(swing[c] - swing[b])
        spread = np.ptp(pitch[a : c + 1])
        returned = abs(pitch[c] - pitch[a]) < 0.4 * spread
        if min(down, up) < 0.5 * _NOD_RAD or spread < _NOD_RAD or not returned:
            continue
        if not 0.15 <= (c - a) / rate_hz <= 1.4:
            continue
        if found and a / rate_hz - found[-1][1] < 0.3:
            start, _, size = found.pop()
            found.append((start, c / rate_hz, max(size, float(spread))))
        else:
            found.append((a / rate_hz, c / rate_hz, float(spread)))
    return [event for event in found if event[1] - event[0] <= 6]


def find_blinks(blink: ArrayLike, rate_hz: float) -> list[Event]:
    """Find blinks in a lid closure (N,) 0..1: rises by 0.35 that are over within 0.6 s. One frame is enough.

    Returns (start_s, end_s, height), measured from the closure around it, so that resting lids may be half closed.
    """
    framed = np.r_[0.0, np.asarray(blink, np.float64), 0.0]
    peaks, heights = find_peaks(framed, _BLINK, max(1, int(0.12 * rate_hz)))
    rows = zip(*(each.tolist() for each in (*half_widths(framed, peaks, heights), heights)), strict=True)
    return [((a - 1) / rate_hz, (b - 1) / rate_hz, height) for a, b, height in rows if (b - a) / rate_hz <= 0.6]


def find_smiles(smile: ArrayLike, rate_hz: float) -> list[Event]:
    """Find smiles in a mouthSmile (N,): above 0.2 for 0.4 s or more; ends where it falls below half of that.

    Returns (start_s, end_s, peak).
    """
    level = np.asarray(smile, np.float64)
    found: list[Event] = []
    for start, end in runs(level > 0.5 * _SMILE):
        peak = float(level[start:end].max())
        if peak > _SMILE and np.count_nonzero(level[start:end] > _SMILE) >= 0.4 * rate_hz:
            found.append((start / rate_hz, end / rate_hz, peak))
    return found


@dataclass(frozen=True)
class EventKind:
    """Detector of one kind of event in motion.

    Attributes:
        signal: motion (..., 58) -> the signal (...,) that shows the event.
        find: signal (N,) and its rate -> events in order.
        whole: True if the event is reported only when it is over.
    """

    signal: Callable[[Reals], Reals]
    find: Callable[[ArrayLike, float], list[Event]]
    whole: bool


CORNERS: Final = [CHANNEL_INDEX[name] for name in SMILE_CORNERS]

# Definitions of a nod, a blink and a smile of a face, for the report, callbacks and evaluation.
MOTION_EVENTS: Final[Mapping[str, EventKind]] = {
    "nod": EventKind(lambda motion: motion[..., CHANNEL_INDEX["pitch"]], find_nods, whole=True),
    "blink": EventKind(lambda motion: motion[..., BLINKS].max(axis=-1), find_blinks, whole=True),
    "smile": EventKind(lambda motion: motion[..., CORNERS].mean(axis=-1), find_smiles, whole=False),
}


def runs(mask: ArrayLike) -> list[tuple[int, int]]:
    """Return half-open [start, end) of every run of True in (N,)."""
    bounds = np.flatnonzero(np.diff(np.r_[0, np.asarray(mask, np.int8), 0]))
    return list(zip(bounds[::2].tolist(), bounds[1::2].tolist(), strict=True))


# --- Peaks and a zero-phase band-pass: numpy versions of scipy.signal -------------------------------------------------
#
# scipy needs 1.5 s and 60 MB to load, in a process that drives servos a hundred times a second. These functions return
# the same numbers (tests compare them).


_SETTLED: Final = 1e-12  # remaining share of a step at which the filter counts as settled
_EDGE: Final = 15  # samples mirrored at both ends, as scipy.signal.sosfiltfilt does for this order


def find_peaks(values: Doubles, prominence: float, distance: int = 1) -> tuple[Indices, Doubles]:
    """Find local maxima of (N,) with `prominence` or more, at least `distance` samples apart, and their prominences.

    The middle of a plateau is its peak. Of two that are too close the higher one is kept, of equal ones the later.
    """
    peaks = _maxima(values)
    apart = np.ones(len(peaks), dtype=np.bool_)
    for best in np.argsort(values[peaks])[::-1]:
        if apart[best]:
            apart &= np.abs(peaks - peaks[best]) >= distance
            apart[best] = True
    peaks = peaks[apart]
    prominences = _prominences(values, peaks)
    keep = prominences >= prominence
    return peaks[keep], prominences[keep]


def half_widths(values: Doubles, peaks: Indices, prominences: Doubles) -> tuple[Doubles, Doubles]:
    """Return where (N,) crosses half of each peak's prominence, left and right of it, linear between samples."""
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
    """Filter (N,), N > 15, by a Butterworth band-pass of second order forwards and backwards, so without delay.

    As in scipy.signal.sosfiltfilt, both ends are mirrored through their last value. Before and after that the signal
    counts as constant, which a band-pass does not let through. So both passes begin at rest.
    """
    start, end = 2 * values[0] - values[_EDGE:0:-1], 2 * values[-1] - values[-2 : -_EDGE - 2 : -1]
    mirrored = np.concatenate([start, values, end])
    # Each pass is causal, by the spectrum; padded until the filter has settled, so that nothing wraps around.
    low, high = (np.tan(np.pi * edge_hz / rate_hz) for edge_hz in (low_hz, high_hz))  # prewarped for the bilinear map
    settled = int(-np.log(_SETTLED) / min(low, high - low)) + 1
    size = 1 << int(len(mirrored) + settled - 1).bit_length()
    s = 1j * np.tan(np.pi * np.arange(size // 2 + 1) / size)  # on the unit circle; infinite at half the rate
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        p = (s * s + low * high) / ((high - low) * s)  # low-pass prototype -> band-pass
        response = 1.0 / (p * p + np.sqrt(2) * p + 1.0)
    response[[0, -1]] = 0.0
    for _ in range(2):
        passed = np.fft.irfft(np.fft.rfft(mirrored - mirrored[0], size) * response, size)
        mirrored = passed[: len(mirrored)][::-1]
    return mirrored[_EDGE:-_EDGE]


def _maxima(values: Doubles) -> Indices:
    """Return the indices of samples higher than both neighbours; of a plateau the middle, the lower of two middles."""
    if len(values) < 3:
        return np.zeros(0, dtype=np.intp)
    starts = np.flatnonzero(np.r_[True, np.diff(values) != 0])  # of stretches of equal values
    ends = np.r_[starts[1:], len(values)] - 1
    level = values[starts]
    inner = np.arange(1, len(level) - 1)
    top = inner[(level[inner] > level[inner - 1]) & (level[inner] > level[inner + 1])]
    middles: Indices = (starts[top] + ends[top]) // 2
    return middles


def _prominences(values: Doubles, peaks: Indices) -> Doubles:
    """Return the depth that separates each peak from the next higher one, on the side where it is smaller.

    Only turning points are visited, because a tick of the loop may wait for this function.
    """
    turns = np.unique(np.r_[0, _maxima(values), _maxima(-values), len(values) - 1])
    levels = values[turns].tolist()
    before, after = _lowest_since_higher(levels), _lowest_since_higher(levels[::-1])[::-1]
    at = np.searchsorted(turns, peaks)
    prominences: Doubles = values[peaks] - np.maximum(np.array(before)[at], np.array(after)[at])
    return prominences


def _lowest_since_higher(levels: Sequence[float]) -> list[float]:
    """Return for each level the lowest level since the last higher one, itself included."""
    lowest: list[float] = []
    falling: list[tuple[float, float]] = []  # levels that no later one has reached, each with its lowest level
    for level in levels:
        low = level
        while falling and falling[-1][0] <= level:
            low = min(low, falling.pop()[1])
        falling.append((level, low))
        lowest.append(low)
    return lowest
