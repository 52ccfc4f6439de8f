"""How soon one keyframe may follow another: no channel moves faster than it ever did in the training motion.

Frames are drawn one at a time from probabilities that never quite reach zero; without this rule two codes far apart
may end up in neighbouring frames, which no head can follow and no face does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Floats
from sfms_robot.listeners.sfms.keyframes import Tokens

NEVER = 255  # frames, more than any window has
TINY = 1e-9  # for a channel that never moved


class Reach:
    """Frames needed from each token to each other one, per group. A row is worked out when it is first asked for.

    Args:
        motion: (V, C) motion of every code, V of the largest group; the codes of a smaller one are its first.
        channels: of each group; codes: how many it has.
        speed: (C,) fastest natural change of each channel from one frame to the next.
        bounded: else every code may follow every other at once; but a group never gets a code that it lacks.
    """

    def __init__(
        self,
        motion: Floats,
        channels: Sequence[Sequence[int]],
        codes: Sequence[int],
        speed: Floats,
        bounded: bool = True,
    ) -> None:
        self._classes = 1 + len(motion)
        self._bounded = bounded
        self._motion = [np.ascontiguousarray((motion[:size, own]).T) for own, size in zip(channels, codes, strict=True)]
        self._speed = [np.maximum(speed[own, None], TINY) for own in channels]
        self._rows: dict[tuple[int, int], NDArray[np.uint8]] = {}

    def too_soon(self, last: Tokens, gap: Tokens) -> NDArray[np.bool_]:
        """Tokens (B, G) of the last keyframes (0: none), frames since (B, G) -> classes (B, G, V + 1) out of reach."""
        needed = np.concatenate([self.needed(*each) for row in last.tolist() for each in enumerate(row)])
        passed = np.minimum(gap, NEVER - 1).astype(np.uint8)  # as wide as what it is compared with
        too_soon: NDArray[np.bool_] = needed.reshape(*last.shape, self._classes) > passed[..., None]
        return too_soon

    def needed(self, group: int, token: int) -> NDArray[np.uint8]:
        """(V + 1,) whole frames, at least, from a token to every class; class 0 may always follow, and anything may
        follow class 0, which is no keyframe yet.
        """
        row = self._rows.get((group, token))
        if row is None:
            motion = self._motion[group]
            row = np.zeros(self._classes, np.uint8)
            if token and self._bounded:
                frames = np.abs(motion - motion[:, token - 1, None]) / self._speed[group]
                row[1 : 1 + motion.shape[1]] = np.minimum(np.ceil(frames.max(0)), NEVER)
            row[1 + motion.shape[1] :] = NEVER
            self._rows[group, token] = row
        return row
