"""The fastest stop of one joint, and one tick of its way to a reference that it cannot meet in one tick.

A state is position, speed and acceleration of a joint, all along one axis. Plain floats: the limiter calls this for one
joint at a time.

`ruckig` (Berscheid and Kroeger, 2021) plans the fastest way, where it is installed. It has no wheel for Linux on ARM.
`StopChase` is the fallback without it: its motion is always lawful, but arrives a little later.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Final, NamedTuple

_HALVINGS: Final = 16
# Rounding errors may exceed a limit by about 1e-9 of it; the law is tested at 1e-6.
SLACK: Final = 1e-9
POSITION_SLACK_RAD: Final = 1e-10
_STANDS_RAD_S: Final = 1e-12

State = Sequence[float]  # position, speed, acceleration
Lawful = Callable[[State], bool]


class Bound(NamedTuple):
    """The limits of a joint: speed [rad/s], acceleration [rad/s^2], jerk [rad/s^3]."""

    speed: float
    acceleration: float
    jerk: float


class Stop(NamedTuple):
    """The fastest stop, with all values along `s`, the sign of the speed once the acceleration is gone.

    The jerk is -J until the acceleration is -peak, 0 while this is held if it is the limit, then +J.
    """

    s: float
    speed: float
    acceleration: float
    jerk: float
    times_s: tuple[float, float, float]

    @classmethod
    def of(cls, speed: float, acceleration: float, bound: Bound) -> Stop:
        """Return the stop from any finite state."""
        most, jerk = bound.acceleration, bound.jerk
        # Speed once the acceleration is gone, by jerk alone: v + a |a| / 2J. Its sign is the direction of the stop.
        s = 1.0 if speed + acceleration * abs(acceleration) / (2 * jerk) >= 0 else -1.0
        v, a = s * speed, s * acceleration
        # Without a held piece, -J until -peak and +J back to 0 reduce the speed by v = (peak^2 - a^2 / 2) / J.
        peak = min(math.sqrt(max(jerk * v + a * a / 2, 0.0)), most)
        t1 = max((a + peak) / jerk, 0.0)
        # The held piece removes the rest of the speed at -most.
        t2 = max(v + a * t1 - jerk * (t1 * t1) / 2 - peak * peak / (2 * jerk), 0.0) / most
        return cls(s, v, a, jerk, (t1, t2, peak / jerk))

    def after(self, time_s: float) -> State:
        """Return way, speed and acceleration, with their signs, `time_s` into the stop; inf for its end."""
        state, left = (0.0, self.speed, self.acceleration), time_s
        for jerk, lasts in zip((-self.jerk, 0.0, self.jerk), self.times_s, strict=True):
            t = min(lasts, left)
            left -= t
            state = _moved(state, jerk, t)
        p, v, a = state
        if left > 0:  # at the end speed and acceleration are 0 except for rounding
            return self.s * p, 0.0, 0.0
        return self.s * p, self.s * v, self.s * a

    def extent(self) -> tuple[float, float]:
        """Return how far the stop goes below and above its start [rad].

        A joint that moves against s at first turns round on the way, while the acceleration still falls.
        """
        end, turn = self.after(math.inf)[0], 0.0
        if self.speed < 0:
            # The joint turns round where v + a t - J t^2 / 2 = 0.
            v, a, jerk = self.speed, self.acceleration, self.jerk
            t = (a - math.sqrt(max(a * a + 2 * jerk * v, 0.0))) / jerk
            turn = self.s * t * (v + t * (a / 2 - t * jerk / 6))
        return min(end, turn, 0.0), max(end, turn, 0.0)


def _moved(state: tuple[float, float, float], jerk: float, t: float) -> tuple[float, float, float]:
    """Return position, speed and acceleration after `t` seconds of constant jerk."""
    p, v, a = state
    return p + t * (v + t * (a / 2 + t * jerk / 6)), v + t * (a + t * jerk / 2), a + t * jerk


def lawful(state: State, low: float, high: float, bound: Bound) -> bool:
    """Return whether `state` can stop inside low..high, speed and acceleration within limits all the way.

    A state that is not finite is not lawful.
    """
    position, speed, acceleration = state
    most, size = bound.acceleration, abs(acceleration)
    lasts = size / bound.jerk  # time until the acceleration is gone
    peak = speed + 0.5 * acceleration * lasts  # speed by then
    fastest = bound.speed * (1 + SLACK)
    if not (abs(speed) <= fastest and abs(peak) <= fastest and size <= most * (1 + SLACK)):  # false for NaN
        return False
    top = abs(speed) + 0.5 * size * lasts
    farthest = top * (lasts + most / bound.jerk + 0.5 * top / most)  # no stop from here goes farther
    if low + farthest <= position <= high - farthest:
        return True
    if not math.isfinite(position):
        return False
    below, above = Stop.of(speed, acceleration, bound).extent()
    return position + below >= low - POSITION_SLACK_RAD and position + above <= high + POSITION_SLACK_RAD


def moves_in(state: State, way: float, bound: Bound) -> bool:
    """Return whether a joint moves along `way` (1 or -1) or stands still, also during its whole stop."""
    _, speed, acceleration = state
    return way * speed >= 0 and way * (speed + 0.5 * acceleration * abs(acceleration) / bound.jerk) >= -_STANDS_RAD_S


class TimeOptimalChase:
    """Chase that uses the first tick of ruckig's fastest way."""

    def __init__(self, bounds: Sequence[Bound], dt_s: float) -> None:
        import ruckig

        self._errors = (ruckig.RuckigError, ValueError)  # no way at the law's edge, or one of hours (-101, no name)
        self._planner, self._path, self._dt_s = ruckig.Ruckig(1), ruckig.Trajectory(1), dt_s
        self._inputs = []
        for speed, acceleration, jerk in bounds:
            given = ruckig.InputParameter(1)
            given.max_velocity, given.max_acceleration, given.max_jerk = [speed], [acceleration], [jerk]
            given.minimum_duration = dt_s
            self._inputs.append(given)

    def step(self, joint: int, before: State, target: State, lawful: Lawful) -> State | None:
        """Return the state one tick after `before` on the way to `target`, both lawful; None without a lawful one."""
        given = self._inputs[joint]
        given.current_position, given.current_velocity, given.current_acceleration = ([x] for x in before)
        given.target_position, given.target_velocity, given.target_acceleration = ([x] for x in target)
        try:
            self._planner.calculate(given, self._path)
        except self._errors:
            return None
        (position,), (speed,), (acceleration,) = self._path.at_time(self._dt_s)
        after = (position, speed, acceleration)
        return after if lawful(after) else None


class StopChase(NamedTuple):
    """Chase that uses the most jerk toward the target with which the joint can still stop where the target would stop.

    A mixture of braking and full jerk during a tick leads to the same mixture of the two end states. The larger the
    share of full jerk, the farther away the stop ends, so the share is found by halving.
    """

    bounds: Sequence[Bound]
    dt_s: float

    def step(self, joint: int, before: State, target: State, lawful: Lawful) -> State | None:
        bound, dt = self.bounds[joint], self.dt_s
        way = _stops_at(target, bound) - _stops_at(before, bound)
        if way == 0:
            return None
        s = 1.0 if way > 0 else -1.0
        braked, pushed = self._ends(before, bound, s)
        best, share, step = None, 0.0, 1.0
        for _ in range(_HALVINGS):
            more = share + step
            after = tuple(b + more * (p - b) for b, p in zip(braked, pushed, strict=True))
            if abs(after[0] - before[0]) <= bound.speed * dt and lawful(after):
                onward = s * (_stops_at(after, bound) - _stops_at(target, bound))
                if onward <= 0:
                    best, share = after, more
            if more == 1.0 and best is not None:
                return best
            step /= 2
        return best

    def _ends(self, before: State, bound: Bound, s: float) -> tuple[State, State]:
        """Return the states after a tick of braking and of full jerk along `s`, within the limit of acceleration."""
        position, speed, acceleration = before
        way, *rates = Stop.of(speed, acceleration, bound).after(self.dt_s)
        rising = min(max((bound.acceleration - s * acceleration) / bound.jerk, 0.0), self.dt_s)
        rising_to = _moved((position, speed, acceleration), s * bound.jerk, rising)
        return (position + way, *rates), _moved(rising_to, 0.0, self.dt_s - rising)


def _stops_at(state: State, bound: Bound) -> float:
    return state[0] + Stop.of(state[1], state[2], bound).after(math.inf)[0]


Chase = TimeOptimalChase | StopChase
FASTEST: Final[type[Chase]] = TimeOptimalChase if find_spec("ruckig") else StopChase
