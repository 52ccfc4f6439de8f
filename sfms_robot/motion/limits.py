"""Position, speed, acceleration and jerk of every joint, never exceeded.

The law: after every tick the state (position, speed, acceleration) of a joint can be brought to a stop inside its
range, its speed and acceleration being within their limits all the way. A tick keeps it like this:

1. If one tick of bounded jerk leads exactly to the reference sample, and the law holds there, the sample passes
   unchanged: no lag, no chatter. Three equal pieces of constant jerk meet any position, speed and acceleration
   exactly, so the test is a 3x3 product for all joints at once.
2. Otherwise the candidate is the first tick of a way to the reference (`motion.chase`), if the law holds.
3. Otherwise the joint brakes for one tick. The braking curve of a lawful state stays lawful, so by induction there
   is always a way out.

Nearly always all joints pass, and bounds that are a little too strict but cost a few array operations for all of them
show it. The joints that they do not settle are looked at one by one.

A joint that is found outside its own range starts there, and the range in force (`sfms_robot.ranges`) reaches out to
it. There the law also says that the stop of a joint never turns back: it moves in or stands still, and its braking
curve inherits that. Where the reference does not bring it in, `WayIn` does, so that it is inside its own range
after `latest_s` whatever the reference is, and stays.

Finite differences of the positions sent are averages of the speed, acceleration and jerk between them, hence within
the same limits. A reference that is not finite is refused: the joint brakes, and the tick is counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from sfms_robot.config import Head
from sfms_robot.frames import Doubles
from sfms_robot.motion.chase import SLACK, Bound, ChaseFactory, State, Stop, build_chase, lawful, moves_in
from sfms_robot.ranges import Bools, Range
from sfms_robot.signals.minimum_jerk import minimum_jerk

_HEADROOM: Final = 1 - 2e-7  # of a limit, for rounding; the law is tested at 1e-6
_EDGE_SLACK_RAD: Final = 1e-12  # so that rounding does not make a joint at the end of its range a hard case

GENTLE_S: Final = 2.0  # longer than the easing of a run, so that usually the face asked for is ahead of the curve
_SHARE: Final = 0.8
# Highest speed, acceleration and jerk of 10 u^3 - 15 u^4 + 6 u^5 over u = 0..1.
_PEAKS: Final = (15 / 8, 10 / 3**0.5, 60.0)

# Three pieces of a third each, jerks (1, 0, 0), (0, 1, 0), (0, 0, 1): what they add to acceleration, speed, position
# at the end of a tick of length 1. The inverse turns what is missing into jerks.
_JERKS_FOR = np.linalg.inv(np.array([[1 / 3, 1 / 3, 1 / 3], [5 / 18, 3 / 18, 1 / 18], [19 / 162, 7 / 162, 1 / 162]]))


@dataclass(frozen=True)
class JointLimits:
    """All (J,): range [rad], speed [rad/s], acceleration [rad/s^2], jerk [rad/s^3]."""

    low: Doubles
    high: Doubles
    speed: Doubles
    acceleration: Doubles
    jerk: Doubles

    @classmethod
    def of(cls, head: Head, joints: Sequence[str] | None = None) -> JointLimits:
        """Of a head's joints, all of them or those of one bus."""
        names = tuple(head.joints) if joints is None else joints
        classes = [head.limit(name) for name in names]
        return cls(
            np.array([head.joints[name].min_rad for name in names]),
            np.array([head.joints[name].max_rad for name in names]),
            np.radians([limit.speed_deg_s for limit in classes]),
            np.radians([limit.acceleration_deg_s2 for limit in classes]),
            np.radians([limit.jerk_deg_s3 for limit in classes]),
        )

    @property
    def range(self) -> Range:
        return Range(self.low, self.high)


def curve_s(distance_rad: Doubles, speed: Doubles, acceleration: Doubles, jerk: Doubles) -> Doubles:
    """Duration [s] (J,) of the curves over `distance_rad` (J,), under limits (J,)."""
    v, a, j = (peak * distance_rad / _SHARE for peak in _PEAKS)
    return np.asarray(np.maximum.reduce([v / speed, np.sqrt(a / acceleration), np.cbrt(j / jerk)]).clip(GENTLE_S))


def latest_s(distance_rad: Doubles, speed: Doubles, acceleration: Doubles, jerk: Doubles) -> Doubles:
    """Time [s] (J,) in which a joint `distance_rad` (J,) outside its range is inside it, whatever it is asked for.

    The duration of its curve, and once it stands still at the end of that: to come to a stop, wherever the joint is
    by then, and to come in from there as fast as the limits allow.
    """
    ramp = speed / acceleration + acceleration / jerk
    return np.asarray(curve_s(distance_rad, speed, acceleration, jerk) + distance_rad / speed + 2 * ramp)


@dataclass(frozen=True)
class WayIn:
    """The curves by which joints that were found outside their own ranges come in, (J,) each.

    From the angle where a joint was found to the near end of its range leads a quintic with neither speed nor
    acceleration at its ends. It is slow (at least `GENTLE_S`) and uses at most `_SHARE` of each limit. A joint that is
    asked to be farther out than this curve, or for a value that is not finite, gets the curve as its reference. A joint
    that was found inside has a curve of no length, which is not used.

    Attributes:
        found_rad: where each was found.
        edge_rad: the near end of its range.
        duration_s: of its curve.
        elapsed_s: since it was found.
    """

    found_rad: Doubles
    edge_rad: Doubles
    duration_s: Doubles
    elapsed_s: Doubles

    @classmethod
    def of(cls, found_rad: Doubles, own: Range, *limits: Doubles) -> WayIn:
        """`limits`: speed, acceleration, jerk (J,)."""
        edge_rad = own.nearest(found_rad)
        return cls(found_rad, edge_rad, curve_s(np.abs(found_rad - edge_rad), *limits), np.zeros_like(found_rad))

    def after(self, dt_s: float) -> WayIn:
        return WayIn(self.found_rad, self.edge_rad, self.duration_s, self.elapsed_s + dt_s)

    def replaced(self, joints: Bools, by: WayIn) -> WayIn:
        """With other curves of some `joints` (J,)."""
        mine = (self.found_rad, self.edge_rad, self.duration_s, self.elapsed_s)
        theirs = (by.found_rad, by.edge_rad, by.duration_s, by.elapsed_s)
        return WayIn(*(np.where(joints, new, old) for new, old in zip(theirs, mine, strict=True)))

    def now(self) -> Doubles:
        """Angle, speed and acceleration (3, J) of the curves."""
        u = np.minimum(self.elapsed_s / self.duration_s, 1.0)
        left = 1.0 - minimum_jerk(u)
        speed = -30 * u**2 * (1 - u) ** 2 / self.duration_s
        acceleration = -60 * u * (1 - u) * (1 - 2 * u) / self.duration_s**2
        curve: Doubles = (self.found_rad - self.edge_rad) * np.stack([left, speed, acceleration])
        curve[0] += self.edge_rad
        return curve

    def guided(self, reference_rad: Doubles) -> Doubles:
        """References (3, J), and the curve in place of those that are farther out than it, or not finite."""
        curve = self.now()
        way_out = np.sign(self.found_rad - self.edge_rad)
        with np.errstate(invalid="ignore"):
            ahead = np.isfinite(reference_rad).all(axis=0) & ((reference_rad[0] - curve[0]) * way_out <= 0)
        return np.where(ahead, reference_rad, curve)


@dataclass(frozen=True)
class LimiterState:
    """Position, speed, acceleration (3, J) after the last tick, and what was counted.

    Attributes:
        way_in: how joints that were found outside their own ranges come in; None once all are inside.
        chased: ticks x joints where the reference was out of reach.
        refused: ticks x joints where the reference was not finite.
    """

    motion: Doubles
    way_in: WayIn | None = None
    chased: int = 0
    refused: int = 0


@dataclass(frozen=True)
class _Bounds:
    """A range in force, as the array arithmetic needs it.

    Attributes:
        range: (J,).
        middle: (J,).
        floor, ceiling: (3, J) just out of the limits: what is farther out is brought here, for 1e300 overflows.
        needed: (10, J) at most, of what `JerkLimiter._needed` gives.
    """

    range: Range
    middle: Doubles
    floor: Doubles
    ceiling: Doubles
    needed: Doubles


class JerkLimiter:
    """Implements `ports.Limiter` for joints that share one tick of `dt_s`. `chase`: the fastest there is by default."""

    def __init__(self, limits: JointLimits, dt_s: float, chase: ChaseFactory = build_chase) -> None:
        self._speed = limits.speed * _HEADROOM
        self._acceleration = limits.acceleration * _HEADROOM
        self._jerk = limits.jerk * _HEADROOM
        self._dt_s = dt_s
        self._piece = _one_tick(dt_s)
        self._stop_s, self._per_acceleration = self._acceleration / self._jerk, 0.5 / self._acceleration
        self._own = limits.range
        self._own_bounds = self._within(self._own)
        each = zip(self._speed.tolist(), self._acceleration.tolist(), self._jerk.tolist(), strict=True)
        self._bounds = [Bound(*bound) for bound in each]
        self._ends = list(zip(limits.low.tolist(), limits.high.tolist(), strict=True))
        self._chase = chase(self._bounds, dt_s)

    def start(self, angles_rad: Doubles) -> LimiterState:
        """At rest at `angles_rad` (J,), in its range or not. Raises ValueError when an angle is not finite."""
        if not np.isfinite(angles_rad).all():
            raise ValueError(f"joint {int(np.argmin(np.isfinite(angles_rad)))} starts at an angle that is not finite")
        still = np.zeros_like(self._own.low)
        return self._found(LimiterState(np.stack([angles_rad, still, still])), np.ones(len(still), np.bool_))

    def restart(self, joints: Bools, angles_rad: Doubles, state: LimiterState) -> LimiterState:
        """Some `joints` (J,) stand still at `angles_rad` (J,), in their range or not; the others go on."""
        still = np.zeros_like(angles_rad)
        motion = np.where(joints, np.stack([angles_rad, still, still]), state.motion)
        return self._found(replace(state, motion=motion), joints)

    def latest_in_s(self, angles_rad: Doubles) -> Doubles:
        """Time [s] (J,) after which joints found at `angles_rad` (J,) are inside their ranges, whatever is asked."""
        out_rad = np.abs(angles_rad - self._own.nearest(angles_rad))
        latest = latest_s(out_rad, self._speed, self._acceleration, self._jerk)
        return np.where(out_rad == 0, 0.0, latest)

    def _found(self, state: LimiterState, joints: Bools) -> LimiterState:
        angles_rad = state.motion[0]
        if self._own.holds(angles_rad).all():
            return replace(state, way_in=None)
        found = WayIn.of(angles_rad, self._own, self._speed, self._acceleration, self._jerk)
        return replace(state, way_in=found if state.way_in is None else state.way_in.replaced(joints, found))

    def step(self, reference_rad: Doubles, state: LimiterState) -> tuple[Doubles, LimiterState]:
        """Reference (3, J) one tick ahead -> angles (J,) that may be sent, and the state after the tick."""
        if state.way_in is None:
            after, chased, refused = self._tick(reference_rad, state.motion, self._own_bounds)
            return after[0].copy(), LimiterState(after, None, state.chased + chased, state.refused + refused)
        way_in = state.way_in.after(self._dt_s)
        outside = ~self._own.holds(state.motion[0])
        guided = np.where(outside, way_in.guided(reference_rad), reference_rad)
        within = self._within(self._own.reaching(state.motion[0]))
        after, chased, refused = self._tick(guided, state.motion, within, outside)
        left_out = outside & ~np.isfinite(reference_rad).all(axis=0)
        refused += int(np.count_nonzero(left_out))
        still_out = way_in if not self._own.holds(after[0]).all() else None
        return after[0].copy(), LimiterState(after, still_out, state.chased + chased, state.refused + refused)

    def brake(self, state: LimiterState) -> tuple[Doubles, LimiterState]:
        """Every joint one tick on its way to a stop, as fast as its limits allow; one that stands stays.

        Angles (J,) that may be sent, and the state after the tick. Never leads a joint farther out than it is.
        """
        before = state.motion.T.tolist()
        after = np.array([self._braked(j, joint) for j, joint in enumerate(before)]).T
        reach = self._own.reaching(state.motion[0])
        np.clip(after[0], reach.low, reach.high, out=after[0])
        return after[0].copy(), replace(state, motion=after)

    def _tick(
        self, reference_rad: Doubles, motion: Doubles, within: _Bounds, outside: Bools | None = None
    ) -> tuple[Doubles, int, int]:
        """The state (3, J) one tick after `motion` (3, J), and how many joints were chased and refused.

        `outside` (J,): who is outside its own range; None: nobody.
        """
        low, high = within.range.low, within.range.high
        after = np.minimum(np.maximum(reference_rad, within.floor), within.ceiling)
        fine = self._needed(motion, after, within.middle) <= within.needed  # False for NaN
        if outside is not None:
            fine[6:, outside] = False
        chased = refused = 0
        if np.count_nonzero(fine) < fine.size:
            hard = np.flatnonzero(~np.logical_and.reduce(fine, axis=0))
            met = np.logical_and.reduce(fine[:6, hard], axis=0)
            each = [*motion[:, hard], *reference_rad[:, hard], *after[:, hard], low[hard], high[hard]]
            settled = []
            for j, ok, column in zip(hard.tolist(), met.tolist(), np.stack(each).T.tolist(), strict=True):
                before, reference, wanted, ends = column[:3], column[3:6], column[6:9], column[9:]
                if not all(map(math.isfinite, reference)):
                    settled.append(self._braked(j, before))
                    refused += 1
                elif ok and self._lawful(j, wanted, *ends):
                    settled.append(wanted)
                else:
                    settled.append(self._chased(j, before, wanted, *ends))
                    chased += 1
            after[:, hard] = np.array(settled).T
        np.maximum(after[0], low, out=after[0])
        np.minimum(after[0], high, out=after[0])
        return after, chased, refused

    def _lawful(self, j: int, state: State, low: float, high: float) -> bool:
        """Whether joint j, the range in force being low..high, may go to `state`."""
        first, last, bound = self._ends[j][0], self._ends[j][1], self._bounds[j]
        if low == first and high == last:
            return lawful(state, low, high, bound)
        if not low <= state[0] <= high:
            return False
        if first <= state[0] <= last:
            return lawful(state, first, last, bound)
        way = 1.0 if low < first else -1.0
        return lawful(state, low, high, bound) and moves_in(state, way, bound)

    def _within(self, limits: Range) -> _Bounds:
        low, high = limits.low, limits.high
        ceiling = np.stack([1 + high, 2 * self._speed, 2 * self._acceleration])
        half = (high - low) / 2 + _EDGE_SLACK_RAD
        one_tick = [self._jerk] * 3 + [self._acceleration] * 2 + [self._speed * self._dt_s]
        stop = [self._speed * (1 + SLACK), self._acceleration * (1 + SLACK), half, half]
        floor = np.stack([low - 1, -ceiling[1], -ceiling[2]])
        return _Bounds(limits, (low + high) / 2, floor, ceiling, np.stack([*one_tick, *stop]))

    def _needed(self, motion: Doubles, wanted: Doubles, middle: Doubles) -> Doubles:
        """What it takes to go from `motion` to `wanted` (3, J) in one tick, and to stop from there: sizes (10, J).

        The six of `_one_tick`; the highest speed and acceleration of the stop; and how far from the middle of the
        range it leads, along and against its way. Stopping takes no more way than: acceleration to 0 first, then a
        whole stop from the highest speed. The other way it only goes until it has turned round, which takes no longer
        than the acceleration lasts.
        """
        out = np.empty((10, wanted.shape[1]))
        np.matmul(self._piece, np.concatenate([motion, wanted]), out=out[:6])
        speed, size = np.abs(wanted[1:])
        lasts = size / self._jerk  # how long it takes until the acceleration is gone
        gain = 0.5 * size * lasts  # of speed by then
        top = speed + gain
        onward = wanted[1] + np.copysign(gain, wanted[2])
        off = wanted[0] - middle
        out[6], out[7] = top, size
        np.add(off, np.copysign(top * (lasts + self._stop_s + top * self._per_acceleration), onward), out=out[8])
        np.subtract(off, np.copysign(speed * lasts, onward), out=out[9])
        return np.abs(out, out=out)

    def _chased(self, j: int, before: State, wanted: State, low: float, high: float) -> State:
        """Joint j one tick on its way to what is possible of `wanted`; braked where that is not lawful."""
        target = _possible(wanted, low, high, self._bounds[j])
        lawful_next = partial(self._lawful, j, low=low, high=high)
        after = self._chase.step(j, before, target, lawful_next)
        if (low, high) != self._ends[j]:
            # To meet a reference that moves, a joint may want to take a run-up. One outside its own range goes on.
            still = self._chase.step(j, before, (target[0], 0.0, 0.0), lawful_next)
            way = 1.0 if low < self._ends[j][0] else -1.0
            after = max((each for each in (after, still) if each), key=lambda each: way * each[1], default=None)
        return self._braked(j, before) if after is None else after

    def _braked(self, j: int, before: State) -> State:
        way, speed, acceleration = Stop.of(before[1], before[2], self._bounds[j]).after(self._dt_s)
        return before[0] + way, speed, acceleration


def _one_tick(dt: float) -> Doubles:
    """What three pieces of constant jerk lead from one state to the next take: (6, 6).

    It takes both states, one below the other (6, J), to the three jerks, the two accelerations between, and the way.
    """
    missing = np.array(
        [
            [0, 0, -1 / dt, 0, 0, 1 / dt],
            [0, -1 / dt**2, -1 / dt, 0, 1 / dt**2, 0],
            [-1 / dt**3, -1 / dt**2, -1 / (2 * dt), 1 / dt**3, 0, 0],
        ]
    )
    jerks = _JERKS_FOR @ missing
    inner = np.stack([jerks[0] * (dt / 3), -jerks[2] * (dt / 3)])
    inner[0, 2] += 1.0
    inner[1, 5] += 1.0
    return np.concatenate([jerks, inner, [[-1.0, 0, 0, 1, 0, 0]]])


def _possible(wanted: State, low: float, high: float, bound: Bound) -> State:
    """What may be aimed at: `wanted` where it is lawful, else inside the range, and slower or standing still."""
    position = _clipped(wanted[0], low, high)
    speed = _clipped(wanted[1], -bound.speed, bound.speed)
    acceleration = _clipped(wanted[2], -bound.acceleration, bound.acceleration)
    if lawful(wanted, low, high, bound):
        return position, speed, acceleration
    if position == wanted[0]:  # outside, it is to stop at the edge
        for target in ((position, speed, acceleration), (position, speed, 0.0)):
            if lawful(target, low, high, bound):
                return target
    return position, 0.0, 0.0


def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
