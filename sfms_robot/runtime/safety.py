"""What keeps a run safe from the outside: the way to rest, signals turned into a flag, real-time priority."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

import numpy as np

from sfms_robot.errors import RobotError
from sfms_robot.frames import Doubles
from sfms_robot.ports import Bus, Limiter
from sfms_robot.runtime.clock import Beat
from sfms_robot.runtime.log import RunLog

EASE_S = 1.0  # torque-on pose -> live face, and live face -> rest
SETTLE_S = 2.0  # a slow joint may need longer than EASE_S; after this the torque goes off all the same
ARRIVED_RAD = 1e-4
SWITCH_S = 0.0005  # Python's own 5 ms is half a tick

T = TypeVar("T", float, Doubles)
logger = logging.getLogger(__name__)


def smooth(u: T) -> T:
    """0 -> 0, 1 -> 1 with speed and acceleration zero at both ends (quintic)."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def come_to_rest(
    bus: Bus, limiter: Limiter, state: Any, from_rad: Doubles, rest_rad: Doubles, ticks: Iterable[Beat], log: RunLog
) -> None:
    """Ease every joint to its rest angle under the limits. A bus that fails on the way ends it early, with a line."""
    span = rest_rad - from_rad
    period_s = log.period_s
    try:
        for count, beat in enumerate(ticks):
            before, angle, ahead = (smooth((count + k) * period_s / EASE_S) for k in (-1, 0, 1))
            speed, acceleration = (ahead - before) / (2 * period_s), (ahead - 2 * angle + before) / period_s**2
            reference = np.stack([from_rad + angle * span, speed * span, acceleration * span])
            goals_rad, state = limiter.step(reference, state)
            bus.write(goals_rad, beat.time_s)
            log.ease(beat, goals_rad, reference[0])
            bus.poll(beat.time_s)
            arrived = bool(np.all(np.abs(goals_rad - rest_rad) < ARRIVED_RAD))
            if arrived and count * period_s >= EASE_S or count * period_s >= EASE_S + SETTLE_S:
                return
    except RobotError as error:
        logger.error("could not ease to rest: %s", error)


_ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, kill, a terminal or connection that closes


@contextmanager
def interrupt_flag() -> Iterator[Callable[[], bool]]:
    """SIGINT, SIGTERM and SIGHUP set a flag instead of raising, so that no write is cut in half. Restored on exit.

    SIGHUP only where it is not ignored: under nohup a lost terminal ends nothing.
    """
    caught: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        caught.append(number)

    nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    heeded = [each for each in _ENDINGS if each != signal.SIGHUP or not nohup]
    previous = {number: signal.signal(number, note) for number in heeded}
    try:
        yield lambda: bool(caught)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def realtime_priority(wanted: bool = True) -> Iterator[str]:
    """SCHED_FIFO while inside, where the system grants it. Yields "fifo", "not asked for", or why it was refused.

    Inside, other threads of this process (a recorder, a progress bar) also hand the interpreter back ten times sooner.
    """
    if not wanted:
        yield "not asked for"
        return
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        with _fifo() as outcome:
            yield outcome
    finally:
        sys.setswitchinterval(usual_s)


@contextmanager
def _fifo() -> Iterator[str]:
    try:
        before = (os.sched_getscheduler(0), os.sched_getparam(0))
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO)))
    except (AttributeError, OSError) as error:
        yield f"refused: {error}"
        return
    try:
        yield "fifo"
    finally:
        os.sched_setscheduler(0, *before)
