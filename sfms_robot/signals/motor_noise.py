"""The noise of a head's own motors: its spectrum at every speed, learned while nobody speaks, and speech without it.

A Wiener filter after Ephraim and Malah's decision-directed estimate of how much speech there is (1984). The commanded
speed says which spectrum to expect, so noise that comes and goes with every nod needs no time to be tracked. Only the
speech network hears the result: what the filter does to a voice is not meant for ears.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfms_robot.frames import FRAME_SAMPLES, Doubles, Floats

SPEED_EDGES_RAD_S: Final = np.geomspace(0.03, 20.0, 14)  # of all joints together
STILL_RAD_S: Final = 0.1
SUPPRESSION_LATENCY_SAMPLES: Final = 160  # half a window: 10 ms
_WINDOW: Final = 2 * SUPPRESSION_LATENCY_SAMPLES
_BINS: Final = _WINDOW // 2 + 1
_STEP: Final = 0.0125  # per window: of a mean spectrum towards what is heard
_OVERSUBTRACTION: Final = 1.5
_LEAST_GAIN: Final = 0.1
_MEMORY: Final = 0.9  # of the speech found in the window before
_QUIETEST: Final = 1e-14
_VOICE_BINS: Final = slice(4, 80)  # 200 to 4000 Hz


class MotorNoise:
    """Mean power spectrum for each range of the summed speed of all joints. Causal; memory is fixed.

    A range that was never met has the spectrum of nothing: there a frame passes as it is.

    Attributes:
        left_db: of the last frame between 200 and 4000 Hz, in the window that kept most: its level against before.
    """

    def __init__(self) -> None:
        self._noise: Doubles = np.full((len(SPEED_EDGES_RAD_S) + 1, _BINS), _QUIETEST)
        self._met = np.zeros(len(self._noise), np.int64)
        self._past: Doubles = np.zeros(SUPPRESSION_LATENCY_SAMPLES)
        self._past_echo: Doubles = np.zeros((1, _BINS))
        self._overlap: Doubles = np.zeros(SUPPRESSION_LATENCY_SAMPLES)
        self._speech: Doubles = np.zeros(_BINS)  # power of the speech in the last window
        self._last: tuple[int, Doubles] = (0, np.zeros((0, _BINS)))  # range and power spectra of the last frame
        self.left_db = 0.0

    def suppress(self, frame: Floats, speed_rad_s: ArrayLike, echo_power: Doubles | None = None) -> Floats:
        """The next frame (640,) -> (640,) without the noise of that speed, `SUPPRESSION_LATENCY_SAMPLES` late.

        `speed_rad_s`: one number or (J,), signs do not matter. `echo_power` (4, 161): of own voice that is still in
        each 10 ms of the frame, to be taken away too; None for none.
        """
        seen = np.concatenate([self._past, frame])
        self._past = seen[FRAME_SAMPLES:]
        windows = np.lib.stride_tricks.sliding_window_view(seen, _WINDOW)[::SUPPRESSION_LATENCY_SAMPLES]
        spectra = np.fft.rfft(windows * _TAPER)  # (4, 161)
        power = np.abs(spectra) ** 2
        at = int(np.searchsorted(SPEED_EDGES_RAD_S, total_speed(speed_rad_s)))
        self._last = at, power
        echoes = np.concatenate([self._past_echo, np.zeros((4, _BINS)) if echo_power is None else echo_power])
        self._past_echo = echoes[-1:]
        gains = self._gains(power, _OVERSUBTRACTION * self._noise[at] + 0.5 * (echoes[:-1] + echoes[1:]) + _QUIETEST)
        self.left_db = _most_left_db(power[:, _VOICE_BINS], gains[:, _VOICE_BINS])
        halves = np.fft.irfft(spectra * gains) * _TAPER
        first, second = np.split(halves, 2, axis=1)
        clean = first + np.concatenate([self._overlap[None], second[:-1]])
        self._overlap = second[-1]
        out: Floats = clean.ravel().astype(np.float32)
        return out

    def learn(self) -> None:
        """Nobody spoke in the frame that was given last."""
        at, power = self._last
        for spectrum in power:
            self._met[at] += 1
            self._noise[at] += max(_STEP, 1.0 / self._met[at]) * (spectrum - self._noise[at])

    def _gains(self, power: Doubles, noise: Doubles) -> Doubles:
        """(4, 161) each."""
        gains = np.empty_like(power)
        for window, less, gain in zip(power, noise, gains, strict=True):
            speech_to_noise = (_MEMORY * self._speech + (1 - _MEMORY) * np.maximum(window - less, 0.0)) / less
            gain[:] = np.maximum(speech_to_noise / (1 + speech_to_noise), _LEAST_GAIN)
            self._speech = gain**2 * window
        return gains


def _most_left_db(power: Doubles, gains: Doubles) -> float:
    """(windows, bins) each."""
    kept = ((gains**2 * power).sum(axis=1) + _QUIETEST) / (power.sum(axis=1) + _QUIETEST)
    return float(10 * np.log10(kept.max()))


def total_speed(speed_rad_s: ArrayLike) -> float:
    """Of one number or (J,): the sum of magnitudes. What is not finite counts as none."""
    speeds = np.abs(np.asarray(speed_rad_s, np.float64))
    return float(speeds[np.isfinite(speeds)].sum())


_TAPER: Final[NDArray[np.float64]] = np.sin(np.pi * np.arange(_WINDOW) / _WINDOW)  # its square adds up to one
