"""The mel rows that Learning2Listen's predictor was trained on, made anew from sound. Offline only.

`signals.mel` is what our listeners hear: causal, natural log, a row every 10 ms. L2L ships power, and a row count of
four a frame at 30 fps. As Boese0601/Dyadic-Interaction-Modeling @ 9fc92f72 makes it for new recordings: windows of
25 ms every 10 ms centred on their instant, 128 bins of Slaney's mel scale and norm, then the time axis resized to 4T
by a Lanczos filter, which looks ahead and may ring below zero.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from sfms_robot.frames import AUDIO_HZ, Doubles, Floats
from sfms_robot.signals.mel import FFT, HOP, MEL_BINS, ROWS_PER_FRAME, WINDOW

_LINEAR_HZ: Final = 200.0 / 3  # per mel, up to
_KNEE_HZ: Final = 1000.0  # from where on the scale is logarithmic
_LOG_STEP: Final = np.log(6.4) / 27
_LOBES: Final = 3


def l2l_mel(samples: Floats, frames: int) -> Floats:
    """(n,) mono 16 kHz -> (4 frames, 128) mel power of the whole recording, whatever its length."""
    padded = np.pad(samples.astype(np.float64), FFT // 2)
    windows = np.lib.stride_tricks.sliding_window_view(padded, FFT)[::HOP]
    margin = (FFT - WINDOW) // 2
    hann = np.pad(np.hanning(WINDOW + 1)[:-1], margin)
    power = np.abs(np.fft.rfft(windows * hann, FFT)) ** 2 @ _filters().T
    return np.asarray(lanczos(power, ROWS_PER_FRAME * frames), dtype=np.float32)


def lanczos(rows: Doubles, wanted: int) -> Doubles:
    """(T, D) -> (wanted, D): windowed sinc of three lobes, widened when it shrinks, as Pillow resizes an image."""
    scale = len(rows) / wanted
    wide = max(scale, 1.0)
    out = np.empty((wanted, rows.shape[1]))
    for index in range(wanted):
        centre = (index + 0.5) * scale
        first = max(0, int(centre - _LOBES * wide + 0.5))
        last = min(len(rows), int(centre + _LOBES * wide + 0.5))
        place = (np.arange(first, last) - centre + 0.5) / wide
        weights = np.where(np.abs(place) < _LOBES, np.sinc(place) * np.sinc(place / _LOBES), 0.0)
        out[index] = weights @ rows[first:last] / weights.sum()
    return out


def _mel(hz: Doubles | float) -> Doubles:
    linear = np.asarray(hz, dtype=np.float64) / _LINEAR_HZ
    return np.where(linear < 15, linear, 15 + np.log(np.maximum(linear / 15, 1e-10)) / _LOG_STEP)


def _hz(mel: Doubles) -> Doubles:
    return np.where(mel < 15, mel * _LINEAR_HZ, _KNEE_HZ * np.exp(_LOG_STEP * (mel - 15)))


@lru_cache
def _filters() -> Doubles:
    """(128, 257) triangles in Hz between points equally spaced in mel, each of area 1 per Hz."""
    edges = _hz(np.linspace(0.0, _mel(AUDIO_HZ / 2), MEL_BINS + 2))
    bins = np.linspace(0, AUDIO_HZ / 2, FFT // 2 + 1)
    low, centre, high = edges[:-2, None], edges[1:-1, None], edges[2:, None]
    triangles = np.maximum(0.0, np.minimum((bins - low) / (centre - low), (high - bins) / (high - centre)))
    return np.asarray(triangles * 2.0 / (high - low))
