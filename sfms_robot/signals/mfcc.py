"""The 78 features per frame of REACT's baselines: Kaldi MFCCs of each 40 ms frame alone, without past or future.

A frame has two windows of 25 ms, 10 ms apart, with 13 cepstra each (the first is log energy). The features are these,
their deltas and the deltas of the deltas, flattened as (3, 13, 2). reactmultimodalchallenge/baseline_react2023 @
c5a8ff85 computes them by torchaudio's port of Kaldi (compute-mfcc-feats with energy, without dither), on samples within
-1..1: speech is mostly below Kaldi's energy floor of 1, so the first cepstrum is mostly 0 there and here.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Doubles, Floats, Reals
from sfms_robot.signals.mel import FFT, HOP, WINDOW, triangles

DIM: Final = 78
CEPSTRA: Final = 13
MEL_BINS: Final = 23
LOW_HZ: Final = 20.0
PREEMPHASIS: Final = 0.97
LIFTER: Final = 22.0
ENERGY_FLOOR: Final = 1.0
EPSILON: Final = float(np.finfo(np.float32).eps)


def mfcc78(samples: Floats) -> Floats:
    """Return (frames, 78) of samples (n,) mono 16 kHz -1..1, one row for every whole frame of 40 ms.

    Frames are independent of one another, so a stream uses the same call.
    """
    frames = len(samples) // FRAME_SAMPLES
    chunks = samples[: frames * FRAME_SAMPLES].reshape(frames, FRAME_SAMPLES).astype(np.float64)
    cut = np.lib.stride_tricks.sliding_window_view(chunks, WINDOW, axis=1)[:, ::HOP]  # Kaldi's snip-edges
    static = np.moveaxis(cepstra(cut), 1, 2)[..., :2]  # (frames, 13, 2)
    delta = deltas(static)
    return np.asarray(np.stack([static, delta, deltas(delta)], axis=1).reshape(frames, DIM), dtype=np.float32)


def cepstra(windows: Reals) -> Doubles:
    """Return cepstra (..., 13) of windows (..., 400): Kaldi's defaults, with log energy in place of the first."""
    centred = windows - windows.mean(axis=-1, keepdims=True)
    energy = np.log(np.maximum(np.square(centred).sum(axis=-1), ENERGY_FLOOR))
    before = np.concatenate([centred[..., :1], centred[..., :-1]], axis=-1)
    povey = np.hanning(WINDOW) ** 0.85
    power = np.abs(np.fft.rfft((centred - PREEMPHASIS * before) * povey, FFT)) ** 2
    logs = np.log(np.maximum(power[..., :-1] @ _filters().T, EPSILON))
    from scipy.fft import dct  # takes a quarter of a second, and few listeners use these features

    out: Doubles = dct(logs, type=2, norm="ortho", axis=-1)[..., :CEPSTRA]
    out = out * (1.0 + 0.5 * LIFTER * np.sin(np.pi * np.arange(CEPSTRA) / LIFTER))
    out[..., 0] = energy
    return out


def deltas(values: Doubles) -> Doubles:
    """Return the slope over time (..., T) by regression over five frames, the ends repeated."""
    from scipy.ndimage import correlate1d

    slopes: Doubles = correlate1d(values, np.arange(-2, 3) / 10.0, mode="nearest")
    return slopes


@lru_cache
def _filters() -> Doubles:
    """Return (23, 256) triangles equally spaced in mel from 20 Hz up; the bin at half the rate is not used."""
    edges = np.linspace(_mel(LOW_HZ), _mel(AUDIO_HZ / 2), MEL_BINS + 2)
    return triangles(edges, _mel(np.arange(FFT // 2) * AUDIO_HZ / FFT))


def _mel(hz: Doubles | float) -> Doubles:
    return 1127.0 * np.log(1.0 + np.asarray(hz, dtype=np.float64) / 700.0)
