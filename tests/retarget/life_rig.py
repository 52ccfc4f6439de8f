"""A head that lives, tick by tick, and where it looks."""

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM
from sfms_robot.ports import Watched
from sfms_robot.retarget.spontaneous import HeadLife, LifeState
from sfms_robot.signals.gaze_kinematics import directions

TICK_S, LEADS_S = 0.01, np.array([0.0, 0.05, 0.08])
FULL_RAD = np.radians([30.0, 20.0])
YAW, PITCH = CHANNEL_INDEX["yaw"], CHANNEL_INDEX["pitch"]
NOBODY = Watched()


def still(t):
    return np.zeros(MOTION_DIM, np.float32)


def lived(life, seconds, listener=still, watched=None, seed=0, camera=None, tick_s=TICK_S) -> np.ndarray:
    """What is shown, (T, N, 58), of a listener given as a function of time; N instants with leads a tick.

    `watched(t, shown so far)`: the person at that tick.
    """
    alive = HeadLife(life, seed, camera)
    state, shown = LifeState(), []
    for now_s in tick_s * np.arange(round(seconds / tick_s)):
        times_s = now_s + LEADS_S
        asked = np.stack([listener(t) for t in times_s])
        person = NOBODY if watched is None else watched(now_s, shown)
        motion, state = alive.step(asked, times_s, now_s, state, lambda face: face[..., :6], person)
        shown.append(motion)
    return np.array(shown)


def eyes_deg(motion) -> np.ndarray:
    return np.degrees(directions(motion, FULL_RAD).mean(axis=-2))


def head_deg(motion) -> np.ndarray:
    return np.degrees(motion[..., [YAW, PITCH]])


def gaze_deg(motion) -> np.ndarray:
    """Of head and eyes together, in space."""
    return head_deg(motion) + eyes_deg(motion)
