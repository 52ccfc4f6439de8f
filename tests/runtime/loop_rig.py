"""A run of the loop on emulated servos in virtual time, under a listener with a known face."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sfms_robot.app.open_head import build_motion
from sfms_robot.config import Head
from sfms_robot.errors import ModelError
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, Plan, SpeakerFrame
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.loop import Parts, drive


class Posed:
    """A listener whose channels are functions of time [s]; it may plan NaN, or raise, from a frame on."""

    hop, horizon = 4, 8

    def __init__(
        self, nan_from: float = np.inf, raises_from: float = np.inf, **channels: Callable[[np.ndarray], Any]
    ) -> None:
        self._channels, self._nan_from, self._raises_from = channels, nan_from, raises_from

    def start(self, seed: int) -> int:
        return 0

    def step(self, speaker: SpeakerFrame, memory: int) -> tuple[Plan | None, int]:
        if memory >= self._raises_from:
            raise ModelError("the listener broke")
        if memory % self.hop:
            return None, memory + 1
        times_s = speaker.time_s + FRAME_S * np.arange(1.0, self.horizon + 1)
        frames = np.zeros((self.horizon, MOTION_DIM), dtype=np.float32)
        for channel, face in self._channels.items():
            frames[:, CHANNEL_INDEX[channel]] = face(times_s) if memory < self._nan_from else np.nan
        return Plan(speaker.time_s, times_s, frames), memory + 1


def driven(
    head: Head, bus: Any, clock: VirtualClock, *, rate_hz: float, duration_s: float, observer: Any,
    interrupted: Callable[[], bool] = lambda: False, log: RunLog | None = None, **parts: Any,
) -> tuple[str, RunLog]:  # fmt: skip
    """Drive a head to the end; `parts` replace those of `build_motion`."""
    motion = build_motion(head, rate_hz)
    log = log or RunLog(joints=list(head.joints), period_s=1 / rate_hz, audit=motion.audit)
    whole = {
        "timeline": motion.timeline, "retargeter": motion.retargeter, "limiter": motion.limiter, "bus": bus,
        "observers": [observer], "leads_s": motion.leads_s, "rest_rad": motion.rest_rad,
    }  # fmt: skip
    outcome = drive(Parts(**whole | parts), clock, log, rate_hz=rate_hz, duration_s=duration_s, interrupted=interrupted)
    return outcome, log
