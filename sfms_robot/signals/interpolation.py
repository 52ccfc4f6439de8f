"""A sampled signal between its samples, by a windowed sinc: for rates that are odd, or change while they run."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles, Floats

_TAPS: Final = 32
_PHASES: Final = 4096  # of one sample: the nearest is taken, which is 70 dB exact
_BETA: Final = 8.0  # of the Kaiser window


def _kernels() -> Floats:
    """(phases + 1, taps): the weights of the samples around an instant, by how far it is behind the one before it."""
    behind = np.arange(_PHASES + 1)[:, None] / _PHASES - _AROUND
    inside = np.clip(1.0 - (2.0 * behind / _TAPS) ** 2, 0.0, 1.0)
    kernels = np.sinc(behind) * np.i0(_BETA * np.sqrt(inside)) / np.i0(_BETA)
    return np.asarray(kernels / kernels.sum(axis=1, keepdims=True), dtype=np.float32)


_AROUND: Final = np.arange(1 - _TAPS // 2, 1 + _TAPS // 2)
_KERNELS: Final = _kernels()


def at_positions(samples: Floats, positions: Doubles) -> Floats:
    """The signal (n,), n > 0, at `positions` (m,) in samples, whole or not; before its first and behind its last sample
    it is 0. Exact at whole positions; elsewhere within -60 dB up to 0.8 of half its rate.
    """
    before = np.floor(positions)
    phases = np.rint((positions - before) * _PHASES).astype(np.intp)
    around: NDArray[np.intp] = before.astype(np.intp)[:, None] + _AROUND
    known = (around >= 0) & (around < len(samples))
    taken = np.where(known, samples[np.clip(around, 0, len(samples) - 1)], np.float32(0))
    signal: Floats = np.einsum("mt,mt->m", _KERNELS[phases], taken)
    return signal
