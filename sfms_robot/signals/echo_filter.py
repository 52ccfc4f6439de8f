"""Adaptive filter from what a loudspeaker is given to what the microphone hears of it: the linear echo."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles

BLOCK: Final = 160  # samples, 10 ms
PARTITIONS: Final = 25  # of 10 ms: echoes up to 250 ms after the reference
_FORGETTING: Final = 0.9995  # per block: how far the room may change
_NOISE_MEMORY: Final = 0.7  # per block, of the power that no echo explains
_LEAST_POWER: Final = 1e-10

_OVERRATED: Final = 0.3  # its uncertainty says 10 to 20 dB more echo than measured; more than that still disturbs

Spectrum = NDArray[np.complex128]


class EchoFilter:
    """Partitioned-block Kalman filter in the frequency domain (Enzner and Vary 2006, Kuech et al. 2014).

    Its step size follows from its own uncertainty and from what the echo does not explain: when a person talks over the
    loudspeaker it adapts slowly by itself, so nothing has to detect double talk. Memory is fixed; no latency.

    Attributes:
        residual_power: (161,) of the echo that it expects to have left in the last block.
    """

    def __init__(self) -> None:
        shape = (PARTITIONS, BLOCK + 1)
        self._reference: Doubles = np.zeros(2 * BLOCK)
        self._spectra: Spectrum = np.zeros(shape, np.complex128)
        self._weights: Spectrum = np.zeros(shape, np.complex128)
        self._variance: Doubles = np.ones(shape)  # of the weights' error
        self._noise: Doubles = np.full(BLOCK + 1, 1e-4)
        self.residual_power: Doubles = np.zeros(BLOCK + 1)

    def push(self, mic: Doubles, reference: Doubles) -> Doubles:
        """One block (160,) of each -> (160,) the microphone without the echo that the filter knows."""
        self._reference = np.concatenate([self._reference[BLOCK:], reference])
        self._spectra = np.roll(self._spectra, 1, axis=0)
        self._spectra[0] = np.fft.rfft(self._reference)
        echo = np.fft.irfft((self._spectra * self._weights).sum(axis=0))[BLOCK:]
        left: Doubles = mic - echo
        self.residual_power = np.zeros(BLOCK + 1)
        if self._spectra.any():
            self._adapt(np.fft.rfft(np.concatenate([np.zeros(BLOCK), left])))
        return left

    def _adapt(self, error: Spectrum) -> None:
        """Kalman update of weights and variance; the gradient keeps its causal half (overlap-save)."""
        self._noise = _NOISE_MEMORY * self._noise + (1 - _NOISE_MEMORY) * np.abs(error) ** 2
        power = np.abs(self._spectra) ** 2
        unknown = (power * self._variance).sum(axis=0)
        self.residual_power = _OVERRATED * unknown
        step = self._variance / (unknown + 2 * self._noise + _LEAST_POWER)
        gradient = np.fft.irfft(step * self._spectra.conj() * error, axis=1)
        gradient[:, BLOCK:] = 0.0
        self._weights = _FORGETTING * (self._weights + np.fft.rfft(gradient, axis=1))
        known = _FORGETTING**2 * (1 - 0.5 * step * power) * self._variance
        self._variance = known + (1 - _FORGETTING**2) * np.abs(self._weights) ** 2
