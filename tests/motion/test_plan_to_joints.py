"""Plans to joint angles of the default head: timeline, mapping and limits as the loop puts them together."""

import numpy as np
import pytest

from sfms_robot.config import load_head
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, Plan
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.motion.timeline import PlanTimeline
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.runtime.loop import difference

TICK_S, HORIZON, HOP, LATENCY_TICKS = 0.01, 8, 4, 2
HEAD = load_head("face28")
MAPPING, LIMITER, TIMELINE = HeadRetargeter(HEAD), JerkLimiter(JointLimits.of(HEAD), TICK_S), PlanTimeline(TICK_S)
LEADS_S = np.array([joint.lag_ms / 1000 for joint in HEAD.joints.values()])
JOINTS = list(HEAD.joints)


def played(frames) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles asked for and sent, (T, J) each, for a recording at 25 fps cut into plans."""
    rest = MAPPING.angles(np.zeros(MOTION_DIM, np.float32))
    timeline, limiter = TIMELINE.start(), LIMITER.start(rest)
    before, here, asked, sent = rest, rest, [], []
    for tick in range(4 * (len(frames) - HORIZON - 1)):
        step, rest_ticks = divmod(tick - LATENCY_TICKS, 4)
        if rest_ticks == 0 and step >= 0 and step % HOP == 0:
            times_s = FRAME_S * np.arange(step + 1, step + 1 + HORIZON)
            rows = frames[step + 1 : step + 1 + HORIZON].astype(np.float32)
            timeline = TIMELINE.accept(Plan(step * FRAME_S, times_s, rows), timeline)
        now_s = tick * TICK_S
        motion, timeline = TIMELINE.sample(now_s + LEADS_S + TICK_S, now_s, timeline)
        ahead = MAPPING.angles(motion)
        goals, limiter = LIMITER.step(difference(before, here, ahead, TICK_S), limiter)
        asked.append(here)
        sent.append(goals)
        before, here = here, ahead
    return np.array(asked), np.array(sent)


def rms_jerk(angles) -> float:
    return float(np.sqrt(np.mean(np.diff(angles, 3) ** 2)) / TICK_S**3)


@pytest.mark.parametrize("nods_hz, size_deg", [(1.0, 10.0), (2.0, 5.0), (2.0, 10.0), (3.0, 5.0)])
def test_a_nod_arrives_on_time_with_hardly_more_jerk_than_the_nod_itself(nods_hz, size_deg):
    def nod(t):
        return np.radians(size_deg / 2) * np.sin(2 * np.pi * nods_hz * t)

    frames = np.zeros((110, MOTION_DIM))
    frames[:, CHANNEL_INDEX["pitch"]] = nod(FRAME_S * np.arange(110))
    _, sent = played(frames)
    pitch = sent[100:, JOINTS.index("neck_pitch")]
    true = nod(TICK_S * np.arange(100, len(sent)) + LEADS_S[JOINTS.index("neck_pitch")])
    assert np.abs(pitch - true).max() < np.radians(0.05)
    assert rms_jerk(pitch) < 1.5 * rms_jerk(true)


@pytest.mark.parametrize("closed_frames", [1, 2, 3])
def test_a_blink_closes_the_lid_although_it_is_faster_than_the_servo(closed_frames):
    frames = np.zeros((40, MOTION_DIM))
    frames[18 : 18 + closed_frames, CHANNEL_INDEX["eyeBlinkLeft"]] = 1.0
    asked, sent = played(frames)
    lid = JOINTS.index("lid_left")
    closed = HEAD.joints["lid_left"].max_rad
    assert asked[:, lid].max() == pytest.approx(closed)
    assert sent[:, lid].max() > (0.9 if closed_frames == 1 else 0.99) * closed
    assert sent[-1, lid] == pytest.approx(HEAD.joints["lid_left"].rest_rad, abs=1e-9)
    assert not sent[:, JOINTS.index("lid_right")].any()
