"""What keeps a run safe from the outside: the way to rest, and signals turned into a request to end."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

import numpy as np

from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import Bus, Limiter
from sfms_robot.runtime.clock import TickTime
from sfms_robot.runtime.log import RunLog
from sfms_robot.signals.minimum_jerk import ease

EASE_S: Final = 1.0  # torque-on pose -> live face, and live face -> rest
REST_LIMIT_S: Final = 60.0  # of the whole way to rest; twice what the slowest joint of a shipped head may need
ARRIVED_RAD: Final = 1e-4  # of a goal
STANDS_RAD: Final = 0.01  # of a servo: its gear and its load leave it a little short
FOLLOW_S: Final = 0.3  # that servos are given after their goals have arrived
FAILURES: Final = 3  # ticks in a row that may raise on the way to rest

Seen = Callable[[float, float, Doubles, Mapping[str, Reading]], None]  # time, share of the way ahead, goals, readings
logger = logging.getLogger(__name__)


def come_to_rest(
    bus: Bus,
    limiter: Limiter,
    state: Any,
    from_rad: Doubles,
    rest_rad: Doubles,
    ticks: Iterable[TickTime],
    log: RunLog,
    seen: Seen,
) -> None:
    """Ease every joint to its rest angle under the limits; blocks for at least `EASE_S` and at most `REST_LIMIT_S`.

    Takes as long as the limiter needs to bring its goals there, so that no joint loses its torque on the way. It needs
    time of its own ticks, so a computer that is late for some takes longer. Once the goals have arrived, servos have
    `FOLLOW_S` to follow, whether they move or not. A tick that raises (a bus that fails, a goal that is refused) is
    said once and left out; after `FAILURES` in a row it gives up. `seen` is told of every other one. Never raises an
    Exception.
    """
    span = rest_rad - from_rad
    began_s: float | None = None
    arrived_s: float | None = None
    failed = 0
    for tick in ticks:
        began_s = tick.time_s if began_s is None else began_s
        since_s = tick.time_s - began_s
        before, angle, ahead = (ease((since_s + k * log.period_s) / EASE_S) for k in (-1, 0, 1))
        speed, acceleration = (ahead - before) / (2 * log.period_s), (ahead - 2 * angle + before) / log.period_s**2
        reference = np.stack([from_rad + angle * span, speed * span, acceleration * span])
        arrived = False
        try:
            goals_rad, state = limiter.step(reference, state)
            log.ease(tick, goals_rad, reference[0])
            bus.write(goals_rad, tick.time_s)
            readings, failed = bus.poll(tick.time_s), 0
            seen(tick.time_s, 1.0 - angle, goals_rad, readings)
            if bool(np.all(np.abs(goals_rad - rest_rad) < ARRIVED_RAD)):
                arrived_s = tick.time_s if arrived_s is None else arrived_s
                stand = _stand(bus.joints, readings, rest_rad)
                arrived = stand or tick.time_s - arrived_s >= FOLLOW_S
        except Exception as error:  # whatever it is, the other buses are still to be eased
            failed += 1
            logger.error("on the way to rest: %s", error)
        if failed >= FAILURES or (arrived and since_s >= EASE_S) or since_s >= REST_LIMIT_S:
            return


def _stand(joints: Sequence[str], readings: Mapping[str, Reading], rest_rad: Doubles) -> bool:
    """Whether every servo that tells its position is at rest."""
    stands = [readings[joint].position_rad if joint in readings else None for joint in joints]
    return all(at is None or abs(at - rest) < STANDS_RAD for at, rest in zip(stands, rest_rad, strict=True))


class Released(KeyboardInterrupt):
    """Asked to end for the second time: torque is off."""


class Interrupt:
    """Somebody asks a run to end: once, and the head comes to rest; twice, and torque is off at once.

    Before `arm` nothing moves, so the first request ends whatever goes on by KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self._asked = 0
        self._bus: Bus | None = None

    def arm(self, bus: Bus) -> None:
        """Torque comes on from here on; `bus` is what a second request releases."""
        self._bus = bus

    def __call__(self) -> bool:
        """Whether somebody asked."""
        return self._asked > 0

    def ask(self) -> None:
        """A request from any thread: counts, and releases at the second. Raises nothing."""
        self._asked += 1
        if self._asked > 1 and self._bus is not None:
            self._bus.torque_off("release")

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """A request from the main thread's signal handler. Ctrl-\\ asks for release at once, as a second Ctrl-C does.

        Raises KeyboardInterrupt before torque, `Released` at the second request: what blocks then is cut short. Those
        after it send torque-off again and raise nothing, so that the cleaning up goes on.
        """
        before = self._asked
        if number == getattr(signal, "SIGQUIT", None):
            self._asked += 1
        self.ask()
        if self._bus is None:
            raise KeyboardInterrupt
        if before < 2 <= self._asked:
            raise Released


# Ctrl-C, kill, a terminal or connection that closes, Ctrl-\; the last two do not exist on Windows.
_ENDINGS: Final = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name)
]


@contextmanager
def signals_to(interrupt: Interrupt) -> Iterator[None]:
    """SIGINT, SIGTERM, SIGHUP and SIGQUIT ask `interrupt`, so that no write is cut in half. Restored on exit.

    SIGHUP only where it is not ignored: under nohup a lost terminal ends nothing. Only in the main thread: Python
    gives signals to no other.
    """
    hangup = getattr(signal, "SIGHUP", None)
    heeded = [each for each in _ENDINGS if each != hangup or signal.getsignal(each) is not signal.SIG_IGN]
    previous = {number: signal.signal(number, interrupt.on_signal) for number in heeded}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
