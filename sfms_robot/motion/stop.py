"""How one joint comes to a stop as fast as its limits allow, and whether it can do so inside its range.

A state is position, speed and acceleration of a joint, all along one axis. Plain floats: the limiter asks for one joint
at a time, and only where its array arithmetic has not settled the matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

State = Sequence[float]  # position, speed, acceleration

# Rounding eats into a limit at about 1e-9 of it; the law is tested at 1e-6.
SLACK: Final = 1e-9
POSITION_SLACK_RAD: Final = 1e-10
_STANDS_RAD_S: Final = 1e-12


class Bound(NamedTuple):
    """The limits of a joint: speed [rad/s], acceleration [rad/s^2], jerk [rad/s^3]."""

    speed: float
    acceleration: float
    jerk: float


class Stop(NamedTuple):
    """The fastest stop, everything along `s`, the sign of the speed once the acceleration is gone.

    Jerk -J until the acceleration is -peak, which is held where it is the limit, then +J.
    """

    s: float
    speed: float
    acceleration: float
    jerk: float
    times_s: tuple[float, float, float]

    @classmethod
    def of(cls, speed: float, acceleration: float, bound: Bound) -> Stop:
        """From a finite state, wherever it is."""
        most, jerk = bound.acceleration, bound.jerk
        s = 1.0 if speed + acceleration * abs(acceleration) / (2 * jerk) >= 0 else -1.0
        v, a = s * speed, s * acceleration
        peak = min(math.sqrt(max(jerk * v + a * a / 2, 0.0)), most)
        t1 = max((a + peak) / jerk, 0.0)
        t2 = max(v + a * t1 - jerk * (t1 * t1) / 2 - peak * peak / (2 * jerk), 0.0) / most
        return cls(s, v, a, jerk, (t1, t2, peak / jerk))

    def after(self, time_s: float) -> State:
        """Way, speed and acceleration, with their signs, `time_s` into the stop; inf for its end."""
        p, v, a, left = 0.0, self.speed, self.acceleration, time_s
        for jerk, lasts in zip((-self.jerk, 0.0, self.jerk), self.times_s, strict=True):
            t = min(lasts, left)
            left -= t
            p += t * (v + t * (a / 2 + t * jerk / 6))
            v += t * (a + t * jerk / 2)
            a += t * jerk
        if left > 0:  # what rounding leaves of speed and acceleration at the end is none
            return self.s * p, 0.0, 0.0
        return self.s * p, self.s * v, self.s * a

    def extent(self) -> tuple[float, float]:
        """How far it goes below and above the position it starts from [rad].

        Where the joint moves against s at first, it turns round on the way, while the acceleration still falls.
        """
        end, turn = self.after(math.inf)[0], 0.0
        if self.speed < 0:
            v, a, jerk = self.speed, self.acceleration, self.jerk
            t = (a - math.sqrt(max(a * a + 2 * jerk * v, 0.0))) / jerk
            turn = self.s * t * (v + t * (a / 2 - t * jerk / 6))
        return min(end, turn, 0.0), max(end, turn, 0.0)


def lawful(state: State, low: float, high: float, bound: Bound) -> bool:
    """Whether `state` can stop inside low..high, speed and acceleration within limits all the way.

    Nothing that is not finite is lawful.
    """
    position, speed, acceleration = state
    most, size = bound.acceleration, abs(acceleration)
    lasts = size / bound.jerk  # how long it takes until the acceleration is gone
    peak = speed + 0.5 * acceleration * lasts  # speed by then
    fastest = bound.speed * (1 + SLACK)
    if not (abs(speed) <= fastest and abs(peak) <= fastest and size <= most * (1 + SLACK)):  # neither for NaN
        return False
    top = abs(speed) + 0.5 * size * lasts
    farthest = top * (lasts + most / bound.jerk + 0.5 * top / most)  # no stop from here takes more way than this
    if low + farthest <= position <= high - farthest:
        return True
    if not math.isfinite(position):
        return False
    below, above = Stop.of(speed, acceleration, bound).extent()
    return position + below >= low - POSITION_SLACK_RAD and position + above <= high + POSITION_SLACK_RAD


def moves_in(state: State, way: float, bound: Bound) -> bool:
    """Whether a joint moves along `way` (1 or -1) or stands still, also all the while it stops."""
    _, speed, acceleration = state
    return way * speed >= 0 and way * (speed + 0.5 * acceleration * abs(acceleration) / bound.jerk) >= -_STANDS_RAD_S
