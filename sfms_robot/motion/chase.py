"""One tick of one joint on its way to a reference that it cannot meet in one tick.

`ruckig` (Berscheid and Kroeger, 2021) plans the fastest way, where it is installed. It has no wheel for Linux on ARM;
`StopChase` is the fallback without it: always lawful, a little slower to arrive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, Final, Protocol

from sfms_robot.motion.stop import Bound, State, Stop

HAS_RUCKIG: Final = find_spec("ruckig") is not None
_HALVINGS: Final = 16

Lawful = Callable[[State], bool]


class Chase(Protocol):
    """A way to follow, for joints that share one tick."""

    def step(self, joint: int, before: State, target: State, lawful: Lawful) -> State | None:
        """The state one tick after `before` on the way to `target`, both lawful; None where there is no lawful one."""


ChaseFactory = Callable[[Sequence[Bound], float], Chase]


def build_chase(bounds: Sequence[Bound], dt_s: float) -> Chase:
    """The fastest there is for joints within `bounds` at ticks of `dt_s`."""
    return TimeOptimalChase(bounds, dt_s) if HAS_RUCKIG else StopChase(bounds, dt_s)


class TimeOptimalChase:
    """The first tick of ruckig's fastest way."""

    def __init__(self, bounds: Sequence[Bound], dt_s: float) -> None:
        import ruckig

        self._errors = (ruckig.RuckigError, ValueError)  # no way at the rim of the law, or one of hours (-101, unnamed)
        self._planner, self._path, self._dt_s = ruckig.Ruckig(1), ruckig.Trajectory(1), dt_s
        self._inputs = [self._input(ruckig.InputParameter(1), bound) for bound in bounds]

    def _input(self, given: Any, bound: Bound) -> Any:
        given.max_velocity, given.max_acceleration, given.max_jerk = [bound.speed], [bound.acceleration], [bound.jerk]
        given.minimum_duration = self._dt_s
        return given

    def step(self, joint: int, before: State, target: State, lawful: Lawful) -> State | None:
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


class StopChase:
    """As much jerk toward the target as lets the joint still stop where the target would stop.

    A state reached in one tick by a mixture of braking and full jerk is the same mixture of the two states, and the
    more jerk, the farther on its stop ends: so the mixture is found by halving.
    """

    def __init__(self, bounds: Sequence[Bound], dt_s: float) -> None:
        self._bounds, self._dt_s = bounds, dt_s

    def step(self, joint: int, before: State, target: State, lawful: Lawful) -> State | None:
        bound, dt = self._bounds[joint], self._dt_s
        way = self._stops_at(target, bound) - self._stops_at(before, bound)
        if way == 0:
            return None
        s = 1.0 if way > 0 else -1.0
        braked, pushed = self._ends(before, bound, s)
        best, share, step = None, 0.0, 1.0
        for _ in range(_HALVINGS):
            more = share + step
            after = tuple(b + more * (p - b) for b, p in zip(braked, pushed, strict=True))
            if abs(after[0] - before[0]) <= bound.speed * dt and lawful(after):
                onward = s * (self._stops_at(after, bound) - self._stops_at(target, bound))
                if onward <= 0:
                    best, share = after, more
            if more == 1.0 and best is not None:
                return best
            step /= 2
        return best

    def _ends(self, before: State, bound: Bound, s: float) -> tuple[State, State]:
        """One tick of braking, and one of full jerk along `s` as far as the acceleration may go."""
        position, speed, acceleration = before
        way, *rates = Stop.of(speed, acceleration, bound).after(self._dt_s)
        rising = min(max((bound.acceleration - s * acceleration) / bound.jerk, 0.0), self._dt_s)
        pushed = [*before]
        for jerk, lasts in ((s * bound.jerk, rising), (0.0, self._dt_s - rising)):
            p, v, a = pushed
            pushed = [
                p + lasts * (v + lasts * (a / 2 + lasts * jerk / 6)),
                v + lasts * (a + lasts * jerk / 2),
                a + lasts * jerk,
            ]
        return (position + way, *rates), pushed

    @staticmethod
    def _stops_at(state: State, bound: Bound) -> float:
        return state[0] + Stop.of(state[1], state[2], bound).after(float("inf"))[0]
