"""The ease of least jerk from rest to rest: how a movement of a joint, a face or an eye begins and ends."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from sfms_robot.frames import Doubles

Share = TypeVar("Share", float, Doubles)


def minimum_jerk(time_share: Share) -> Share:
    """Share of the way covered at a share of the time, both 0 to 1; speed and acceleration are 0 at both ends.

    Source: Flash and Hogan, "The coordination of arm movements", J. Neuroscience 5 (1985), 1688, for a straight line.
    """
    return time_share**3 * (10 - 15 * time_share + 6 * time_share**2)


def ease(time_share: Share) -> Share:
    """`minimum_jerk`, at rest before its time and after it."""
    time_share = np.minimum(np.maximum(time_share, 0.0), 1.0)
    return minimum_jerk(time_share)
