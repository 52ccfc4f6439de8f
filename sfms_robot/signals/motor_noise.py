"""The noise of a head's own motors: its spectrum at every speed, learned while nobody speaks."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Doubles, Floats

BAND_EDGES_HZ: Final = (
    100, 200, 300, 400, 510, 630, 770, 920, 1080, 1270, 1480, 1720, 2000, 2320, 2700, 3150, 3700, 4400, 5300,
    6400, 7700,
)  # fmt: skip
SPEED_EDGES_RAD_S: Final = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # of all joints together
STILL_RAD_S: Final = SPEED_EDGES_RAD_S[1]
_STEP: Final = 0.05  # per frame: of a band's mean towards what is heard
_QUIETEST: Final = 1e-10
_CLEAREST: Final = 4  # bands that a voice must stand out in


class MotorNoise:
    """Mean level of 20 Bark bands, one spectrum for each range of the summed speed of all joints. Memory is fixed.

    A range that was never met has the spectrum of nothing: whoever speaks there is heard.
    """

    def __init__(self) -> None:
        self._floor_db: Doubles = np.full((len(SPEED_EDGES_RAD_S) + 1, len(BAND_EDGES_HZ) - 1), -100.0)
        self._met = np.zeros(len(self._floor_db), np.int64)

    def excess_db(self, frame: Floats, speed_rad_s: ArrayLike) -> float:
        """How far a frame (640,) stands out of the noise of that speed: mean of its four clearest bands.

        `speed_rad_s`: one number or (J,), signs do not matter.
        """
        above = band_levels_db(frame) - self._floor_db[_range(speed_rad_s)]
        return float(np.sort(above)[-_CLEAREST:].mean())

    def learn(self, frame: Floats, speed_rad_s: ArrayLike) -> None:
        """A frame (640,) in which nobody spoke."""
        at = _range(speed_rad_s)
        self._met[at] += 1
        step = max(_STEP, 1.0 / self._met[at])
        self._floor_db[at] += step * (band_levels_db(frame) - self._floor_db[at])


def total_speed(speed_rad_s: ArrayLike) -> float:
    """Of one number or (J,): the sum of magnitudes."""
    return float(np.abs(np.asarray(speed_rad_s, np.float64)).sum())


def band_levels_db(frame: Floats) -> Doubles:
    """(640,) -> (20,) dB of full scale."""
    power = np.abs(np.fft.rfft(frame * _WINDOW)) ** 2 / FRAME_SAMPLES**2
    levels: Doubles = 10 * np.log10(np.add.reduceat(power, _FIRST_BINS)[:-1] + _QUIETEST)
    return levels


def _range(speed_rad_s: ArrayLike) -> int:
    return int(np.searchsorted(SPEED_EDGES_RAD_S, total_speed(speed_rad_s)))


_WINDOW: Final = np.hanning(FRAME_SAMPLES)
_FIRST_BINS: Final = np.array(BAND_EDGES_HZ) * FRAME_SAMPLES // AUDIO_HZ
