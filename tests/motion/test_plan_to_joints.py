"""Plans to joint angles of the default head: timeline, mapping and limits as the loop puts them together."""

import numpy as np
import pytest
from motion_rows import motions

from sfms_robot.app.open_head import build_motion
from sfms_robot.config import load_head
from sfms_robot.frames import FRAME_S, Plan
from sfms_robot.runtime.loop import difference

TICK_S, HORIZON, HOP, LATENCY_TICKS = 0.01, 8, 4, 2
HEAD = load_head("face28")
PARTS = build_motion(HEAD, 1 / TICK_S)
JOINTS = list(HEAD.joints)
PITCH, LID = JOINTS.index("neck_pitch"), JOINTS.index("lid_left")


def played(frames) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles asked for and sent, (T, J) each, for a recording at 25 fps cut into plans."""
    timeline, memory = PARTS.timeline.start(), PARTS.retargeter.start()
    limiter = PARTS.limiter.start(PARTS.rest_rad)
    before = here = PARTS.rest_rad
    asked, sent = [], []
    for tick in range(4 * (len(frames) - HORIZON - 1)):
        step, rest_ticks = divmod(tick - LATENCY_TICKS, 4)
        if rest_ticks == 0 and step >= 0 and step % HOP == 0:
            times_s = FRAME_S * np.arange(step + 1, step + 1 + HORIZON)
            rows = frames[step + 1 : step + 1 + HORIZON]
            timeline = PARTS.timeline.accept(Plan(step * FRAME_S, times_s, rows), timeline)
        now_s = tick * TICK_S
        faces, timeline = PARTS.timeline.sample(now_s + PARTS.leads_s + TICK_S, now_s, timeline)
        ahead, memory = PARTS.retargeter.step(faces, memory)
        goals, limiter = PARTS.limiter.step(difference(before, here, ahead, TICK_S), limiter)
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

    _, sent = played(motions(110, pitch=nod(FRAME_S * np.arange(110))))
    pitch = sent[100:, PITCH]
    true = nod(TICK_S * np.arange(100, len(sent)) + PARTS.leads_s[PITCH])
    assert np.abs(pitch - true).max() < np.radians(0.05) and rms_jerk(pitch) < 1.5 * rms_jerk(true)


@pytest.mark.parametrize("closed_frames", [1, 2, 3])
def test_a_blink_closes_the_lid_although_it_is_faster_than_the_servo(closed_frames):
    blink = np.zeros(40)
    blink[18 : 18 + closed_frames] = 1.0
    asked, sent = played(motions(40, eyeBlinkLeft=blink))
    closed = HEAD.joints["lid_left"].max_rad
    assert asked[:, LID].max() == pytest.approx(closed)
    assert sent[:, LID].max() > (0.9 if closed_frames == 1 else 0.99) * closed
    assert sent[-1, LID] == pytest.approx(HEAD.joints["lid_left"].rest_rad, abs=1e-9)
    assert not sent[:, JOINTS.index("lid_right")].any()
