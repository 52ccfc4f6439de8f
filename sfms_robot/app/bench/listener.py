"""One plan of the bundled listener, on one thread."""

from __future__ import annotations

import time

import numpy as np

from sfms_robot.app.bench.measure import LISTENER, Row, row
from sfms_robot.config import find
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, SpeakerFrame


def listener() -> dict[str, Row]:
    from sfms_robot.listeners.registry import load_listener, one_thread

    one_thread()
    listener = load_listener(find("listeners", LISTENER, "config.yaml"))
    memory = listener.start(0)
    rng = np.random.default_rng(0)
    plans = []
    for index in range(400):
        audio = (0.1 * rng.normal(size=FRAME_SAMPLES)).astype(np.float32)
        frame = SpeakerFrame((index + 1) * FRAME_SAMPLES / AUDIO_HZ, audio)
        began_s = time.perf_counter()
        plan, memory = listener.step(frame, memory)
        if plan is not None:
            plans.append((time.perf_counter() - began_s) * 1e3)
    return {"listener.plan": row(plans, [listener.hop * FRAME_S * 1e3], "ms", f"hop of {listener.hop} frames")}
