"""The motion space of a listener, as its models and streams use it: our motion in, our motion out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfms_robot import config
from sfms_robot.frames import FRAME_S, MOTION_DIM, SPACE_CHANNELS, Doubles, Floats, Plan
from sfms_robot.signals import spaces
from sfms_robot.signals.spaces import FlameMatrix, read_matrix


@dataclass(frozen=True)
class MotionSpace:
    """A space by its name, with what a listener's configuration says of it.

    Attributes:
        neutral: (D,) the face at rest in the space.
        limitation: one line about what cannot be shown, or None.
    """

    name: str
    neutral: Doubles
    metres_per_unit: float | None = None
    flame: FlameMatrix | None = None

    @classmethod
    def of(cls, settings: config.ListenerSettings, folder: Path | None = None) -> MotionSpace:
        """Return the space of a listener; a matrix is read from its `folder`, if given: only showing motion needs it.

        Raises ConfigError when the matrix file is missing or unreadable.
        """
        matrix = None
        if settings.flame_matrix is not None and folder is not None:
            matrix = read_matrix(folder / settings.flame_matrix)
        rest = spaces.rest_of(settings.motion_space) if settings.neutral is None else np.array(settings.neutral)
        return cls(settings.motion_space, rest, settings.metres_per_unit, matrix)

    @property
    def dim(self) -> int:
        return len(SPACE_CHANNELS[self.name])

    @property
    def limitation(self) -> str | None:
        return spaces.limitation(self.name, self.flame)

    def decode(self, frames: Floats) -> tuple[Floats, Floats | None]:
        """Return our motion (N, 58) of frames (N, D), and the jaw (N, 3) [rad] where the space has one."""
        if self.name == "arkit58":
            shown = np.array(frames, dtype=np.float32)
            np.clip(shown[:, 6:], 0.0, 1.0, out=shown[:, 6:])
            return shown, None
        return spaces.decode(
            frames, self.name, neutral=self.neutral, metres_per_unit=self.metres_per_unit, flame=self.flame
        )

    def plan(self, made_at_s: float, frames: Floats) -> Plan:
        """Return frames (H, D) as the plan that follows a speaker's frame which ended at `made_at_s`."""
        motion, jaw_rad = self.decode(frames)
        return Plan(made_at_s, np.add(made_at_s, FRAME_S * np.arange(1, 1 + len(frames))), motion, jaw_rad)

    def encode(self, motion: Floats) -> Floats:
        """Return our motion (N, 58) in the space (N, D). deca56 takes pose and jaw; its expression stays at rest."""
        if motion.shape[-1] != MOTION_DIM:
            raise ValueError(f"motion is {motion.shape}, not (N, {MOTION_DIM})")
        if self.name == "arkit58":
            return motion
        return spaces.encode(motion, self.name, neutral=self.neutral, metres_per_unit=self.metres_per_unit)
