"""Log-mel spectrogram, causal: four rows of 128 bins for every 40 ms frame, one code path offline and streaming.

Each row looks back over 25 ms and a new one is due every 10 ms. A stream has to remember the samples that its next rows
need: 240 of them after whole frames. A recording begins as if after silence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Doubles, Floats

MEL_BINS: Final = 128
HOP: Final = 160
WINDOW: Final = 400
FFT: Final = 512
ROWS_PER_FRAME: Final = FRAME_SAMPLES // HOP  # 4
LN_PER_DB: Final = math.log(10) / 10  # of power; the rows are its natural logarithm
FLOOR: Final = 1e-6  # added to the power: about -80 dB below full scale


def start() -> Floats:
    """Return the past of a new stream: (240,) zeros."""
    return np.zeros(WINDOW - HOP, dtype=np.float32)


def log_mel(samples: Floats, past: Floats) -> tuple[Floats, Floats]:
    """Return the rows that `samples` complete, and the past of the next call.

    Args:
        samples: (n,) mono 16 kHz, -1..1; any n.
        past: the past that the last call returned, or `start()`; not changed.

    Returns:
        (rows, 128) natural log of mel power, and the samples to pass to the next call (240 to 399 of them).
    """
    rows, (after,) = log_mel_each([samples], [past])
    return rows, after


def log_mel_each(samples: Sequence[Floats], pasts: Sequence[Floats]) -> tuple[Floats, list[Floats]]:
    """Return `log_mel` of several streams: their rows, one stream after the other, and the past of each."""
    windows, after = [], []
    for new, past in zip(samples, pasts, strict=True):
        seen = np.concatenate([past, new]).astype(np.float32)
        rows = max(0, (len(seen) - WINDOW) // HOP + 1)
        windows.append(np.ndarray((rows, WINDOW), np.float32, seen, strides=(HOP * seen.itemsize, seen.itemsize)))
        after.append(seen[rows * HOP :].copy())
    return _rows(windows[0] if len(windows) == 1 else np.concatenate(windows)), after


def _rows(windows: Floats) -> Floats:
    """Return the rows (rows, 128) of windows (rows, 400). Each is summed alone, so it never depends on their number."""
    spectrum = np.fft.rfft(windows * _HANN, FFT)
    power = spectrum.real**2 + spectrum.imag**2
    mel = np.add.reduceat(power[:, _BINS] * _WEIGHTS, _FIRST, axis=1)
    return np.asarray(np.log(mel + FLOOR), dtype=np.float32)


def _mel(hz: Doubles | float) -> Doubles:
    return 2595.0 * np.log10(1.0 + np.asarray(hz, dtype=np.float64) / 700.0)


def triangles(edges: Doubles, places: Doubles, least: float = 0.0) -> Doubles:
    """Return filters (K, N) at `places` (N,): each rises to 1 and falls to 0 over three of the edges (K + 2,).

    `least`: least width of each side.
    """
    low, centre, high = edges[:-2, None], edges[1:-1, None], edges[2:, None]
    rise = (places - centre) / np.maximum(centre - low, least) + 1.0
    fall = (centre - places) / np.maximum(high - centre, least) + 1.0
    return np.maximum(0.0, np.minimum(rise, fall))


def _filters() -> Doubles:
    """Return (128, 257) triangles equally spaced in mel, each at least one FFT bin wide so that none is empty."""
    edges_hz = 700.0 * (10 ** (np.linspace(_mel(20.0), _mel(AUDIO_HZ / 2), MEL_BINS + 2) / 2595.0) - 1.0)
    bins_hz = np.linspace(0, AUDIO_HZ / 2, FFT // 2 + 1)
    return triangles(edges_hz, bins_hz, float(bins_hz[1]))


_HANN: Final = np.hanning(WINDOW + 1)[:-1]
_FILTERS: Final = _filters()
_FILTER, _BINS = np.nonzero(_FILTERS)  # filter and bin of each value that is not 0, one filter after the other
_WEIGHTS: Final = _FILTERS[_FILTER, _BINS]
_FIRST: Final = np.searchsorted(_FILTER, np.arange(MEL_BINS))
