"""How Learning2Listen prepares its data. Offline only.

Source: evonneng/learning2listen @ a0825d58: definitions only.

Its mel rows, made anew from sound: `signals.mel` is what our listeners hear, causal, natural log, a row every 10 ms.
L2L ships power, and a row count of four a frame at 30 fps. As Boese0601/Dyadic-Interaction-Modeling @ 9fc92f72 makes it
for new recordings: windows of 25 ms every 10 ms centred on their instant, 128 bins of Slaney's mel scale and norm, then
the time axis resized to 4T by a Lanczos filter, which looks ahead and may ring below zero.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfms_robot.frames import AUDIO_HZ, Doubles, Floats
from sfms_robot.signals.mel import FFT, HOP, MEL_BINS, ROWS_PER_FRAME, WINDOW, triangles

STD_EPS: Final = 1e-10
BILATERAL_RADIUS: Final = 2  # cv2's d = 5
BILATERAL_SIGMA: Final = 20.0  # both of value and of place
_LINEAR_HZ: Final = 200.0 / 3  # per mel, up to
_KNEE_HZ: Final = 1000.0  # from where on the scale is logarithmic
_LOG_STEP: Final = np.log(6.4) / 27
_LOBES: Final = 3


def l2l_mean_std(x: ArrayLike) -> tuple[Doubles, Doubles]:
    """Clips (N, T, D) -> mean and "std" (1, 1, D) that L2L standardises with.

    The std is that over clips of the stds over time, which makes standardised errors several times larger than one
    would think.
    """
    clips = np.asarray(x, dtype=np.float64)
    if clips.ndim != 3:
        raise ValueError(f"clips are (N, T, D), got shape {clips.shape}")
    mean: Doubles = clips.mean(axis=1).mean(axis=0)[None, None]
    std: Doubles = clips.std(axis=1).std(axis=0)[None, None] + STD_EPS
    return mean, std


def l2l_bilateral(x: ArrayLike) -> Doubles:
    """Smooth clips (..., T, D) over time as L2L does before anything else: cv2's bilateral filter, d 5, sigmas 20.

    A channel is an image of width 1 with reflected borders, so the circular neighbourhood holds the frame itself five
    times, the next ones three times and the second next once.
    """
    clips = np.asarray(x, dtype=np.float64)
    frames = clips.shape[-2]
    total, weights = np.zeros_like(clips), np.zeros_like(clips)
    for step in range(-BILATERAL_RADIUS, BILATERAL_RADIUS + 1):
        place = _reflected(np.arange(frames) + step, frames)
        neighbour = clips[..., place, :]
        near = np.exp(-((neighbour - clips) ** 2) / (2 * BILATERAL_SIGMA**2))
        for across in range(-BILATERAL_RADIUS, BILATERAL_RADIUS + 1):
            distance2 = step**2 + across**2
            if distance2 <= BILATERAL_RADIUS**2:
                weight = near * np.exp(-distance2 / (2 * BILATERAL_SIGMA**2))
                total += weight * neighbour
                weights += weight
    smooth: Doubles = total / weights
    return smooth


def _reflected(index: NDArray[np.int_], size: int) -> NDArray[np.int_]:
    """Reflect-101: ... 2 1 | 0 1 2 ... n-1 | n-2 ..."""
    if size == 1:
        return np.zeros_like(index)
    period = 2 * (size - 1)
    folded = np.abs(index) % period
    inside: NDArray[np.int_] = np.minimum(folded, period - folded)
    return inside


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
    return np.asarray(triangles(edges, bins) * 2.0 / (edges[2:, None] - edges[:-2, None]))
