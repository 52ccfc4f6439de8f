"""A smile that is told goes as people's do: what it draws lies near the course of one of its size.

Smiles are rare, so a small predictor knows that one is told better than how far the corners of the mouth are by now:
left to itself it raises them too little, at any time within a second. While one is told each class of the mouth's group
loses what a normal distribution around the course takes from it,

    log p  -=  (corners - course)^2 / (2 spread^2),

corners being those of the code, or, of the transition, those of the keyframe that is held. So a keyframe comes when
what is held has left the course, and of the codes those that fit; which of them, and what else the mouth does, the
predictor still decides. During a laugh, which is larger, and with no smile told nothing is changed.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import SmileCourse
from sfms_robot.frames import Doubles, Floats
from sfms_robot.listeners.sfms.keyframes import Tokens
from sfms_robot.signals.control import COLUMNS, since_s

_AT: Final = {name: at for at, name in enumerate(COLUMNS)}


def course(smile: SmileCourse, since: Doubles, left: Doubles) -> Doubles:
    """Share of its size that a smile has `since` its beginning, with so much `left` of it, both in seconds."""
    rise = np.interp(since, smile.RISE_S, smile.rise)
    return np.asarray(np.minimum(rise, np.interp(left, smile.FALL_S, smile.fall)))


class ToldSmiles:
    """What the smiles told do to the odds of one group.

    Args:
        group: its place among the groups.
        corners: (V,) 0..1 of each of its codes.
    """

    def __init__(self, smile: SmileCourse, group: int, corners: Floats) -> None:
        self.group, self._smile = group, smile
        self._corners = corners.astype(np.float64)

    def wanted(self, control: Floats) -> Doubles:
        """Rows (..., K) of control -> (...,) where the corners should be, NaN where that is not known."""
        told = (control[..., _AT["smile.active"]] > 0) & (control[..., _AT["laugh.active"]] == 0)
        since = since_s(control[..., _AT["smile.since"]])
        over = control[..., _AT["smile.over"]].astype(np.float64)
        left = np.where(over > 0, since * (1 / np.maximum(over, 1e-6) - 1), np.inf)
        return np.where(told, control[..., _AT["smile.size"]] * course(self._smile, since, left), np.nan)

    def penalties(self, wanted: Doubles, last: Tokens) -> tuple[NDArray[np.intp], Floats]:
        """Corners wanted of streams (B,), and their last keyframes (B,), 0 for none -> which of them smile (S,), and
        what classes 0, 1, ... lose in log-odds (S, V + 1).
        """
        smiling = np.flatnonzero(np.isfinite(wanted))
        token = last[smiling]
        held = np.where(token > 0, self._corners[np.maximum(token - 1, 0)], 0.0)
        every = np.concatenate(
            [held[:, None], np.broadcast_to(self._corners, (len(token), len(self._corners)))], axis=1
        )
        off = (every - wanted[smiling, None]) / self._smile.spread
        return smiling, (off**2 / 2).astype(np.float32)
