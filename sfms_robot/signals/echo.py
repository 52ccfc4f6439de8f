"""Echo cancellation: removal of the robot's own loudspeaker from a microphone signal.

An adaptive filter removes the linear echo, WebRTC's AEC3 (`pywebrtc-audio`) the rest. AEC3 alone mutes a person who
talks over an equally loud loudspeaker; after the filter it has little to mute. After half a second without own voice
its output is not used at all, because its high-pass filter harms speech detection a lot in low motor noise. Speech over
the loudspeaker is detected in the output of the adaptive filter, which does not mute voices.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import AUDIO_HZ, Doubles, Floats

ECHO_LATENCY_SAMPLES: Final = 128  # latency of AEC3's filter bank, 8 ms
_TAIL_BLOCKS: Final = 50  # blocks of 10 ms after the reference's end, for echoes and AEC3's longest delay
_SILENCE: Final = 1e-3  # of full scale
BLOCK: Final = 160  # samples, 10 ms
PARTITIONS: Final = 25  # of 10 ms: echoes up to 250 ms after the reference
_FORGETTING: Final = 0.9995  # per block; allows for changes of the room
_NOISE_MEMORY: Final = 0.7  # per block, for the power that the echo does not explain
_LEAST_POWER: Final = 1e-10
_OVERRATED: Final = 0.3  # share of the expected echo, which is 10 to 20 dB above the measured; more still disturbs

Spectrum = NDArray[np.complex128]


class EchoFilter:
    """Adaptive filter from the loudspeaker's samples to their linear echo in the microphone.

    A partitioned-block Kalman filter in the frequency domain (Enzner and Vary 2006, Kuech et al. 2014).

    Its step size follows from its own uncertainty and the power that the echo does not explain: when a person talks
    over the loudspeaker it adapts slowly, so that no detector of double talk is needed. Memory is fixed; no latency.

    Attributes:
        residual_power: (161,) power of the echo expected in the output of the last block.
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
        """Return one block (160,) of the microphone without the echo of the reference (160,) as estimated so far."""
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
        """Update weights and variance (Kalman); the gradient keeps its causal half (overlap-save)."""
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


class Cancelled(NamedTuple):
    """Whole blocks of 10 ms after echo cancellation.

    Attributes:
        audio: (b * 160,) without echo, `ECHO_LATENCY_SAMPLES` late.
        linear: (b * 160,) output of the filter alone, not late.
        residual_power: (b, 161) power of the echo expected in each block of `linear` (`EchoFilter`).
    """

    audio: Floats
    linear: Floats
    residual_power: Doubles


class EchoCanceller:
    """Echo canceller for blocks of 10 ms; the output does not depend on the number of blocks per call.

    Causal; the output is `ECHO_LATENCY_SAMPLES` late. Memory is fixed. AEC3 finds a loudspeaker's delay up to half a
    second; the filter covers the first 250 ms. Without a reference the microphone is only delayed.
    """

    def __init__(self) -> None:
        from pywebrtc_audio import EchoCanceller as Aec3

        self._filter = EchoFilter()
        self._suppressor = Aec3(AUDIO_HZ)
        self._past: Floats = np.zeros(ECHO_LATENCY_SAMPLES, np.float32)
        self._silent_blocks = _TAIL_BLOCKS
        self._share = 0.0  # share of AEC3 in the output

    def push(self, mic: Floats, reference: Floats) -> Cancelled:
        """Return (b * 160,) samples, b > 0, of a microphone without the echo of the reference at the same instants.

        Both at 16 kHz, -1..1. `reference` must not be later than its echo.
        """
        blocks = zip(np.split(mic, len(mic) // BLOCK), np.split(reference, len(mic) // BLOCK), strict=True)
        return Cancelled(*map(np.concatenate, zip(*(self._block(*each) for each in blocks), strict=True)))

    def _block(self, mic: Floats, reference: Floats) -> Cancelled:
        silent = float(np.abs(reference).max()) < _SILENCE
        self._silent_blocks = self._silent_blocks + 1 if silent else 0
        left = self._filter.push(mic.astype(np.float64), reference.astype(np.float64)).astype(np.float32)
        suppressed = self._suppressor.process(np.clip(left, -1.0, 1.0), reference)
        seen = np.concatenate([self._past, left])
        self._past = seen[BLOCK:]
        share = 0.0 if self._silent_blocks >= _TAIL_BLOCKS else 1.0
        ramp = np.linspace(self._share, share, BLOCK, dtype=np.float32)
        self._share = share
        cleaned: Floats = ramp * suppressed + (1 - ramp) * seen[:BLOCK]
        return Cancelled(cleaned, left, self._filter.residual_power[None])
