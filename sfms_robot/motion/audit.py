"""Audit of a command stream, which shares no arithmetic with the limiter.

Angles are checked as float64, by finite differences at nominal dt; ticks as sent over the wire, where rounding allows
one tick more per period.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfms_robot.frames import Bools, Doubles, Ints
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import JointLimits

_TOLERANCE = 1e-6
_CHANGED_RAD = 1e-6


@dataclass(frozen=True)
class AuditState:
    """The last three angles (3, J), oldest first, the last ticks (J,), and the counts so far (ticks x joints)."""

    recent_rad: Doubles
    ticks: Ints
    violations: int = 0
    clamped: int = 0


class CommandAudit:
    """Audit of the joints of one bus; `calibration` has the same joints in the same order."""

    def __init__(self, limits: JointLimits, calibration: Calibration, dt_s: float) -> None:
        self._own, self._calibration = limits.range, calibration
        self._bounds = np.stack([limits.speed * dt_s, limits.acceleration * dt_s**2, limits.jerk * dt_s**3])
        self._bounds *= 1 + _TOLERANCE
        self._stride_ticks = limits.speed * dt_s * np.abs(calibration.ticks_per_rad) * (1 + _TOLERANCE) + 1

    def start(self, angles_rad: Doubles) -> AuditState:
        """Return the state at rest at `angles_rad` (J,), the start of the limiter."""
        return AuditState(np.tile(angles_rad, (3, 1)), self._calibration.to_ticks(angles_rad))

    def restart(self, joints: Bools, angles_rad: Doubles, state: AuditState) -> AuditState:
        """Return the state with some `joints` (J,) at rest at `angles_rad` (J,); the way there was not commanded."""
        recent = np.where(joints, angles_rad, state.recent_rad)
        ticks = np.where(joints, self._calibration.to_ticks(angles_rad), state.ticks)
        return replace(state, recent_rad=recent, ticks=ticks)

    def step(self, angles_rad: Doubles, wanted_rad: Doubles, state: AuditState) -> AuditState:
        """Count one command (J,) against the limits, and against `wanted_rad` (J,), the reference of the limiter.

        A joint that breaks several limits in one tick counts once. A joint outside its own range may stay there and
        come in, but not go farther out (`sfms_robot.ranges`). An angle that is not finite is a violation, and not kept.
        """
        finite = np.isfinite(angles_rad)
        angles = np.where(finite, angles_rad, state.recent_rad[-1])
        stream = np.concatenate([state.recent_rad, angles[None]])
        first = stream[1:] - stream[:-1]
        second = first[1:] - first[:-1]
        differences = np.stack([first[-1], second[-1], second[-1] - second[-2]])
        bad = ~finite | ~self._own.reaching(state.recent_rad[-1]).holds(angles)
        bad |= np.logical_or.reduce(np.abs(differences) > self._bounds, axis=0)

        ticks = self._calibration.to_ticks(angles)
        bad |= (ticks < self._calibration.low_ticks) | (ticks > self._calibration.high_ticks)
        bad |= np.abs(ticks - state.ticks) > self._stride_ticks
        with np.errstate(invalid="ignore"):
            clamped = ~(np.abs(angles_rad - wanted_rad) <= _CHANGED_RAD)
        return AuditState(
            stream[1:],
            ticks,
            state.violations + int(np.count_nonzero(bad)),
            state.clamped + int(np.count_nonzero(clamped)),
        )
