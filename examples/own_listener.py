"""Your own listener: it nods when the person has finished speaking. Any object with these four names works."""

import sys

import numpy as np

import sfms_robot as sr

FRAME_S = 0.04
PITCH = sr.CHANNELS.index("pitch")
NOD_S = 0.6


class PoliteListener:
    hop = 1  # a plan every frame ...
    horizon = 4  # ... for the next four

    def start(self, seed: int) -> tuple[float, float]:
        """Return the memory: when the person last spoke, and when the last nod began."""
        return -10.0, -10.0

    def step(self, speaker: sr.SpeakerFrame, memory: tuple[float, float]) -> tuple[sr.Plan | None, tuple[float, float]]:
        """Return a plan and the new memory for 40 ms of the person. Never change `memory` in place."""
        heard_s, nod_s = memory
        if len(speaker.audio) and np.abs(speaker.audio).max() > 0.02:
            heard_s = speaker.time_s
        if heard_s > nod_s and speaker.time_s - heard_s > 0.2:  # a pause after speech
            nod_s = speaker.time_s
        times_s = speaker.time_s + FRAME_S * np.arange(1, self.horizon + 1)
        frames = np.zeros((self.horizon, len(sr.CHANNELS)), np.float32)
        phase = np.clip((times_s - nod_s) / NOD_S, 0.0, 1.0)
        frames[:, PITCH] = 0.12 * np.sin(np.pi * phase) ** 2  # + is nose down
        return sr.Plan(speaker.time_s, times_s, frames), (heard_s, nod_s)


seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
with sr.Robot("face28", port="sim", listener=PoliteListener(), audio="katie", duration_s=seconds) as robot:
    robot.wait()
print(robot.report()["motion"])
