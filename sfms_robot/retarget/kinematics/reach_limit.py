"""The nearest pose that a head can reach: straight back toward home, to the border of what is reachable.

Home is inside the reach. Along the straight line home -> wanted pose (in roll, pitch, yaw, x, y, z) the border is the
first place where the reach ends; it is found by cutting the line into pieces and keeping the first one that leaves.
The answer depends on the wanted pose alone and changes continuously with it as long as the reach is star-shaped
about home, so a pose that moves smoothly in and out of reach gives a smooth one, with nothing to remember.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles

BLOCK: Final = 500  # poses at a time, for the memory that their pieces take
PIECES: Final = 32
PASSES: Final = 6  # to a billionth of the way: 32 ** 6 = 2 ** 30

Reachable = Callable[[Doubles], NDArray[np.bool_]]  # poses (n, 6) -> (n,)


def nearest(poses: Doubles, reachable: Reachable) -> tuple[Doubles, NDArray[np.bool_]]:
    """Poses (n, 6) -> poses that can be reached (n, 6), and which were (n,). Home is the zero pose.

    A pose that can be reached comes back as it is, even where the line to it leaves the reach for a while.
    """
    reached = reachable(poses)
    out = poses.copy()
    beyond = np.flatnonzero(~reached)
    for first in range(0, beyond.size, BLOCK):
        some = beyond[first : first + BLOCK]
        out[some] *= _share(poses[some], reachable)[:, None]
    return out, reached


def _share(poses: Doubles, reachable: Reachable) -> Doubles:
    """How much (n,) of each pose (n, 6) lies before the border, 0..1."""
    start, width = np.zeros(len(poses)), 1.0
    ends = np.arange(1, PIECES + 1) / PIECES
    for _ in range(PASSES):
        shares = start[:, None] + width * ends  # (n, pieces)
        inside = reachable((shares[..., None] * poses[:, None]).reshape(-1, 6)).reshape(shares.shape)
        whole = np.where(inside.all(axis=1), PIECES - 1, np.argmin(inside, axis=1))  # pieces before the leaving one
        width /= PIECES
        start = start + width * whole
    return start
