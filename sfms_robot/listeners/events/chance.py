"""Chance that depends on nothing but the seed, the frame and what it is for (Philox, a counter-based generator).

The same evidence gives the same events, however often and in whatever order frames are looked at, and two kinds never
share a number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import EVENT_KINDS, Doubles
from sfms_robot.listeners.lots import uniforms
from sfms_robot.listeners.philox import uniforms_of

_WHEN, _HOW, _HABIT = 0, 1, 2


def of_instant(seed: int, frame: int) -> Doubles:
    """(len(EVENT_KINDS),) in 0..1: does each kind happen?"""
    return uniforms(seed, frame, _WHEN, len(EVENT_KINDS))


def of_instants(seed: int, frames: NDArray[np.int64]) -> Doubles:
    """(N, len(EVENT_KINDS)): `of_instant` of many frames at once."""
    return uniforms_of(seed, frames, _WHEN, len(EVENT_KINDS))


def of_event(seed: int, frame: int, kind: str, count: int) -> Doubles:
    """(count,) in 0..1: how does it happen?"""
    return uniforms(seed, frame, _HOW, count, EVENT_KINDS.index(kind))


def of_habit(seed: int, kind: str, count: int) -> Doubles:
    """(count,) in 0..1: what is the same all along a stream."""
    return uniforms(seed, 0, _HABIT, count, EVENT_KINDS.index(kind))
