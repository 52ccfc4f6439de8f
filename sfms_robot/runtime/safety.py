"""Protection of a run: the way to rest, servos that get warm, and signals turned into a request to end.

A warm servo moves less, and so slower; a hot one goes to rest and stays there until it has cooled. Every joint has a
share: 1 shows the requested angle, 0 is its rest angle. The share is `WARM_SHARE` while the servo is warm and 0 while
it is hot. It changes over seconds, and rises again `COOLER_C` below the threshold at which it fell. Joints that show
one pose together (a neck) use the smallest of their shares. A servo without a temperature counts as cool; at its own
limit the protection of the servo acts, and `on_fault` of the joint.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import FrameType
from typing import Final

import numpy as np

from sfms_robot.frames import Doubles, Readings
from sfms_robot.motion.limits import JerkLimiter, LimiterState
from sfms_robot.ports import Bus
from sfms_robot.runtime.clock import TickTime
from sfms_robot.runtime.log import RunLog
from sfms_robot.signals.minimum_jerk import ease

EASE_S: Final = 1.0  # torque-on pose -> live face, and live face -> rest
REST_LIMIT_S: Final = 60.0  # longest way to rest; twice what the slowest joint of a shipped head needs
ARRIVED_RAD: Final = 1e-4  # a goal this close to rest has arrived
STANDS_RAD: Final = 0.01  # a servo this close to rest has arrived: gear and load leave it a little short
FOLLOW_S: Final = 0.3  # longest wait for servos after their goals have arrived
FAILURES: Final = 3  # failed ticks in a row after which the way to rest ends
WARM_SHARE: Final = 0.5
COOLER_C: Final = 3.0
PER_S: Final = 0.5  # highest rate of the share: from moving to rest in two seconds

Seen = Callable[[float, float, Doubles, Readings], None]  # time, share of the way ahead, goals, readings
logger = logging.getLogger(__name__)


def come_to_rest(
    bus: Bus,
    limiter: JerkLimiter,
    state: LimiterState,
    *,
    from_rad: Doubles,
    rest_rad: Doubles,
    ticks: Iterable[TickTime],
    log: RunLog,
    seen: Seen,
) -> None:
    """Ease every joint to its rest angle under the limits; blocks for at least `EASE_S` and at most `REST_LIMIT_S`.

    Takes as long as the limiter needs to bring its goals there, so that no joint loses its torque on the way. The
    limiter moves on once per tick, so a computer that misses ticks takes longer. Once the goals have arrived, servos
    have `FOLLOW_S` to follow, whether they move or not. A tick that raises (a bus that fails, a goal that is refused)
    is logged and left out; `FAILURES` in a row end the way. `seen` is called in every tick that does not raise before.
    Never raises an Exception.
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
            log.commanded(tick, goals_rad, reference[0])
            bus.write(goals_rad, tick.time_s)
            readings, failed = bus.poll(tick.time_s), 0
            seen(tick.time_s, 1.0 - angle, goals_rad, readings)
            if bool(np.all(np.abs(goals_rad - rest_rad) < ARRIVED_RAD)):
                arrived_s = tick.time_s if arrived_s is None else arrived_s
                places = [readings[joint].position_rad if joint in readings else None for joint in bus.joints]
                stand = all(at is None or abs(at - r) < STANDS_RAD for at, r in zip(places, rest_rad, strict=True))
                arrived = stand or tick.time_s - arrived_s >= FOLLOW_S
        except Exception as error:  # any kind: the other buses must still be eased
            failed += 1
            logger.error("on the way to rest: %s", error)
        if failed >= FAILURES or (arrived and since_s >= EASE_S) or since_s >= REST_LIMIT_S:
            return


@dataclass(frozen=True)
class Heat:
    """Derating of the joints, (J,) each.

    Attributes:
        share: share of the requested angle that each joint shows.
        wanted: the value that `share` moves toward.
    """

    share: Doubles
    wanted: Doubles

    @classmethod
    def cool(cls, joints: int) -> Heat:
        return cls(np.ones(joints), np.ones(joints))

    @property
    def none(self) -> bool:
        """True if every joint shows the requested angle."""
        return bool((self.share == 1.0).all())


@dataclass(frozen=True)
class HeatGuard:
    """Temperature derating. warm_C, hot_C: (J,) thresholds. together: columns of joints that show one pose together."""

    warm_C: Doubles
    hot_C: Doubles
    together: list[int]

    def judge(self, temperatures_C: Doubles, heat: Heat) -> Heat:
        """Return the shares to move toward for temperatures (J,), NaN where unknown."""
        left_hot = np.where(heat.wanted < WARM_SHARE, COOLER_C, 0.0)
        left_warm = np.where(heat.wanted < 1.0, COOLER_C, 0.0)
        with np.errstate(invalid="ignore"):  # NaN is not hot
            hot = temperatures_C >= self.hot_C - left_hot
            warm = temperatures_C >= self.warm_C - left_warm
        wanted = np.where(hot, 0.0, np.where(warm, WARM_SHARE, 1.0))
        if self.together:
            wanted[self.together] = wanted[self.together].min()
        return replace(heat, wanted=wanted)

    def after(self, heat: Heat, dt_s: float) -> Heat:
        """Return the shares `dt_s` later."""
        if (heat.share == heat.wanted).all():
            return heat
        return replace(heat, share=heat.share + np.clip(heat.wanted - heat.share, -PER_S * dt_s, PER_S * dt_s))


def temperatures_C(joints: Sequence[str], readings: Readings) -> Doubles:
    """Return the temperatures (J,) of the freshest readings, NaN for a servo without one."""
    known = (readings[joint].extra.get("temperature_C") if joint in readings else None for joint in joints)
    return np.array([np.nan if each is None else each for each in known])


class Released(KeyboardInterrupt):
    """The second request to end: torque is off."""


class Interrupt:
    """Requests to end a run: after the first the head comes to rest, after the second torque is off at once.

    Before `arm` nothing moves, so the first request ends the program by KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self._asked = 0
        self._bus: Bus | None = None

    def arm(self, bus: Bus) -> None:
        """Record that torque comes on: from now on a second request releases `bus`."""
        self._bus = bus

    def __call__(self) -> bool:
        """Return whether there was a request."""
        return self._asked > 0

    def ask(self) -> None:
        """Count a request from any thread, and release at the second. Raises nothing."""
        self._asked += 1
        if self._asked > 1 and self._bus is not None:
            self._bus.torque_off("release")

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """Count a request in the main thread's signal handler. Ctrl-\\ releases at once, as a second Ctrl-C does.

        Raises KeyboardInterrupt before torque is on, and `Released` at the second request, which interrupts a call that
        blocks. Later requests send torque-off again and raise nothing, so that the cleaning up continues.
        """
        before = self._asked
        if number == getattr(signal, "SIGQUIT", None):
            self._asked += 1
        self.ask()
        if self._bus is None:
            raise KeyboardInterrupt
        if before < 2 <= self._asked:
            raise Released


@contextmanager
def signals_to(interrupt: Interrupt) -> Iterator[None]:
    """Turn SIGINT, SIGTERM, SIGHUP and SIGQUIT into requests, so that no write is cut in half. Restored on exit.

    Their sources are Ctrl-C, kill, a terminal or connection that closes, and Ctrl-\\; the last two do not exist on
    Windows. SIGHUP is used only where it is not ignored: under nohup a lost terminal ends nothing. Main thread only,
    because Python delivers signals to no other thread.
    """
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    hangup = getattr(signal, "SIGHUP", None)
    heeded = [each for each in numbers if each != hangup or signal.getsignal(each) is not signal.SIG_IGN]
    previous = {number: signal.signal(number, interrupt.on_signal) for number in heeded}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
