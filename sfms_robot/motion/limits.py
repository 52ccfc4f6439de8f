"""Position, speed, acceleration and jerk of every joint, never exceeded.

The law: after every tick the state (position, speed, acceleration) of a joint can be brought to a stop inside its
range, its speed and acceleration being within their limits all the way. A tick keeps the law as follows:

1. If one tick of bounded jerk leads exactly to the reference sample, and the law holds there, the sample passes
   unchanged: no lag, no chatter. Three equal pieces of constant jerk meet any position, speed and acceleration
   exactly, so the test is a 3x3 product for all joints at once.
2. Otherwise the joint makes the first tick of a way to the reference (`motion.jerk_step`), if the law holds there.
3. Otherwise the joint brakes for one tick. The braking curve of a lawful state stays lawful, so by induction there
   is always a way out.

Nearly always all joints pass. Bounds that are a little too strict show this at the cost of a few array operations for
all joints. The joints that do not meet these bounds are checked one by one.

A joint that is found outside its own range starts there, and the range in force (`sfms_robot.ranges`) reaches out to
it. There the law also says that the stop of a joint never turns back: the joint moves in or stands still, and its
braking curve inherits that. If the reference does not bring the joint in, `Recovery` does, so that it is inside its own
range after a bounded time for any reference (docs/safety.md), and stays there.

Finite differences of the positions sent are averages of the speed, acceleration and jerk between them, and therefore
within the same limits. A reference that is not finite is refused: the joint brakes, and the tick is counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from sfms_robot.config import Head
from sfms_robot.frames import Bools, Doubles
from sfms_robot.motion.jerk_step import FASTEST, SLACK, Bound, Chase, State, Stop, lawful, moves_in
from sfms_robot.ranges import Range
from sfms_robot.signals.minimum_jerk import minimum_jerk

_HEADROOM: Final = 1 - 2e-7  # share of a limit that is used, because of rounding; the law is tested at 1e-6
_EDGE_SLACK_RAD: Final = 1e-12  # so that rounding does not make a joint at the end of its range a hard case

GENTLE_S: Final = 2.0  # shortest curve; longer than a run's easing, so that the requested face is usually ahead of it
_SHARE: Final = 0.8
# Highest speed, acceleration and jerk of 10 u^3 - 15 u^4 + 6 u^5 over u = 0..1.
_PEAKS: Final = (15 / 8, 10 / 3**0.5, 60.0)

# Three pieces of a third each, jerks (1, 0, 0), (0, 1, 0), (0, 0, 1): rows are their effects on acceleration, speed and
# position at the end of a tick of length 1. The inverse turns missing effects into jerks.
_JERKS_FOR = np.linalg.inv(np.array([[1 / 3, 1 / 3, 1 / 3], [5 / 18, 3 / 18, 1 / 18], [19 / 162, 7 / 162, 1 / 162]]))


@dataclass(frozen=True)
class JointLimits:
    """Limits of joints, (J,) each: range [rad], speed [rad/s], acceleration [rad/s^2], jerk [rad/s^3]."""

    low: Doubles
    high: Doubles
    speed: Doubles
    acceleration: Doubles
    jerk: Doubles

    @classmethod
    def of(cls, head: Head, joints: Sequence[str] | None = None) -> JointLimits:
        """Return the limits of a head's joints, all of them or those of one bus."""
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
    """Return the duration [s] (J,) of recovery curves over `distance_rad` (J,), under limits (J,)."""
    v, a, j = (peak * distance_rad / _SHARE for peak in _PEAKS)
    return np.asarray(np.maximum.reduce([v / speed, np.sqrt(a / acceleration), np.cbrt(j / jerk)]).clip(GENTLE_S))


def difference(before: Doubles, here: Doubles, ahead: Doubles, period_s: float) -> Doubles:
    """Return angle, speed and acceleration (3, J) at `here` from three samples (J,) one period apart."""
    return np.stack([here, (ahead - before) / (2 * period_s), (ahead - 2 * here + before) / period_s**2])


class Recovery(NamedTuple):
    """The curves by which joints that were found outside their own ranges come in, (J,) each.

    From the angle where a joint was found to the near end of its range leads a quintic with neither speed nor
    acceleration at its ends. It is slow (at least `GENTLE_S`) and uses at most `_SHARE` of each limit. Where the
    reference is farther out than this curve, or not finite, the curve takes its place. A joint that was found inside
    has a curve of length 0, which is not used.

    Attributes:
        found_rad: angle at which each joint was found.
        edge_rad: the near end of its range.
        duration_s: duration of its curve.
        elapsed_s: time since the joint was found.
    """

    found_rad: Doubles
    edge_rad: Doubles
    duration_s: Doubles
    elapsed_s: Doubles

    @classmethod
    def of(cls, found_rad: Doubles, own: Range, *limits: Doubles) -> Recovery:
        """Return the curves from `found_rad`; `limits`: speed, acceleration, jerk (J,)."""
        edge_rad = own.nearest(found_rad)
        return cls(found_rad, edge_rad, curve_s(np.abs(found_rad - edge_rad), *limits), np.zeros_like(found_rad))

    def replaced(self, joints: Bools, by: Recovery) -> Recovery:
        """Return the curves with others for some `joints` (J,)."""
        return Recovery(*(np.where(joints, new, old) for new, old in zip(by, self, strict=True)))

    def now(self) -> Doubles:
        """Return angle, speed and acceleration (3, J) of the curves."""
        u = np.minimum(self.elapsed_s / self.duration_s, 1.0)
        left = 1.0 - minimum_jerk(u)
        speed = -30 * u**2 * (1 - u) ** 2 / self.duration_s
        acceleration = -60 * u * (1 - u) * (1 - 2 * u) / self.duration_s**2
        curve: Doubles = (self.found_rad - self.edge_rad) * np.stack([left, speed, acceleration])
        curve[0] += self.edge_rad
        return curve

    def guided(self, reference_rad: Doubles) -> Doubles:
        """Return references (3, J); the curve replaces those that are farther out than it, or not finite."""
        curve = self.now()
        way_out = np.sign(self.found_rad - self.edge_rad)
        with np.errstate(invalid="ignore"):
            ahead = np.isfinite(reference_rad).all(axis=0) & ((reference_rad[0] - curve[0]) * way_out <= 0)
        return np.where(ahead, reference_rad, curve)


@dataclass(frozen=True)
class LimiterState:
    """Position, speed, acceleration (3, J) after the last tick, and counters.

    Attributes:
        recovery: curves of joints that were found outside their own ranges; None once all are inside.
        chased: ticks x joints where the reference was out of reach.
        refused: ticks x joints where the reference was not finite.
    """

    motion: Doubles
    recovery: Recovery | None = None
    chased: int = 0
    refused: int = 0


@dataclass(frozen=True, kw_only=True)
class _Bounds:
    """A range in force, prepared for the array arithmetic.

    Attributes:
        range: (J,) the range in force.
        middle: (J,) its middle.
        floor, ceiling: (3, J) just outside the limits: values farther out are moved here, because 1e300 overflows.
        needed: (10, J) bounds of the sizes that `JerkLimiter._needed` returns.
    """

    range: Range
    middle: Doubles
    floor: Doubles
    ceiling: Doubles
    needed: Doubles


class JerkLimiter:
    """Limiter of joints that share one tick of `dt_s`. `chase`: the fastest available by default."""

    def __init__(self, limits: JointLimits, dt_s: float, chase: type[Chase] = FASTEST) -> None:
        # The limits of this class are a little inside those of the head, so that rounding never crosses them.
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
        """Return the state at rest at `angles_rad` (J,), in range or not. Raises ValueError if one is not finite."""
        if not np.isfinite(angles_rad).all():
            raise ValueError(f"joint {int(np.argmin(np.isfinite(angles_rad)))} starts at an angle that is not finite")
        nowhere = LimiterState(np.zeros((3, len(angles_rad))))
        return self.restart(np.ones(len(angles_rad), np.bool_), angles_rad, nowhere)

    def restart(self, joints: Bools, angles_rad: Doubles, state: LimiterState) -> LimiterState:
        """Return the state with some `joints` (J,) at rest at `angles_rad` (J,), in range or not."""
        # Torque was off meanwhile: the speed of the last command is gone.
        still = np.zeros_like(angles_rad)
        motion = np.where(joints, np.stack([angles_rad, still, still]), state.motion)
        if self._own.holds(motion[0]).all():
            return replace(state, motion=motion, recovery=None)
        found = Recovery.of(motion[0], self._own, self._speed, self._acceleration, self._jerk)
        recovery = found if state.recovery is None else state.recovery.replaced(joints, found)
        return replace(state, motion=motion, recovery=recovery)

    def step(self, reference_rad: Doubles, state: LimiterState) -> tuple[Doubles, LimiterState]:
        """Return angles (J,) that may be sent for a reference (3, J) one tick ahead, and the state after the tick."""
        if state.recovery is None:
            after, chased, refused = self._tick(reference_rad, state.motion, self._own_bounds)
            return after[0].copy(), LimiterState(after, None, state.chased + chased, state.refused + refused)
        # Some joint is outside its own range: its curve leads where the reference does not.
        recovery = state.recovery._replace(elapsed_s=state.recovery.elapsed_s + self._dt_s)
        outside = ~self._own.holds(state.motion[0])
        guided = np.where(outside, recovery.guided(reference_rad), reference_rad)
        within = self._within(self._own.reaching(state.motion[0]))
        after, chased, refused = self._tick(guided, state.motion, within, outside)
        # `guided` replaces references that are not finite, so `_tick` does not see them; they are counted here.
        refused += int(np.count_nonzero(outside & ~np.isfinite(reference_rad).all(axis=0)))
        # Once all joints are inside, they stay inside: the range in force never reaches out again.
        still_out = recovery if not self._own.holds(after[0]).all() else None
        return after[0].copy(), LimiterState(after, still_out, state.chased + chased, state.refused + refused)

    def brake(self, state: LimiterState) -> tuple[Doubles, LimiterState]:
        """Brake every joint for one tick, as fast as its limits allow; a joint that stands still stays.

        Returns angles (J,) that may be sent, and the state after the tick. Never leads a joint farther out than it is.
        """
        before = state.motion.T.tolist()
        after = np.array([self._braked(j, joint) for j, joint in enumerate(before)]).reshape(-1, 3).T
        # By rounding, an angle may be outside the range in force by an ulp.
        reach = self._own.reaching(state.motion[0])
        np.clip(after[0], reach.low, reach.high, out=after[0])
        return after[0].copy(), replace(state, motion=after)

    def _tick(
        self, reference_rad: Doubles, motion: Doubles, within: _Bounds, outside: Bools | None = None
    ) -> tuple[Doubles, int, int]:
        """Return the state (3, J) one tick after `motion` (3, J), and how many joints were chased and refused.

        `outside` (J,): joints outside their own ranges; None for none.
        """
        low, high = within.range.low, within.range.high
        # 1. Joints that can meet the reference in one tick, and stop from there by the strict bounds, pass unchanged.
        after = np.minimum(np.maximum(reference_rad, within.floor), within.ceiling)
        fine = self._needed(motion, after, within.middle) <= within.needed  # False for NaN
        if outside is not None:
            fine[6:, outside] = False  # the bounds of a stop do not check that it never turns back
        chased = refused = 0
        if np.count_nonzero(fine) < fine.size:
            hard = np.flatnonzero(~np.logical_and.reduce(fine, axis=0))
            met = np.logical_and.reduce(fine[:6, hard], axis=0)  # reached in one tick; only the stop is in doubt
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
        # By rounding, an angle may be outside the range by an ulp.
        np.maximum(after[0], low, out=after[0])
        np.minimum(after[0], high, out=after[0])
        return after, chased, refused

    def _lawful(self, j: int, state: State, low: float, high: float) -> bool:
        """Return whether joint j may go to `state`, the range in force being low..high."""
        (first, last), bound = self._ends[j], self._bounds[j]
        if low == first and high == last:  # inside its own range
            return lawful(state, low, high, bound)
        if not low <= state[0] <= high:
            return False
        if first <= state[0] <= last:  # the joint comes in: from here on its own range applies
            return lawful(state, first, last, bound)
        # Still outside: the side on which the range in force reaches out shows the way in. The stop must not turn back.
        way = 1.0 if low < first else -1.0
        return lawful(state, low, high, bound) and moves_in(state, way, bound)

    def _within(self, limits: Range) -> _Bounds:
        low, high = limits.low, limits.high
        ceiling = np.stack([1 + high, 2 * self._speed, 2 * self._acceleration])
        half = (high - low) / 2 + _EDGE_SLACK_RAD
        # Rows as in `_needed`: three jerks, two accelerations, and the way of one tick,
        one_tick = [self._jerk] * 3 + [self._acceleration] * 2 + [self._speed * self._dt_s]
        # then speed and acceleration of the stop, and half the range, along its way and against it.
        stop = [self._speed * (1 + SLACK), self._acceleration * (1 + SLACK), half, half]
        floor = np.stack([low - 1, -ceiling[1], -ceiling[2]])
        needed = np.stack([*one_tick, *stop])
        return _Bounds(range=limits, middle=(low + high) / 2, floor=floor, ceiling=ceiling, needed=needed)

    def _needed(self, motion: Doubles, wanted: Doubles, middle: Doubles) -> Doubles:
        """Return the sizes (10, J) needed to go from `motion` to `wanted` (3, J) in one tick, and to stop from there.

        Rows 0..5 are those of `_one_tick`; 6 and 7 the highest speed and acceleration of the stop; 8 and 9 its farthest
        points from the middle of the range, along its way and against it. They are compared with `_Bounds.needed`.
        """
        out = np.empty((10, wanted.shape[1]))
        met, top, size, along, against = out[:6], out[6], out[7], out[8], out[9]
        np.matmul(self._piece, np.concatenate([motion, wanted]), out=met)
        q, v, a = wanted
        speed = np.abs(v)
        np.abs(a, out=size)
        # The acceleration is gone after |a| / J, and until then changes the speed by |a| / 2 on average.
        lasts = size / self._jerk
        gain = 0.5 * size * lasts
        np.add(speed, gain, out=top)
        # The stop has the direction of the speed once the acceleration is gone.
        onward = v + np.copysign(gain, a)
        off = q - middle
        # Along its way a stop is no longer than |a| / J at the highest speed, then a whole stop from it: the ramp of
        # the acceleration, A / J, at that speed, and the way of constant deceleration, top^2 / 2A.
        np.add(off, np.copysign(top * (lasts + self._stop_s + top * self._per_acceleration), onward), out=along)
        # Against it the joint moves only until it has turned round, which takes no longer than |a| / J.
        np.subtract(off, np.copysign(speed * lasts, onward), out=against)
        return np.abs(out, out=out)

    def _chased(self, j: int, before: State, wanted: State, low: float, high: float) -> State:
        """Return joint j one tick farther on its way to the possible part of `wanted`; braked if that is not lawful."""
        target = _possible(wanted, low, high, self._bounds[j])
        lawful_next = partial(self._lawful, j, low=low, high=high)
        after = self._chase.step(j, before, target, lawful_next)
        if (low, high) != self._ends[j]:
            # A joint may back up first to meet a moving reference. Outside its own range it must not turn back.
            still = self._chase.step(j, before, (target[0], 0.0, 0.0), lawful_next)
            way = 1.0 if low < self._ends[j][0] else -1.0
            after = max((each for each in (after, still) if each), key=lambda each: way * each[1], default=None)
        # The braking curve of a lawful state is lawful, so braking is always possible.
        return self._braked(j, before) if after is None else after

    def _braked(self, j: int, before: State) -> State:
        way, speed, acceleration = Stop.of(before[1], before[2], self._bounds[j]).after(self._dt_s)
        return before[0] + way, speed, acceleration


def _one_tick(dt: float) -> Doubles:
    """Return the matrix (6, 6) from two states to the three pieces of constant jerk that lead from one to the other.

    Columns are the state before, x = [q, v, a], and the state after, x'. Rows are the jerks j1, j2, j3 of the three
    thirds of the tick, the accelerations at the two inner corners, and the way q' - q.
    """
    # With jerks j held for h = dt / 3 each, a tick of length 1 leads from x to
    #   a' = a + (j1 + j2 + j3) / 3,   v' = v + a + (5 j1 + 3 j2 + j3) / 18,
    #   q' = q + v + a / 2 + (19 j1 + 7 j2 + j3) / 162,
    # with the inverse of `_JERKS_FOR` as weights. `missing` is the part of x' that jerk 0 does not reach, as jerk over
    # the whole tick: its rows are a' - a, v' - v - a dt, q' - q - v dt - a dt^2 / 2, divided by dt, dt^2, dt^3.
    missing = np.array(
        [
            [0, 0, -1 / dt, 0, 0, 1 / dt],
            [0, -1 / dt**2, -1 / dt, 0, 1 / dt**2, 0],
            [-1 / dt**3, -1 / dt**2, -1 / (2 * dt), 1 / dt**3, 0, 0],
        ]
    )
    jerks = _JERKS_FOR @ missing
    # Acceleration is highest at a corner: after the first third a + j1 h, before the last one a' - j3 h.
    inner = np.stack([jerks[0] * (dt / 3), -jerks[2] * (dt / 3)])
    inner[0, 2] += 1.0
    inner[1, 5] += 1.0
    return np.concatenate([jerks, inner, [[-1.0, 0, 0, 1, 0, 0]]])


def _possible(wanted: State, low: float, high: float, bound: Bound) -> State:
    """Return the target of a chase: `wanted` where it is lawful, else inside the range, slower or standing still."""
    position = _clipped(wanted[0], low, high)
    speed = _clipped(wanted[1], -bound.speed, bound.speed)
    acceleration = _clipped(wanted[2], -bound.acceleration, bound.acceleration)
    if lawful(wanted, low, high, bound):
        return position, speed, acceleration
    if position == wanted[0]:  # for a position outside, the target is a stop at the edge
        for target in ((position, speed, acceleration), (position, speed, 0.0)):
            if lawful(target, low, high, bound):
                return target
    return position, 0.0, 0.0


def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
