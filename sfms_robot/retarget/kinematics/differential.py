"""A differential gimbal: two servos that together pitch and against each other roll.

left = a pitch + b roll, right = a pitch - b roll.
"""

from __future__ import annotations

import numpy as np

from sfms_robot.frames import Doubles


def servo_angles(pitch_rad: Doubles, roll_rad: Doubles, pitch_gain: float, roll_gain: float) -> Doubles:
    """Pitch and roll (...) -> left and right (..., 2)."""
    pitch, roll = pitch_gain * pitch_rad, roll_gain * roll_rad
    return np.stack([pitch + roll, pitch - roll], axis=-1)


def axis_angles(servos_rad: Doubles, pitch_gain: float, roll_gain: float) -> tuple[Doubles, Doubles]:
    """Left and right (..., 2) -> pitch and roll (...)."""
    left, right = servos_rad[..., 0], servos_rad[..., 1]
    return (left + right) / (2 * pitch_gain), (left - right) / (2 * roll_gain)


def within(servos_rad: Doubles, low_rad: Doubles, high_rad: Doubles) -> Doubles:
    """Both servos (..., 2) shrunk by one factor until both are in range (2,), which holds 0.

    One factor keeps pitch : roll as asked, where clipping each servo would turn a nod into a tilt.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        over = np.where(servos_rad > high_rad, high_rad / servos_rad, 1.0)
        under = np.where(servos_rad < low_rad, low_rad / servos_rad, 1.0)
    factor = np.minimum(over, under).min(axis=-1, keepdims=True)
    out: Doubles = np.clip(servos_rad * factor, low_rad, high_rad)
    return out
