"""Your own source of the person's voice and face. This one has a tone that comes and goes, and no face."""

import sys
from collections.abc import Sequence

import numpy as np

import sfms_robot as sr

RATE_HZ, FRAME_SAMPLES, FRAME_HZ = 16_000, 640, 25


class Hum(sr.Source):
    def __init__(self, seconds: float) -> None:
        self.duration_s = seconds  # None for a live source
        self._given = 0

    def read(self, now_s: float) -> Sequence[sr.SpeakerFrame]:
        """Return new frames of 40 ms that are complete at `now_s`. Called in the loop, so it must not block."""
        frames = []
        while (self._given + 1) / FRAME_HZ <= min(now_s, self.duration_s):
            seconds = (self._given * FRAME_SAMPLES + np.arange(FRAME_SAMPLES)) / RATE_HZ
            loud = 0.1 * (np.sin(np.pi * seconds) > 0)  # a second of sound, a second of silence
            self._given += 1
            tone = (loud * np.sin(2 * np.pi * 150 * seconds)).astype(np.float32)
            frames.append(sr.SpeakerFrame(self._given / FRAME_HZ, tone, face=None))
        return frames


source = Hum(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
with sr.Robot("face28", port="sim", source=source) as robot:
    robot.wait()
print(robot.report()["frames"], "frames heard")
