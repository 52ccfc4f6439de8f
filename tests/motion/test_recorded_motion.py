"""Recorded nods and a blink, from plan to command: smooth where the head can follow, and quick enough for a lid."""

import numpy as np
import pytest

from sfms_robot.app.session import build_motion
from sfms_robot.config import load_head
from sfms_robot.corpora.compose.motions import load
from sfms_robot.data import data_dir
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, Plan
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.runtime.loop import difference

DT_S = 0.01
HEAD = load_head("face28")
PITCH = CHANNEL_INDEX["pitch"]
NOD = slice(PITCH, PITCH + 1)


def recorded_heads() -> list[np.ndarray]:
    motions = load(data_dir("sim") / "listeners" / "motions.npz").values()
    return [np.asarray(clip) for each in motions for clip in each.heads if len(clip) >= 25]


def driven(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T, 58) at 25 Hz as plans of 8, a new one every 4 -> references and commands (ticks, J)."""
    parts = build_motion(HEAD, 1 / DT_S)
    timeline, memory = parts.timeline.start(), parts.retargeter.start()
    limiter = parts.limiter.start(parts.rest_rad)
    before = here = parts.rest_rad
    asked, sent = [], []
    for tick in range(round((len(frames) - 8) * FRAME_S / DT_S)):
        if tick % 16 == 0:
            first = tick // 4
            times_s = FRAME_S * (first + np.arange(1.0, 9.0))
            timeline = parts.timeline.accept(Plan(first * FRAME_S, times_s, frames[first : first + 8]), timeline)
        now_s = tick * DT_S
        faces, timeline = parts.timeline.sample(now_s + parts.leads_s + DT_S, now_s, timeline)
        ahead, memory = parts.retargeter.step(faces, memory)
        goals, limiter = parts.limiter.step(difference(before, here, ahead, DT_S), limiter)
        asked.append(here)
        sent.append(goals)
        before, here = here, ahead
    return np.array(asked), np.array(sent)


def rms_jerk(angles: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.diff(angles, 3, axis=0) / DT_S**3) ** 2)))


def test_recorded_nods_are_commanded_with_at_most_one_and_a_half_times_the_jerk_asked_for():
    column = list(HEAD.joints).index("neck_pitch")
    asked, sent = [], []
    for clip in recorded_heads():
        still = np.zeros((12, MOTION_DIM), dtype=np.float32)
        frames = np.concatenate([still, np.zeros((len(clip), MOTION_DIM), dtype=np.float32), still])
        fade = np.minimum(1.0, np.minimum(np.arange(len(clip)), np.arange(len(clip))[::-1]) / 5)  # from rest, and to it
        frames[12 : 12 + len(clip), NOD] = (clip[:, NOD] - clip[:1, NOD]) * fade[:, None]
        wanted, commanded = driven(frames)
        asked.append(wanted[:, column])
        sent.append(commanded[:, column])
    assert len(asked) >= 2
    assert np.ptp(np.concatenate(asked)) > np.radians(5)
    ratio = rms_jerk(np.concatenate(sent)) / rms_jerk(np.concatenate(asked))
    assert ratio <= 1.5


@pytest.mark.parametrize("from_shut_to_open", [False, True])
def test_a_lid_that_can_closes_forty_degrees_in_under_80_ms(from_shut_to_open):
    """900 deg/s; the other limits are those of the shipped face's lids."""
    lid = HEAD.limits["lid"]
    rates = np.radians([900.0, lid.acceleration_deg_s2, lid.jerk_deg_s3])
    span = np.radians(40.0)
    limiter = JerkLimiter(JointLimits(np.zeros(1), np.full(1, span), *rates[:, None]), DT_S)
    start, end = (span, 0.0) if from_shut_to_open else (0.0, span)
    state, ticks = limiter.start(np.array([start])), 0
    angle = start
    while abs(angle - end) > np.radians(0.5):
        goals, state = limiter.step(np.array([[end], [0.0], [0.0]]), state)
        angle, ticks = float(goals[0]), ticks + 1
    assert ticks * DT_S < 0.080
