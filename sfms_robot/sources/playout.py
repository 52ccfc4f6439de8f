"""What is said, in frames of the loop -> what a sound device is handed, so that every sample leaves it at its time.

The grid of the loop is the only clock: sample s, 16 kHz, leaves the loudspeaker s / 16000 after loop time 0, whatever
the device's rate and drift. The device tells of every block when it leaves; `drift` tells from that where every sample
lies, and the next block is the signal at the instants at which it leaves: its rate is the card's true one, and a little
more or less where it is ahead or behind, 1 % at most. Nothing is cut out or put in but for these cases:

1. The device had nothing to play for a while. What was due then is not said any more; what follows is on time again.
2. What is handed over is off by more than `JUMP_S`, or at all while nothing sounds: it jumps to its place.
3. It was told too late: the device has had zeros for it.

What did not leave is told (`Silence`), so that nobody takes it for said.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Floats
from sfms_robot.signals.interpolation import at_positions
from sfms_robot.sources.drift import SampleClock

JUMP_S: Final = 0.02
PULL_S: Final = 1.0  # time constant of a correction
LARGEST_PULL: Final = 0.01  # of the rate: a sixth of a semitone
GAP_S: Final = 0.15  # a block that leaves so long after the end of the last one: the device was dry, and did not say so
_EXACT_S: Final = 0.0005  # where a stretch begins, and in silence
_UNTOLD: Final = 64  # silences that wait to be told


@dataclass(frozen=True)
class Silence:
    """Samples `first` to `last` - 1 of the loop did not leave."""

    first: int
    last: int


class Playout:
    """One device. `block` is called in one thread, the rest in another.

    Args:
        rate_hz: of the device, by its own word.

    Attributes:
        silences: not told yet; the oldest is taken from the left.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._origin_s: float | None = None
        self._said: tuple[int, Floats] = (0, np.zeros(1, np.float32))  # from which sample of the loop on, and what
        self._clock: SampleClock | None = None  # None: the next block begins a stretch
        self._skew = 0.0  # of the card, kept over its silences
        self._count = 0  # samples of the stretch that were handed over
        self._next = 0.0  # sample of the loop that is handed over next
        self._settled = False  # it goes on where the last block ended
        self.silences: deque[Silence] = deque(maxlen=_UNTOLD)
        self._counts = {"underruns": 0, "jumps": 0}

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`."""
        self._origin_s, self._next, self._settled = origin_s, 0.0, False

    def tell(self, first: int, samples: Floats) -> None:
        """What is to leave from frame `first` on, (n x 640,), n > 0; the newest replaces what was told before."""
        self._said = (first * FRAME_SAMPLES, samples)

    def block(self, n: int, leaves_s: float, dry: bool = False) -> Floats:
        """The next (n,) samples for the device, the first of which leaves at `leaves_s` of `time.monotonic`.

        `leaves_s` may be late by some milliseconds, seldom early. `dry`: the device had nothing to play before it.
        """
        clock = self._followed(leaves_s, dry)
        count, self._count = self._count, self._count + n
        if self._origin_s is None:
            return np.zeros(n, np.float32)
        due = (clock.time_s(count) - self._origin_s) * AUDIO_HZ
        self._place(due, math.ceil(n * AUDIO_HZ / self._rate_hz))
        pull = (due - self._next) / (PULL_S * AUDIO_HZ)
        ratio = AUDIO_HZ / clock.rate_hz * (1.0 + min(max(pull, -LARGEST_PULL), LARGEST_PULL))
        begins, self._next = self._next, self._next + ratio * n
        first, said = self._said
        self._lacks(max(begins, first + len(said)), self._next)
        return at_positions(said, begins - first + ratio * np.arange(n, dtype=np.float64))

    def statistics(self) -> Mapping[str, Any]:
        """Times that the device ran dry, jumps, and how the card drifts."""
        drift_ppm = None if self._clock is None else round(self._clock.drift_ppm, 1)
        return {**self._counts, "drift_ppm": drift_ppm}

    def _followed(self, leaves_s: float, dry: bool) -> SampleClock:
        """The clock, which has seen this block; a new one where the block does not follow the last one."""
        if self._clock is not None and (dry or self._clock.lateness_s(self._count, leaves_s) > GAP_S):
            self._counts["underruns"] += self._origin_s is not None
            self._clock, self._settled = None, False
        if self._clock is None:
            self._clock, self._count = SampleClock(self._rate_hz, self._skew), 0
        self._clock.observe(self._count, leaves_s)
        self._skew = self._clock.skew
        return self._clock

    def _place(self, due: float, n: int) -> None:
        """What comes next is what is due, where that is not so nearly; `n`: samples of the loop that come."""
        first, said = self._said
        begins, ends = (max(0, math.floor(at(self._next, due)) - first) for at in (min, max))
        sounds = bool(said[begins : ends + n].any())
        if abs(due - self._next) / AUDIO_HZ > (JUMP_S if self._settled and sounds else _EXACT_S):
            if sounds:
                self._counts["jumps"] += self._settled
                self._lacks(self._next, due)
            self._next = due
        self._settled = True

    def _lacks(self, begins: float, ends: float) -> None:
        if ends > begins and ends > 0.0:
            self.silences.append(Silence(max(0, math.floor(begins)), math.ceil(ends)))
