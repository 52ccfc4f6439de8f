"""One angle over two joints in series, and a one-pole low-pass."""

from __future__ import annotations

import numpy as np

from sfms_robot.frames import Doubles

Range = tuple[float, float]


def low_pass(angle_rad: float, before_rad: float, cutoff_hz: float, dt_s: float) -> float:
    """One step of a one-pole low-pass, exact for an angle that holds still during `dt_s`."""
    return float(before_rad + (1.0 - np.exp(-2.0 * np.pi * cutoff_hz * dt_s)) * (angle_rad - before_rad))


def shared(total_rad: Doubles, lower_rad: Doubles, lower: Range, upper: Range) -> tuple[Doubles, Doubles]:
    """Total (...) and the lower joint's part (...) -> both joints' angles inside their ranges.

    What one joint cannot take the other does, so the sum is the total wherever both together can.
    """
    below = np.clip(lower_rad, *lower)
    above = np.clip(total_rad - below, *upper)
    return np.clip(total_rad - above, *lower), above
