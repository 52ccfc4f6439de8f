"""What a head does of itself, put on the sampled face before it is mapped: sway, then gaze, then glances and blinks.

The order matters: the eyes hold their point against the idle head motion as well as against the listener's, and a
glance leaves from the held point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfms_robot.config import Gaze
from sfms_robot.config import Life as LifeConfig
from sfms_robot.frames import Doubles, Floats
from sfms_robot.retarget.gaze import GazeHold, GazeState, ShownPose
from sfms_robot.retarget.idle import IdleMotion, IdleState


@dataclass(frozen=True)
class LifeState:
    """What is remembered; None before the first step."""

    gaze: GazeState | None = None
    idle: IdleState | None = None


class Life:
    """Implements `ports.Life`. Parts that the configuration leaves out do nothing at all."""

    def __init__(self, config: LifeConfig, seed: int) -> None:
        eyes = config.gaze or Gaze()
        full_rad = np.radians([eyes.full_yaw_deg, eyes.full_pitch_deg])
        self._gaze = GazeHold(config.gaze) if config.gaze else None
        self._idle = IdleMotion(config.idle, full_rad, seed) if config.idle else None

    def start(self) -> LifeState:
        return LifeState()

    def step(
        self,
        motion: Floats,
        times_s: Doubles,
        now_s: float,
        state: LifeState,
        shown_pose: ShownPose | None = None,
    ) -> tuple[Floats, LifeState]:
        """Motion (N, 58) asked for at (N,) instants, row 0 at `now_s` -> the same, alive. Never changes its input.

        `shown_pose`: motion (N, 58) -> the pose (N, 6) that the neck will show; None: the one that is asked.
        """
        gaze, idle = state.gaze, state.idle
        if self._idle:
            idle = self._idle.watch(motion, times_s, now_s, idle)
            motion = self._idle.sway(motion, times_s, idle)
        if self._gaze:
            motion, gaze = self._gaze.step(motion, times_s, gaze, shown_pose)
        if self._idle and idle:
            motion = self._idle.look(motion, times_s, idle)
        return motion, LifeState(gaze, idle)
