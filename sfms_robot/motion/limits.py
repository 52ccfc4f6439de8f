"""Position, speed, acceleration and jerk of every joint, never exceeded.

The law: after every tick the state (position, speed, acceleration) of a joint can be brought to a stop inside its
range, its speed and acceleration being within their limits all the way. A tick keeps it like this:

1. If one tick of bounded jerk leads exactly to the reference sample, and the law holds there, the sample passes
   unchanged: no lag, no chatter. Three equal pieces of constant jerk meet any position, speed and acceleration
   exactly, so the test is a 3x3 product for all joints at once.
2. Otherwise ruckig plans the fastest way to the reference and its first tick is the candidate, if the law holds.
3. Otherwise the joint brakes for one tick. The braking curve of a lawful state stays lawful, so by induction there
   is always a way out.

A joint that is found outside its range starts there, and the range reaches out to it until it has come in.

Finite differences of the positions sent are averages of the speed, acceleration and jerk between them, hence within
the same limits. A reference that is not finite is refused: the joint brakes, and the tick is counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import ruckig
from numpy.typing import NDArray

from sfms_robot.config import Head
from sfms_robot.frames import Doubles

Bools = NDArray[np.bool_]

# Rounding eats into a limit at about 1e-9 of it; the law is tested at 1e-6.
_HEADROOM = 1 - 2e-7
_SLACK = 1e-9
_POSITION_SLACK_RAD = 1e-10

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


class JerkLimiter:
    """Implements `ports.Limiter` for joints that share one tick of `dt_s`."""

    def __init__(self, limits: JointLimits, dt_s: float) -> None:
        self._low, self._high = limits.low, limits.high
        self._speed = limits.speed * _HEADROOM
        self._acceleration = limits.acceleration * _HEADROOM
        self._jerk = limits.jerk * _HEADROOM
        self._dt_s = dt_s
        self._piece, self._piece_bounds = self._one_tick()
        self._stop_s, self._per_acceleration = self._acceleration / self._jerk, 0.5 / self._acceleration
        self._speed_slack, self._acceleration_slack = self._speed * (1 + _SLACK), self._acceleration * (1 + _SLACK)
        self._far = self._absurd(self._low, self._high)
        self._planner = ruckig.Ruckig(1)
        self._path = ruckig.Trajectory(1)
        bounds = zip(self._speed.tolist(), self._acceleration.tolist(), self._jerk.tolist(), strict=True)
        self._inputs = [_input(*bound, dt_s) for bound in bounds]

    def start(self, angles_rad: Doubles) -> LimiterState:
        """At rest at `angles_rad` (J,), in its range or not. Raises ValueError when an angle is not finite."""
        if not np.isfinite(angles_rad).all():
            raise ValueError(f"joint {int(np.argmin(np.isfinite(angles_rad)))} starts at an angle that is not finite")
        still = np.zeros_like(self._low)
        low, high = np.minimum(self._low, angles_rad), np.maximum(self._high, angles_rad)
        return LimiterState(np.stack([angles_rad, still, still]), low, high)

    def restart(self, joints: Bools, angles_rad: Doubles, state: LimiterState) -> LimiterState:
        """Some `joints` (J,) stand still at `angles_rad` (J,), in their range or not; the others go on."""
        motion = np.where(
            joints, np.stack([angles_rad, np.zeros_like(angles_rad), np.zeros_like(angles_rad)]), state.motion
        )
        low = np.where(joints, np.minimum(self._low, angles_rad), state.low)
        high = np.where(joints, np.maximum(self._high, angles_rad), state.high)
        return replace(state, motion=motion, low=low, high=high)

    def step(self, reference_rad: Doubles, state: LimiterState) -> tuple[Doubles, LimiterState]:
        """Reference (3, J) one tick ahead -> angles (J,) that may be sent, and the state after the tick."""
        finite: Bools = np.logical_and.reduce(np.isfinite(reference_rad), axis=0)
        low, high = state.low, state.high
        floor, ceiling = self._far if low is self._low and high is self._high else self._absurd(low, high)
        given = reference_rad if finite.all() else np.where(finite, reference_rad, state.motion)
        wanted = np.minimum(np.maximum(given, floor), ceiling)
        after = wanted.copy()
        lawful = self._lawful(wanted, low, high)
        passes = finite & self._in_one_tick(state.motion, wanted) & lawful
        hard = np.flatnonzero(~passes)
        if len(hard):
            targets = self._targets(wanted, lawful, low, high)
            for j in hard.tolist():
                after[:, j] = self._chased(j, state.motion[:, j], targets[:, j]) if finite[j] else np.nan
            brakes = ~(passes | self._lawful(after, low, high))
            if brakes.any():
                stop = Stop.of(state.motion, self._acceleration, self._jerk).after(self._dt_s)
                stop[0] += state.motion[0]
                after = np.where(brakes, stop, after)
        after[0] = np.minimum(np.maximum(after[0], low), high)
        if low is not self._low or high is not self._high:
            low, high = self._come_in(after, low, high)
        refused = int(len(finite) - np.count_nonzero(finite))
        chased = state.chased + len(hard) - refused
        return after[0].copy(), LimiterState(after, low, high, chased, state.refused + refused)

    def _come_in(self, motion: Doubles, low: Doubles, high: Doubles) -> tuple[Doubles, Doubles]:
        """The range in force, without the way out where a joint is lawful in its own range."""
        inside = self._lawful(motion, self._low, self._high)
        if inside.all():
            return self._low, self._high
        return np.where(inside, self._low, low), np.where(inside, self._high, high)

    def _absurd(self, low: Doubles, high: Doubles) -> tuple[Doubles, Doubles]:
        """Just out of the limits, below and above (3, J): what is farther out is brought here, for 1e300 overflows."""
        ceiling = np.stack([1 + high, 2 * self._speed, 2 * self._acceleration])
        return np.stack([low - 1, -ceiling[1], -ceiling[2]]), ceiling

    def _one_tick(self) -> tuple[Doubles, Doubles]:
        """What three pieces of constant jerk lead from one state to the next take: (6, 6) matrix, bounds (6, J).

        The matrix takes both states, one below the other (6, J), to the three jerks, the accelerations between the
        pieces, and the way.
        """
        dt = self._dt_s
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
        bounds = [self._jerk, self._jerk, self._jerk, self._acceleration, self._acceleration, self._speed * dt]
        return np.concatenate([jerks, inner, [[-1.0, 0, 0, 1, 0, 0]]]), np.stack(bounds)

    def _in_one_tick(self, motion: Doubles, wanted: Doubles) -> Bools:
        """Whether three pieces of bounded jerk lead from `motion` to `wanted` (3, J) in one tick."""
        needed = self._piece @ np.concatenate([motion, wanted])
        ok: Bools = np.logical_and.reduce(np.abs(needed) <= self._piece_bounds, axis=0)
        return ok

    def _lawful(self, motion: Doubles, low: Doubles, high: Doubles) -> Bools:
        """Whether states (3, J) can stop inside the range, speed and acceleration within limits all the way.

        Nothing that is not finite is lawful.
        """
        p, v, a = motion
        speed, size = np.abs(motion[1:])
        lasts = size / self._jerk  # how long it takes until the acceleration is gone
        gain = 0.5 * a * lasts
        peak = v + gain  # speed by then
        # Stopping takes no more way than: acceleration to 0 first, then a whole stop from the highest speed. The other
        # way it only goes until it has turned round, which takes no longer than the acceleration lasts.
        top = speed + np.abs(gain)
        way, back = top * (lasts + self._stop_s + top * self._per_acceleration), speed * lasts
        onward = peak >= 0
        below, above = p - np.where(onward, back, way), p + np.where(onward, way, back)
        ok: Bools = np.maximum(speed, np.abs(peak)) <= self._speed_slack
        ok &= size <= self._acceleration_slack
        if not ((below >= low) & (above <= high)).all():
            first, last = Stop.of(motion, self._acceleration, self._jerk).extent()
            ok &= (p + first >= low - _POSITION_SLACK_RAD) & (p + last <= high + _POSITION_SLACK_RAD)
        return ok

    def _targets(self, wanted: Doubles, lawful: Bools, low: Doubles, high: Doubles) -> Doubles:
        """`wanted` (3, J) made something ruckig may aim at: inside the range, lawful, or else standing still."""
        p, v, a = wanted
        inside = np.minimum(np.maximum(p, low), high)
        v = np.minimum(np.maximum(v, -self._speed), self._speed)
        a = np.minimum(np.maximum(a, -self._acceleration), self._acceleration)
        target = np.stack([inside, v, a])
        if not lawful.all():
            target[1:] *= lawful | (inside == p)  # outside, it is to stop at the edge
            target[2] *= self._lawful(target, low, high)
            target[1:] *= self._lawful(target, low, high)
        return target

    def _chased(self, j: int, motion: Doubles, target: Doubles) -> Doubles:
        """State (3,) of joint j after the first tick of the fastest way to `target`; NaN where ruckig finds none."""
        given = self._inputs[j]
        given.current_position, given.current_velocity, given.current_acceleration = ([x] for x in motion.tolist())
        given.target_position, given.target_velocity, given.target_acceleration = ([x] for x in target.tolist())
        try:
            self._planner.calculate(given, self._path)
        except ruckig.RuckigError:
            return np.full(3, np.nan)
        return np.array(self._path.at_time(self._dt_s))[:, 0]


def _input(speed: float, acceleration: float, jerk: float, dt_s: float) -> ruckig.InputParameter:
    given = ruckig.InputParameter(1)
    given.max_velocity, given.max_acceleration, given.max_jerk = [speed], [acceleration], [jerk]
    given.minimum_duration = dt_s
    return given


@dataclass(frozen=True)
class Stop:
    """The fastest stop from states (3, J), everything along s, the sign of the speed once the acceleration is gone.

    Jerk -J until the acceleration is -peak, which is held where it is the limit, then +J; all (J,).
    """

    s: Doubles
    speed: Doubles
    acceleration: Doubles
    jerk: Doubles
    times_s: tuple[Doubles, Doubles, Doubles]

    @classmethod
    def of(cls, motion: Doubles, acceleration: Doubles, jerk: Doubles) -> Stop:
        v, a = motion[1], motion[2]
        s = np.where(v + a * np.abs(a) / (2 * jerk) >= 0, 1.0, -1.0)
        v, a = s * v, s * a
        peak = np.minimum(np.sqrt(np.maximum(jerk * v + a**2 / 2, 0.0)), acceleration)
        t1 = np.maximum((a + peak) / jerk, 0.0)
        t2 = np.maximum(v + a * t1 - jerk * t1**2 / 2 - peak**2 / (2 * jerk), 0.0) / acceleration
        return cls(s, v, a, jerk, (t1, t2, peak / jerk))

    def after(self, time_s: float) -> Doubles:
        """Way, speed and acceleration (3, J), with their signs, `time_s` into the stop; inf for its end."""
        p, v, a = np.zeros_like(self.speed), self.speed, self.acceleration
        left = np.full_like(v, time_s)
        for jerk, lasts in zip((-self.jerk, 0.0, self.jerk), self.times_s, strict=True):
            t = np.minimum(lasts, left)
            left = left - t
            p, v, a = p + v * t + a * t**2 / 2 + jerk * t**3 / 6, v + a * t + jerk * t**2 / 2, a + jerk * t
        over = left > 0  # what rounding leaves of speed and acceleration at the end is none
        return np.stack([self.s * p, np.where(over, 0.0, self.s * v), np.where(over, 0.0, self.s * a)])

    def extent(self) -> tuple[Doubles, Doubles]:
        """How far it goes below and above the position it starts from [rad].

        Where the joint moves against s at first, it turns round on the way, while the acceleration still falls.
        """
        end = self.after(np.inf)[0]
        back = np.minimum(self.speed, 0.0)
        t = (self.acceleration - np.sqrt(np.maximum(self.acceleration**2 + 2 * self.jerk * back, 0.0))) / self.jerk
        turn = np.where(back < 0, self.s * (back * t + self.acceleration * t**2 / 2 - self.jerk * t**3 / 6), 0.0)
        return np.minimum(np.minimum(end, turn), 0.0), np.maximum(np.maximum(end, turn), 0.0)
