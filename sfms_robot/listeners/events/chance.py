"""Chance that depends on nothing but the seed, the frame and what it is for (Philox, a counter-based generator).

The same evidence gives the same events, however often and in whatever order frames are looked at, and two kinds never
share a number.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfms_robot.frames import EVENT_KINDS, Doubles

_TO_UNIT: Final = 2.0**-53
_WHEN, _HOW, _HABIT = 0, 1, 2


def of_instant(seed: int, frame: int) -> Doubles:
    """(len(EVENT_KINDS),) in 0..1: does each kind happen?"""
    return _uniform(seed, frame, _WHEN, 0, len(EVENT_KINDS))


def of_event(seed: int, frame: int, kind: str, count: int) -> Doubles:
    """(count,) in 0..1: how does it happen?"""
    return _uniform(seed, frame, _HOW, EVENT_KINDS.index(kind), count)


def of_habit(seed: int, kind: str, count: int) -> Doubles:
    """(count,) in 0..1: what is the same all along a stream."""
    return _uniform(seed, 0, _HABIT, EVENT_KINDS.index(kind), count)


def _uniform(seed: int, frame: int, use: int, kind: int, count: int) -> Doubles:
    # The lowest word of the counter rises with every four numbers; the rest says what they are for.
    counter = np.array([0, frame % 2**64, use, kind], np.uint64)
    words = np.random.Philox(key=seed % 2**64, counter=counter).random_raw(count)
    return np.asarray((words >> np.uint64(11)) * _TO_UNIT, np.float64)
