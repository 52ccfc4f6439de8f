"""A recording made by hand, without a run."""

import numpy as np

from sfms_robot.frames import FaceFrame, Plan, Reading, SpeakerFrame
from sfms_robot.ports import Tick
from sfms_robot.runtime.recorder import Recorder

JOINTS = ("neck_pitch", "jaw", "brow")


def record(folder, seconds=2.0, voice=True, record_format="json"):
    """A run at 100 Hz: the speaker talks in the first half."""
    about = {"head": "face28", "seed": "3"}
    recorder = Recorder(folder, JOINTS, wait=True, about=about, record_format=record_format)
    rng = np.random.default_rng(0)
    for n in range(round(seconds * 100)):
        time_s = n / 100
        if n % 4 == 0:
            loud = 0.2 if voice and time_s < seconds / 2 else 0.0
            audio = (loud * rng.uniform(-1, 1, 640 if voice else 0)).astype(np.float32)
            face = FaceFrame.of(time_s + 0.04, np.full(58, 0.25)) if n % 8 == 0 else None
            recorder.heard(SpeakerFrame(time_s + 0.04, audio, face))
            recorder.planned(Plan(time_s, np.array([time_s + 0.04]), np.zeros((1, 58), dtype=np.float32)))
        goals = np.array([0.2 * np.sin(time_s), time_s / 10, 0.0])
        warmth = {"temperature_C": 40.0 + round(time_s)}
        readings = {"neck_pitch": Reading(goals[0], 0.01, extra=warmth), "jaw": Reading(None, float("inf"), "silent")}
        state, why = ("listening", ()) if n < 150 else ("halted", ("key",))
        recorder.tick(Tick(time_s, rng.uniform(0, 1, 58).astype(np.float32), goals, readings, state, why))
    recorder.close()
    return folder
