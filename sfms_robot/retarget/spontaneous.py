"""What a head does of itself, put on the sampled face before it is mapped: sway, whom it looks at, gaze, glances and
blinks.

The order matters: the eyes hold their point against the idle head motion as well as against the listener's, and a
glance leaves from the held point. What is aimed at is beside what the listener looks at: the hold judges the listener
alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfms_robot.config import CameraMount, Gaze, Life
from sfms_robot.frames import POSE, Doubles, Floats
from sfms_robot.ports import Watched
from sfms_robot.retarget.gaze import GazeHold, GazeState, ShownPose
from sfms_robot.retarget.gaze_target import AimState, GazeTarget, turned
from sfms_robot.retarget.idle import IdleFiller, IdleState


@dataclass(frozen=True)
class LifeState:
    """What is remembered; None before the first step."""

    gaze: GazeState | None = None
    idle: IdleState | None = None
    aim: AimState | None = None


class HeadLife:
    """Implements `ports.SpontaneousMotion`. Parts that the configuration leaves out do nothing at all.

    `camera`: of the head; None: nobody can tell where people are, and the head looks straight at them.
    """

    def __init__(self, config: Life, seed: int, camera: CameraMount | None = None) -> None:
        self._gaze = GazeHold(config.gaze) if config.gaze else None
        self._idle = IdleFiller(config.idle, (config.gaze or Gaze()).full_rad, seed) if config.idle else None
        self._target = GazeTarget(config.person, config.gaze, camera, seed) if config.person else None

    def start(self) -> LifeState:
        return LifeState()

    def step(
        self,
        motion: Floats,
        times_s: Doubles,
        now_s: float,
        state: LifeState,
        shown_pose: ShownPose | None = None,
        watched: Watched | None = None,
    ) -> tuple[Floats, LifeState]:
        """Motion (N, 58) asked for at (N,) instants, row 0 at `now_s` -> the same, alive. Never changes its input.

        `shown_pose`: motion (N, 58) -> the pose (N, 6) that the neck will show; None: the one that is asked.
        `watched` None: nobody is looked at, nor away from.
        """
        gaze, idle, aim_state, aim = state.gaze, state.idle, state.aim, None
        if self._idle:
            idle = self._idle.watch(motion, times_s, now_s, idle)
            motion = self._idle.sway(motion, times_s, idle)
        if self._target and watched is not None:
            aim, aim_state = self._target.step(motion, times_s, now_s, watched, aim_state)
        if self._gaze:
            motion, gaze = self._gaze.step(motion, times_s, gaze, shown_pose, aim)
        elif aim is not None and aim.head_rad.any():
            motion = turned(motion, aim)
        if self._idle and idle:
            motion = self._idle.look(motion, times_s, idle)
        if self._target and aim_state and self._target.camera and self._target.camera.on_head:
            shown = shown_pose(motion[:1])[0] if shown_pose else motion[0, POSE].astype(np.float64)
            aim_state = self._target.remember(now_s, shown, aim_state)
        return motion, LifeState(gaze, idle, aim_state)
