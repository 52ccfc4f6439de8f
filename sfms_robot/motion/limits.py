"""Position, speed, acceleration and jerk of every joint, never exceeded.

The law: after every tick the state (position, speed, acceleration) of a joint can be brought to a stop inside its
range, its speed and acceleration being within their limits all the way. A tick keeps it like this:

1. If one tick of bounded jerk leads exactly to the reference sample, and the law holds there, the sample passes
   unchanged: no lag, no chatter. Three equal pieces of constant jerk meet any position, speed and acceleration
   exactly, so the test is a 3x3 product for all joints at once.
2. Otherwise ruckig plans the fastest way to the reference and its first tick is the candidate, if the law holds.
3. Otherwise the joint brakes for one tick. The braking curve of a lawful state stays lawful, so by induction there
   is always a way out.

Nearly always all joints pass, and bounds that are a little too strict but cost a few array operations for all of them
show it. The joints that they do not settle are looked at one by one.

A joint that is found outside its range starts there, and the range reaches out to it until it has come in.

Finite differences of the positions sent are averages of the speed, acceleration and jerk between them, hence within
the same limits. A reference that is not finite is refused: the joint brakes, and the tick is counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import ruckig
from numpy.typing import NDArray

from sfms_robot.config import Head
from sfms_robot.frames import Doubles
from sfms_robot.motion.stop import SLACK, Bound, State, Stop, lawful

Bools = NDArray[np.bool_]

_HEADROOM: Final = 1 - 2e-7  # of a limit, for rounding; the law is tested at 1e-6
_EDGE_SLACK_RAD: Final = 1e-12  # so that rounding does not make a joint at the end of its range a hard case

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


@dataclass(frozen=True)
class LimiterState:
    """Position, speed, acceleration (3, J) after the last tick, and what was counted.

    Attributes:
        low, high: (J,) the range in force: that of the joint, and out to where it was found until it has come in.
        chased: ticks x joints where the reference was out of reach.
        refused: ticks x joints where the reference was not finite.
    """

    motion: Doubles
    low: Doubles
    high: Doubles
    chased: int = 0
    refused: int = 0


@dataclass(frozen=True)
class _Range:
    """A range in force, as the array arithmetic needs it.

    Attributes:
        low, high, middle: (J,).
        floor, ceiling: (3, J) just out of the limits: what is farther out is brought here, for 1e300 overflows.
        bounds: (10, J) of what `JerkLimiter._needed` gives.
    """

    low: Doubles
    high: Doubles
    middle: Doubles
    floor: Doubles
    ceiling: Doubles
    bounds: Doubles


class JerkLimiter:
    """Implements `ports.Limiter` for joints that share one tick of `dt_s`."""

    def __init__(self, limits: JointLimits, dt_s: float) -> None:
        self._speed = limits.speed * _HEADROOM
        self._acceleration = limits.acceleration * _HEADROOM
        self._jerk = limits.jerk * _HEADROOM
        self._dt_s = dt_s
        self._piece = _one_tick(dt_s)
        self._stop_s, self._per_acceleration = self._acceleration / self._jerk, 0.5 / self._acceleration
        self._own = self._range(limits.low, limits.high)
        self._planner = ruckig.Ruckig(1)
        self._path = ruckig.Trajectory(1)
        each = zip(self._speed.tolist(), self._acceleration.tolist(), self._jerk.tolist(), strict=True)
        self._bounds = [Bound(*bound) for bound in each]
        self._inputs = [_input(bound, dt_s) for bound in self._bounds]

    def start(self, angles_rad: Doubles) -> LimiterState:
        """At rest at `angles_rad` (J,), in its range or not. Raises ValueError when an angle is not finite."""
        if not np.isfinite(angles_rad).all():
            raise ValueError(f"joint {int(np.argmin(np.isfinite(angles_rad)))} starts at an angle that is not finite")
        still = np.zeros_like(self._own.low)
        low, high = np.minimum(self._own.low, angles_rad), np.maximum(self._own.high, angles_rad)
        return LimiterState(np.stack([angles_rad, still, still]), low, high)

    def restart(self, joints: Bools, angles_rad: Doubles, state: LimiterState) -> LimiterState:
        """Some `joints` (J,) stand still at `angles_rad` (J,), in their range or not; the others go on."""
        still = np.zeros_like(angles_rad)
        motion = np.where(joints, np.stack([angles_rad, still, still]), state.motion)
        low = np.where(joints, np.minimum(self._own.low, angles_rad), state.low)
        high = np.where(joints, np.maximum(self._own.high, angles_rad), state.high)
        return replace(state, motion=motion, low=low, high=high)

    def step(self, reference_rad: Doubles, state: LimiterState) -> tuple[Doubles, LimiterState]:
        """Reference (3, J) one tick ahead -> angles (J,) that may be sent, and the state after the tick."""
        at_home = state.low is self._own.low and state.high is self._own.high
        within = self._own if at_home else self._range(state.low, state.high)
        after = np.minimum(np.maximum(reference_rad, within.floor), within.ceiling)
        fine = self._needed(state.motion, after, within.middle) <= within.bounds  # False for NaN
        chased, refused = state.chased, state.refused
        if np.count_nonzero(fine) < fine.size:
            hard = np.flatnonzero(~np.logical_and.reduce(fine, axis=0))
            met = np.logical_and.reduce(fine[:6, hard], axis=0)
            each = [
                *state.motion[:, hard],
                *reference_rad[:, hard],
                *after[:, hard],
                within.low[hard],
                within.high[hard],
            ]
            settled = []
            for j, ok, column in zip(hard.tolist(), met.tolist(), np.stack(each).T.tolist(), strict=True):
                before, reference, wanted, (low, high) = column[:3], column[3:6], column[6:9], column[9:]
                if not all(map(math.isfinite, reference)):
                    settled.append(self._braked(j, before))
                    refused += 1
                elif ok and lawful(wanted, low, high, self._bounds[j]):
                    settled.append(wanted)
                else:
                    settled.append(self._chased(j, before, wanted, low, high))
                    chased += 1
            after[:, hard] = np.array(settled).T
        angles = after[0]
        np.maximum(angles, within.low, out=angles)
        np.minimum(angles, within.high, out=angles)
        if at_home:
            return angles.copy(), LimiterState(after, state.low, state.high, chased, refused)
        return angles.copy(), LimiterState(after, *self._come_in(after, state.low, state.high), chased, refused)

    def _come_in(self, motion: Doubles, low: Doubles, high: Doubles) -> tuple[Doubles, Doubles]:
        """The range in force, without the way out where a joint is lawful in its own range."""
        own = zip(motion.T.tolist(), self._own.low.tolist(), self._own.high.tolist(), self._bounds, strict=True)
        inside = np.array([lawful((p, v, a), first, last, bound) for (p, v, a), first, last, bound in own])
        if inside.all():
            return self._own.low, self._own.high
        return np.where(inside, self._own.low, low), np.where(inside, self._own.high, high)

    def _range(self, low: Doubles, high: Doubles) -> _Range:
        ceiling = np.stack([1 + high, 2 * self._speed, 2 * self._acceleration])
        half = (high - low) / 2 + _EDGE_SLACK_RAD
        one_tick = [self._jerk] * 3 + [self._acceleration] * 2 + [self._speed * self._dt_s]
        stop = [self._speed * (1 + SLACK), self._acceleration * (1 + SLACK), half, half]
        floor = np.stack([low - 1, -ceiling[1], -ceiling[2]])
        return _Range(low, high, (low + high) / 2, floor, ceiling, np.stack([*one_tick, *stop]))

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
        """Joint j one tick on its fastest way to what is possible of `wanted`; braked where that is not lawful."""
        given, bound = self._inputs[j], self._bounds[j]
        position, speed, acceleration = _possible(wanted, low, high, bound)
        given.current_position, given.current_velocity, given.current_acceleration = ([x] for x in before)
        given.target_position, given.target_velocity, given.target_acceleration = [position], [speed], [acceleration]
        try:
            self._planner.calculate(given, self._path)
        except (
            ruckig.RuckigError,
            ValueError,
        ):  # it finds no way at the rim of the law, or one of hours (-101, unnamed)
            return self._braked(j, before)
        (position,), (speed,), (acceleration,) = self._path.at_time(self._dt_s)
        after = (position, speed, acceleration)
        return after if lawful(after, low, high, bound) else self._braked(j, before)

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


def _input(bound: Bound, dt_s: float) -> ruckig.InputParameter:
    given = ruckig.InputParameter(1)
    given.max_velocity, given.max_acceleration, given.max_jerk = [bound.speed], [bound.acceleration], [bound.jerk]
    given.minimum_duration = dt_s
    return given


def _possible(wanted: State, low: float, high: float, bound: Bound) -> State:
    """What ruckig may aim at: `wanted` where it is lawful, else inside the range, and slower or standing still."""
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
