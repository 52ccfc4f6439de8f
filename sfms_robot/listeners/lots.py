"""What a stream draws: numbers that hang on its seed, the frame they are for and their use, and on nothing else.

They come from Philox, a counter-based generator. So it does not matter when a frame is drawn, how often, or beside
which other streams: a plan made again draws the same for the same frames.
"""

from __future__ import annotations

import threading
from enum import IntEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles, Floats

TO_UNIT: Final = 2.0**-53


class Use(IntEnum):
    """What numbers are for."""

    EVENT = 0  # which kinds of events happen
    COURSE = 1  # how an event goes; `part` is its kind
    HABIT = 2  # what stays the same in a stream
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


# --- Many frames at once ----------------------------------------------------------------------------------------------
#
# The same numbers for many frames: Philox4x64 with ten rounds over arrays of counters (Salmon, Moraes, Dror and Shaw,
# "Parallel random numbers: as easy as 1, 2, 3", SC 2011). No generator is set again for each frame.

Words = NDArray[np.uint64]

_ROUNDS: Final = 10
_FACTORS: Final = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
_KEY_STEPS: Final = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)  # added to the key after each round
_WORDS: Final = 4  # that a counter gives


def uniforms_of(seed: int, frames: NDArray[np.int64], use: int, count: int) -> Doubles:
    """(N, count) in 0..1: `lots.uniforms` of each frame."""
    shape = len(frames), -(-count // _WORDS)
    counter = (
        np.broadcast_to(np.arange(1, shape[1] + 1, dtype=np.uint64), shape),  # numpy counts before it draws
        np.broadcast_to(np.asarray(frames).astype(np.uint64)[:, None], shape),
        np.full(shape, use, np.uint64),
        np.zeros(shape, np.uint64),
    )
    words = np.stack(_philox(counter, seed % 2**64), axis=-1).reshape(len(frames), shape[1] * _WORDS)
    return np.asarray((words[:, :count] >> np.uint64(11)) * TO_UNIT, np.float64)


def _philox(counter: tuple[Words, Words, Words, Words], key: int) -> tuple[Words, Words, Words, Words]:
    """The four words of each counter; the key's second word is 0."""
    keys = [key, 0]
    for _ in range(_ROUNDS):
        first, second = (np.uint64(word) for word in keys)
        high, low = _product(_FACTORS[0], counter[0])
        high_2, low_2 = _product(_FACTORS[1], counter[2])
        counter = high_2 ^ counter[1] ^ first, low_2, high ^ counter[3] ^ second, low
        keys = [(word + step) % 2**64 for word, step in zip(keys, _KEY_STEPS, strict=True)]
    return counter


def _product(factor: int, words: Words) -> tuple[Words, Words]:
    """The upper and the lower 64 bits of factor * words, by products of 32 bits."""
    half, mask = np.uint64(32), np.uint64(2**32 - 1)
    upper, lower = np.uint64(factor >> 32), np.uint64(factor % 2**32)
    middle = upper * (words & mask) + (lower * (words & mask) >> half)
    crossed = lower * (words >> half) + (middle & mask)
    return upper * (words >> half) + (middle >> half) + (crossed >> half), np.uint64(factor) * words
