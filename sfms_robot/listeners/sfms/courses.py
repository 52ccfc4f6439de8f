"""A smile or a nod that is told goes as people's do: what it draws lies near the course of one of its size.

Both are rare, so a small predictor knows that one is told better than how far it has to go by now: left to itself it
raises the corners of a mouth too little, at any time within a second, and makes one short nod in four hardly at all.
While one is told each class of its group loses what a normal distribution around the course takes from it,

    log p  -=  (value - course)^2 / (2 spread^2),

the value being that of the code, or, of the transition, that of the keyframe that is held. So a keyframe comes when
what is held has left the course, and of the codes those that fit; which of them, and what else the group does, the
predictor still decides. With nothing told nothing is changed.

A smile has a course all along: corners that rise, and fall before its end; a laugh, which is larger, has none. A nod
has one where its swings turn, at the lowest point of each and between them: how it gets there is not told.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import NodCourse, SmileCourse
from sfms_robot.frames import FRAME_S, Doubles, Floats
from sfms_robot.listeners.sfms.keyframes import Tokens
from sfms_robot.signals.control import COLUMNS, FULL_SIZE, since_s

_AT: Final = {name: at for at, name in enumerate(COLUMNS)}
_TURN: Final = 2 * math.pi
_LEAST_RAD: Final = 1e-6


@dataclass(frozen=True)
class Course:
    """Where one channel should be in every row told.

    Attributes:
        wanted: (...,) NaN where that is not known. spread: (...,) how far from it is left to the predictor.
    """

    wanted: Doubles
    spread: Doubles


@dataclass(frozen=True)
class ToldCourse:
    """What is told does to the odds of one group.

    Attributes:
        how: the course. group: its place among the groups. values: (V,) of each of its codes, in the unit of the
            course: radians nose down of a nod, 0 to 1 of a smile.
    """

    how: SmileCourse | NodCourse
    group: int
    values: Doubles

    def course(self, control: Floats) -> Course | None:
        """Of rows (..., T, K) of control, in their order: (..., T); None where none of them tells of one."""
        kind = "smile" if isinstance(self.how, SmileCourse) else "nod"
        if not control[..., _AT[f"{kind}.active"]].any():
            return None
        if isinstance(self.how, SmileCourse):
            return smile_course(self.how, control)
        return nod_course(self.how, control)

    def penalties(self, wanted: Doubles, spread: Doubles, last: Tokens) -> tuple[NDArray[np.intp], Floats]:
        """A row of the `course` of streams (B,), and their last keyframes (B,), 0 for none -> for which of them there
        is one (S,), and what classes 0, 1, ... lose in log-odds (S, V + 1).
        """
        told = np.flatnonzero(np.isfinite(wanted))
        token = last[told]
        held = np.where(token > 0, self.values[np.maximum(token - 1, 0)], 0.0)
        every = np.concatenate([held[:, None], np.broadcast_to(self.values, (len(token), len(self.values)))], axis=1)
        off = (every - wanted[told, None]) / spread[told, None]
        return told, (off**2 / 2).astype(np.float32)


def smile_course(smile: SmileCourse, control: Floats) -> Course:
    """Of the corners of the mouth, 0 to 1."""
    told = (control[..., _AT["smile.active"]] > 0) & (control[..., _AT["laugh.active"]] == 0)
    since = since_s(control[..., _AT["smile.since"]])
    over = control[..., _AT["smile.over"]].astype(np.float64)
    left = np.where(over > 0, since * (1 / np.maximum(over, 1e-6) - 1), np.inf)
    wanted = np.where(told, control[..., _AT["smile.size"]] * smile_share(smile, since, left), np.nan)
    return Course(wanted, np.full_like(wanted, smile.spread))


def smile_share(smile: SmileCourse, since: Doubles, left: Doubles) -> Doubles:
    """Share of its size that a smile has `since` its beginning, with so much `left` of it, both in seconds."""
    rise = np.interp(since, smile.RISE_S, smile.rise)
    return np.asarray(np.minimum(rise, np.interp(left, smile.FALL_S, smile.fall)))


def nod_course(nod: NodCourse, control: Floats) -> Course:
    """Of the pitch, radians, in the two rows about the middle of each swing, and in that nearest to its end."""
    told = control[..., _AT["nod.active"]] > 0
    size = control[..., _AT["nod.size"]].astype(np.float64) * FULL_SIZE["nod"]
    turned, step = _turned(control, told)
    ended = np.zeros_like(told)
    ended[..., 1:] = ~told[..., 1:] & told[..., :-1]  # the row behind the last one may lie nearest to the end
    for values, more in ((turned, step), (size, 0.0), (step, 0.0)):
        values[..., 1:] = np.where(ended[..., 1:], (values + more)[..., :-1], values[..., 1:])
    swing, angle = np.divmod(turned, _TURN)
    low = (told | ended) & (np.abs(angle - math.pi) <= step)
    back = (told | ended) & (np.minimum(angle, _TURN - angle) <= step / 2) & (turned > math.pi)
    off = angle - math.pi
    nearest = off - step * np.round(off / np.maximum(step, _LEAST_RAD))  # of the rows, to the middle
    there = size * nod.fall**swing * (1 + np.cos(off)) / np.maximum(1 + np.cos(nearest), _LEAST_RAD)
    wanted = np.where(low, there, np.where(back, 0.0, np.nan))
    return Course(wanted, nod.spread * np.maximum(size, _LEAST_RAD))


def _turned(control: Floats, told: NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
    """How far the swings of a nod have turned since its beginning, radians, and by how much they do from row to row;
    0 where only one row of it is known.
    """
    angle = np.arctan2(control[..., _AT["nod.sine"]], control[..., _AT["nod.cosine"]]).astype(np.float64) % _TURN
    since = since_s(control[..., _AT["nod.since"]])
    same = told[..., 1:] & told[..., :-1] & (since[..., 1:] > since[..., :-1])
    ahead = np.where(same, np.diff(angle, axis=-1) % _TURN, 0.0)
    step = np.zeros_like(angle)
    step[..., 1:] = ahead
    step[..., :-1] = np.where(same, ahead, step[..., :-1])
    whole = np.round((since / FRAME_S * step - angle) / _TURN)
    return angle + _TURN * whole, step
