"""One tick from plan to safe joint angles."""

from __future__ import annotations

import numpy as np

from sfms_robot.app.bench.measure import HEAD, Row, row, times
from sfms_robot.app.heads import build_motion
from sfms_robot.config import load_head
from sfms_robot.frames import FRAME_S, MOTION_DIM, Plan
from sfms_robot.runtime.loop import difference


def retarget() -> dict[str, Row]:
    head = load_head(HEAD)
    rate_hz = 100.0
    motion = build_motion(head, rate_hz)
    rng = np.random.default_rng(0)
    timeline, limiter = motion.timeline.start(), motion.limiter.start(motion.rest_rad)
    neck = motion.retargeter.start()
    before = here = motion.rest_rad
    now_s = 0.0

    def tick() -> None:
        nonlocal timeline, limiter, neck, before, here, now_s
        if round(now_s * rate_hz) % 16 == 0:
            times_s = now_s + FRAME_S * np.arange(1, 9)
            wave = 0.3 + 0.2 * np.sin(2 * np.pi * times_s[:, None] * rng.uniform(0.2, 1.0, MOTION_DIM))
            timeline = motion.timeline.accept(
                Plan(now_s, times_s.astype(np.float64), wave.astype(np.float32)), timeline
            )
        times = np.concatenate([[now_s], now_s + motion.leads_s + 1 / rate_hz])
        frames, timeline = motion.timeline.sample(times, now_s, timeline)
        ahead, neck = motion.retargeter.step(frames[1:], neck)
        _, limiter = motion.limiter.step(difference(before, here, ahead, 1 / rate_hz), limiter)
        before, here, now_s = here, ahead, now_s + 1 / rate_hz

    matrix, frame = rng.normal(size=(len(head.joints), MOTION_DIM)), rng.normal(size=MOTION_DIM)
    return {
        "retarget.tick": row(times(tick, 2000), times(lambda: matrix @ frame, 2000), "ms", "28 x 58 matrix product")
    }
