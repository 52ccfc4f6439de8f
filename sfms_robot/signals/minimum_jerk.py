"""The minimum-jerk curve from rest to rest, by which movements of joints, faces and eyes begin and end."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from sfms_robot.frames import Doubles

Share = TypeVar("Share", float, Doubles)


def minimum_jerk(time_share: Share) -> Share:
    """Return the share of the way at a share of the time, both 0 to 1; speed and acceleration are 0 at both ends.

    Source: Flash and Hogan, "The coordination of arm movements", J. Neuroscience 5 (1985), 1688, for a straight line.
    """
    return time_share**3 * (10 - 15 * time_share + 6 * time_share**2)


def ease(time_share: Share) -> Share:
    """Return `minimum_jerk`, at rest before and after its time."""
    time_share = np.minimum(np.maximum(time_share, 0.0), 1.0)
    return minimum_jerk(time_share)
