"""Many draws of `lots` at once: Philox4x64 with ten rounds, worked out over arrays of counters.

Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3" (SC 2011). Where it is known which frames
of a stream are drawn for, no generator has to be set anew for each of them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles
from sfms_robot.listeners.lots import TO_UNIT

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
