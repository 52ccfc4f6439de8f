"""How a servo that stands outside its own position limits is moved inside: by its own profile, slowly.

    family                    speed                      acceleration
    X, MX (2.0), velocity     profile velocity (112)     profile acceleration (108)
    X, MX (2.0), time         duration in ms (112)       ramp in ms (108), where drive mode bit 2 is set
    XL-320, AX                moving speed (32)          none
    MX (1.0)                  moving speed (32)          goal acceleration (73)
    STS                       goal speed (46)            acceleration (41)
    SCS                       goal speed (46)            none

Sources: ROBOTIS e-manual, "Drive Mode (10)" and "Profile Velocity (112)" of the X series, "Moving Speed (32)" of the AX
and MX series; Feetech STS memory table V3.6, SCS15 manual.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from sfms_robot.servo.registers import Field, Table

SPEED_DEG_S: Final = 20.0  # of the servo's shaft
INSIDE_DEG: Final = 1.0  # a servo under load hangs a little short of its goal, and friction stops it there
_RAMP_S: Final = 0.25  # to `SPEED_DEG_S`
_SLACK_S: Final = 1.0  # beyond twice the time that the way should take
_BY_TIME: Final = 0x04  # drive mode bit 2: the profile registers are durations
_ACCELERATIONS: Final = ("profile_acceleration", "goal_acceleration", "acceleration")
_DEG_S: Final = {"rpm": 6.0, "deg_per_s": 1.0}
_DEG_S2: Final = {"rev_per_min2": 0.1, "deg_per_s2": 1.0}


class WayInside(NamedTuple):
    """goal_ticks: where to. distance_deg: how far that is. bound_s: when it must have arrived."""

    goal_ticks: int
    distance_deg: float
    bound_s: float


def way_inside(present: int, limits: tuple[int, int], turn_ticks: float) -> WayInside | None:
    """The shortest way from `present` to inside `limits`, ticks.

    None where the nearer end lies beyond the end of the turn: a servo counts its ticks straight, and would go all the
    way round the other side.
    """
    low, high = limits
    outside = max(low - present, present - high)
    if 2 * outside > turn_ticks - (high - low):
        return None
    margin = min(round(INSIDE_DEG / 360.0 * turn_ticks), (high - low) // 2)
    goal = low + margin if present < low else high - margin
    distance_deg = abs(goal - present) * 360.0 / turn_ticks
    return WayInside(goal, distance_deg, 2.0 * distance_deg / SPEED_DEG_S + _SLACK_S)


def slow_profile(table: Table, drive_mode: int, distance_deg: float) -> Mapping[str, int]:
    """Values by register name that move a servo at `SPEED_DEG_S`; empty for a model without a speed of its own.

    0 would mean no limit, so that no value is less than 1.
    """
    speed = table.role("moving_speed")
    acceleration = next((table[name] for name in _ACCELERATIONS if name in table.fields), None)
    if speed is None:
        return {}
    if speed.name == "profile_velocity" and drive_mode & _BY_TIME:
        profile = {speed.name: max(1, round(1e3 * (distance_deg / SPEED_DEG_S + _RAMP_S)))}
        return profile if acceleration is None else {acceleration.name: round(1e3 * _RAMP_S / 2.0), **profile}
    profile = {speed.name: _raw(speed, SPEED_DEG_S, _DEG_S)}
    if acceleration is not None:
        profile[acceleration.name] = _raw(acceleration, SPEED_DEG_S / _RAMP_S, _DEG_S2)
    return profile


def _raw(field: Field, value: float, units: Mapping[str, float]) -> int:
    return max(1, int(value / (field.scale * units[field.unit])))
