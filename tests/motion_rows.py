"""Rows of motion with a few channels set."""

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM


def motion(**channels) -> np.ndarray:
    """A row (58,); what is not named is 0."""
    return motions(1, **channels)[0]


def motions(count: int, **channels) -> np.ndarray:
    """Rows (count, 58); a channel is a number, or (count,) of them."""
    rows = np.zeros((count, MOTION_DIM), np.float32)
    for name, values in channels.items():
        rows[:, CHANNEL_INDEX[name]] = values
    return rows
