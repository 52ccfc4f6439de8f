"""`head fit --babble`: a head tries its face out, within its limits, and records it.

Every channel that the head follows rises and falls once, alone; then several at a time, at random, as faces do. Poses
of the head stay where they are, so that a camera in front of it sees the face throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app.head.pose import NobodyThere, WholeTimeline
from sfms_robot.app.open_head import HeadOptions, open_head
from sfms_robot.app.session import Programme, drive_head
from sfms_robot.app.wiring import SIM
from sfms_robot.config import Head
from sfms_robot.frames import BLENDSHAPES, MOTION_DIM, SHAPES, Doubles, Floats
from sfms_robot.runtime.recorder import FullPolicy, Recorder
from sfms_robot.runtime.safety import EASE_S, Interrupt
from sfms_robot.signals.minimum_jerk import ease

ALONE_S: Final = 1.6  # up and down again
TOGETHER_S: Final = 1.0  # from one random face to the next
AT_ONCE: Final = 6  # channels in a random face


@dataclass(frozen=True)
class Babbled:
    """What a babble did. `violations`: commands outside the limits."""

    head: Head
    exit: str
    seconds: float
    violations: int


def babble(name: str, port: str, record: Path, *, minutes: float = 2.0, seed: int = 0, yes: bool = False) -> Babbled:
    """Move, and write DIR/run.mcap; on emulated servos in virtual time. Raises RobotError, the head at rest."""
    with ExitStack() as stack:
        opened = stack.enter_context(open_head(HeadOptions(name, port, fast=port == SIM, yes=yes)))
        blind = set(opened.motion.retargeter.blind_channels)
        faces = Faces.of([i for i, shape in enumerate(BLENDSHAPES) if shape not in blind], 60.0 * minutes, seed)
        when_full: FullPolicy = "wait" if port == SIM else "drop"
        recorder = Recorder(record, list(opened.config.joints), when_full, {"head": opened.config.name})
        stack.callback(recorder.close)
        alone = NobodyThere()
        drove = drive_head(opened, Programme(alone, alone, faces.duration_s, faces, observers=[recorder]), Interrupt())
    if drove.error is not None:
        raise drove.error
    return Babbled(opened.config, drove.outcome, faces.duration_s, drove.log.audited.violations)


class Faces(WholeTimeline):
    """A timeline through faces (K, 52) at rising times (K,), by smooth steps."""

    def __init__(self, times_s: Doubles, shapes: Floats) -> None:
        self._times_s, self._shapes = times_s, shapes
        self.duration_s = float(times_s[-1])

    @classmethod
    def of(cls, channels: Sequence[int], duration_s: float, seed: int) -> Faces:
        """Each channel alone, then random faces till the time is over; rest at both ends."""
        rng = np.random.default_rng(seed)
        times, shapes = [EASE_S], [np.zeros(len(BLENDSHAPES))]
        for channel in channels:
            for value in (1.0, 0.0):
                times.append(times[-1] + ALONE_S / 2)
                shapes.append(np.eye(len(BLENDSHAPES))[channel] * value)
        while channels and times[-1] < duration_s - TOGETHER_S:
            face = np.zeros(len(BLENDSHAPES))
            face[rng.permutation(channels)[:AT_ONCE]] = rng.uniform(0.0, 1.0, min(AT_ONCE, len(channels)))
            times.append(times[-1] + TOGETHER_S)
            shapes.append(face)
        times.append(times[-1] + TOGETHER_S)
        shapes.append(np.zeros(len(BLENDSHAPES)))
        return cls(np.array(times), np.array(shapes, dtype=np.float32))

    def sample(self, times_s: Doubles, now_s: float, state: None) -> tuple[Floats, None]:
        """Motion (N, 58) at each of (N,) instants."""
        after = np.clip(np.searchsorted(self._times_s, times_s), 1, len(self._times_s) - 1)
        begins, ends = self._times_s[after - 1], self._times_s[after]
        share = ease((times_s - begins) / (ends - begins))[:, None]
        motion = np.zeros((len(times_s), MOTION_DIM), dtype=np.float32)
        motion[:, SHAPES] = (1 - share) * self._shapes[after - 1] + share * self._shapes[after]
        return motion, None
