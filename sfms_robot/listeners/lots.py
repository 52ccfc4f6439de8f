"""What a stream draws: numbers that hang on its seed, the frame they are for and their use, and on nothing else.

They come from Philox, a counter-based generator. So it does not matter when a frame is drawn, how often, or beside
which other streams: a plan made again draws the same for the same frames.
"""

from __future__ import annotations

import threading
from enum import IntEnum
from typing import Any, Final

import numpy as np

from sfms_robot.frames import Doubles, Floats

TO_UNIT: Final = 2.0**-53


class Use(IntEnum):
    """What numbers are for. Events (`events.chance`) have the uses below these."""

    TOKENS = 16
    SWAY = 17
    NOISE = 18
    STATE = 19


class _Again(threading.local):
    """A generator of each thread's, set anew for every use: to make one takes five times as long."""

    def __init__(self) -> None:
        self._philox = np.random.Philox(key=0)
        self._generator = np.random.Generator(self._philox)
        self._state: Any = self._philox.state

    def of(self, seed: int, frame: int, use: int, part: int = 0) -> np.random.Generator:
        """That of one use in one frame; `part` of it: any number."""
        # The lowest word of the counter rises with every four numbers; the rest says what they are for.
        counter = self._state["state"]["counter"]
        counter[0], counter[1], counter[2], counter[3] = 0, frame % 2**64, use, part
        self._state["state"]["key"][0] = seed % 2**64
        self._philox.state = self._state
        return self._generator


_AGAIN: Final = _Again()


def uniforms(seed: int, frame: int, use: int, count: int, part: int = 0) -> Doubles:
    """(count,) in 0..1."""
    words = _AGAIN.of(seed, frame, use, part).bit_generator.random_raw(count)
    return np.asarray((words >> np.uint64(11)) * TO_UNIT, np.float64)


def normals(seed: int, frame: int, use: int, *shape: int) -> Floats:
    """Standard normal numbers of a shape."""
    return _AGAIN.of(seed, frame, use).standard_normal(shape, np.float32)
