"""Eyes that hold a point while the head moves, and jump to the next.

What is held is a direction in space: eye + neck_gain x head. While it is held, every degree that the head turns is
taken back by the eyes (the vestibulo-ocular reflex), so that a nod does not shake the gaze. The head is the one that
the neck will show, not the one asked for: what intensity or range takes away, the eyes need not take back. The eyes
follow the listener only when its gaze has really gone elsewhere: when both its eyes and its direction in space have
left the dead zone, for a moment. Then they jump, with the duration a human eye takes, and hold again. (Eyes alone would
jump at every nod of a listener that already turns them against the head; the direction in space alone, at every nod of
one that does not.) Eyes that compensating has turned too far from where the listener has them jump back.

Lids need no rule: their drives follow eyeLookUp and eyeLookDown, which are written here.

A jump begins at the latest instant of the tick in which it is decided, so that no joint, whatever its lead, jumps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfms_robot.config import Gaze
from sfms_robot.frames import YAW_PITCH, Doubles, Floats
from sfms_robot.retarget.gaze_target import Aim, turned
from sfms_robot.signals.eye_angles import Jump, directions, turn

ShownPose = Callable[[Floats], Doubles]  # motion (N, 58) -> the pose (N, 6) that the neck will show


@dataclass(frozen=True)
class GazeState:
    """What is remembered between ticks.

    Attributes:
        jump: the last one, in space; its end is what is held.
        eyes_rad: (2,) where the listener's eyes were when it was decided.
        away_since_s: since when the listener's gaze has been elsewhere.
    """

    jump: Jump
    eyes_rad: Doubles
    away_since_s: float | None = None


class GazeHold:
    """Turns the eye channels of a motion into fixations and saccades."""

    def __init__(self, config: Gaze) -> None:
        self._gain = config.neck_gain
        self._dead_zone_rad = math.radians(config.dead_zone_deg)
        self._recentre_rad = math.radians(config.recentre_deg)
        self._settle_s = config.settle_ms / 1e3
        self._pause_s = config.pause_ms / 1e3
        self.full_rad = config.full_rad

    def step(
        self,
        motion: Floats,
        times_s: Doubles,
        state: GazeState | None,
        shown_pose: ShownPose | None = None,
        aim: Aim | None = None,
    ) -> tuple[Floats, GazeState]:
        """Motion (N, 58) at (N,) instants, with other eyes; `state` None begins by holding what is looked at.

        `shown_pose` None: the neck shows the very pose that is asked. `aim`: what is held is beside it, and the head is
        turned by its part.
        """
        both_rad = directions(motion, self.full_rad)  # (N, eye, axis)
        eyes_rad = 0.5 * (both_rad[:, 0] + both_rad[:, 1])
        head_rad = self._head(motion, times_s, shown_pose)
        last = int(np.argmax(times_s))
        state = self._decided(eyes_rad[last], head_rad[last], times_s, state)
        apart_rad = both_rad - eyes_rad[:, None]  # vergence stays the listener's
        held_rad = state.jump.at(times_s)
        out = motion.copy()
        if aim is not None:
            held_rad = held_rad + aim.gaze_rad
            if aim.head_rad.any():
                out = turned(motion, aim)
                head_rad = self._head(out, times_s, shown_pose)
        turn(out, (held_rad - head_rad)[:, None] + apart_rad, self.full_rad)
        return out, state

    def _head(self, motion: Floats, times_s: Doubles, shown_pose: ShownPose | None) -> Doubles:
        """Yaw and pitch (N, 2) that the eyes take back. Joints share their leads, so each instant is solved once."""
        if shown_pose is None or self._gain == 0:
            pose: Floats | Doubles = motion
        else:
            _, first, which = np.unique(times_s, return_index=True, return_inverse=True)
            pose = shown_pose(motion[first])[which]
        return self._gain * pose.take(YAW_PITCH, axis=-1).astype(np.float64)

    def _decided(self, eyes_rad: Doubles, head_rad: Doubles, times_s: Doubles, state: GazeState | None) -> GazeState:
        """The state after hearing where the listener looks at the latest of the instants."""
        now_s = float(times_s.max())
        target_rad = eyes_rad + head_rad
        if state is None:
            return GazeState(Jump.between(target_rad, target_rad, now_s), eyes_rad)
        held_rad = state.jump.end_rad
        off_rad = math.dist(target_rad, held_rad)
        shifted = min(off_rad, math.dist(eyes_rad, state.eyes_rad)) > self._dead_zone_rad
        if not shifted and off_rad <= self._recentre_rad:
            return replace(state, away_since_s=None)
        since_s = now_s if state.away_since_s is None else state.away_since_s
        spread_s = now_s - float(times_s.min())  # the jump before has to be over at the earliest instant
        free = now_s - state.jump.end_s >= max(self._pause_s, spread_s)
        if not free or now_s - since_s < self._settle_s - 1e-9:
            return replace(state, away_since_s=since_s)
        return GazeState(Jump.between(held_rad, target_rad, now_s), eyes_rad)
