"""Random numbers of a stream, as functions of only its seed, the frame and the use.

They come from Philox, a counter-based generator. So it does not matter when a frame is drawn, how often, or together
with which other streams: a plan that is made again draws the same numbers for the same frames.
"""

from __future__ import annotations

import threading
from enum import IntEnum
from typing import Any, Final

import numpy as np

from sfms_robot.frames import Doubles, Floats

TO_UNIT: Final = 2.0**-53


class Use(IntEnum):
    """Purposes of the numbers: each has its own sequence."""

    EVENT = 0  # which kinds of events happen
    COURSE = 1  # duration, size and direction of an event; `part` is its kind
    HABIT = 2  # constants of a stream
    TOKENS = 16
    SWAY = 17
    NOISE = 18
    STATE = 19


class _Generators(threading.local):
    """One generator per thread, set to a new counter for every use: creating one takes five times as long."""

    def __init__(self) -> None:
        self._philox = np.random.Philox(key=0)
        self._generator = np.random.Generator(self._philox)
        self._state: Any = self._philox.state

    def at(self, seed: int, frame: int, use: int, part: int = 0) -> np.random.Generator:
        """Return the generator of one use in one frame; `part`, any number, is a separate sequence of that use."""
        # Philox4x64: key = seed, counter = (0, frame, use, part). Each step of the lowest word of the counter yields
        # four numbers, so no two uses share any.
        counter = self._state["state"]["counter"]
        counter[0], counter[1], counter[2], counter[3] = 0, frame % 2**64, use, part
        self._state["state"]["key"][0] = seed % 2**64
        self._philox.state = self._state
        return self._generator


_GENERATORS: Final = _Generators()


def uniforms(seed: int, frame: int, use: int, count: int, part: int = 0) -> Doubles:
    """Return (count,) numbers, 0 <= u < 1."""
    words = _GENERATORS.at(seed, frame, use, part).bit_generator.random_raw(count)
    return np.asarray((words >> np.uint64(11)) * TO_UNIT, np.float64)  # the upper 53 bits of a word


def normals(seed: int, frame: int, use: int, *shape: int) -> Floats:
    """Return standard normal numbers of a shape."""
    return _GENERATORS.at(seed, frame, use).standard_normal(shape, np.float32)
