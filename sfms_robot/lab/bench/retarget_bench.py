"""`bench retarget`: CPU time from a face to servo ticks."""

from __future__ import annotations

import time

import numpy as np

from sfms_robot.app.head.head_check import named_faces
from sfms_robot.app.open_head import build_motion
from sfms_robot.config import load_firmware_map, load_head
from sfms_robot.frames import FRAME_S, MOTION_DIM, Floats, Plan
from sfms_robot.lab.bench.measure import HEAD, Row, row, times
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import difference

_RATE_HZ = 100.0
_TICKS = 2000
_HORIZON, _HOP = 8, 4


def retarget() -> dict[str, Row]:
    """Return rows of CPU time: `retarget.tick` = mapping + limits + calibration, each of these, and the timeline."""
    head = load_head(HEAD)
    motion = build_motion(head, _RATE_HZ)
    turns = [load_firmware_map(joint.model).ticks_per_revolution for joint in head.joints.values()]
    calibration = Calibration(head.joints, np.array(turns))
    plans = _recorded_plans()
    timeline, limiter = motion.timeline.start(), motion.limiter.start(motion.rest_rad)
    before = here = motion.rest_rad
    memory = motion.retargeter.start()
    spent: dict[str, list[float]] = {"timeline": [], "mapping": [], "limits": [], "calibration": []}
    for tick in range(_TICKS):
        now_s = tick / _RATE_HZ
        marks = [time.thread_time()]
        if now_s >= plans[0].made_at_s:
            timeline = motion.timeline.accept(plans.pop(0), timeline)
        asked_s = np.concatenate([[now_s], now_s + motion.leads_s + 1 / _RATE_HZ])
        faces, timeline = motion.timeline.sample(asked_s, now_s, timeline)
        marks.append(time.thread_time())
        ahead, memory = motion.retargeter.step(faces[1:], memory)
        marks.append(time.thread_time())
        goals, limiter = motion.limiter.step(difference(before, here, ahead, 1 / _RATE_HZ), limiter)
        marks.append(time.thread_time())
        calibration.to_ticks(goals)
        marks.append(time.thread_time())
        before, here = here, ahead
        for name, took_s in zip(spent, np.diff(marks), strict=True):
            spent[name].append(1e3 * float(took_s))
    safe = np.sum([spent["mapping"], spent["limits"], spent["calibration"]], axis=0).tolist()
    rng = np.random.default_rng(0)
    matrix, frame = rng.normal(size=(len(head.joints), MOTION_DIM)), rng.normal(size=MOTION_DIM)
    peers = times(lambda: matrix @ frame, _TICKS, time.thread_time)
    name = f"{len(head.joints)} x {MOTION_DIM} matrix product"
    rows = {f"retarget.{part}": row(took, peers, "ms", name) for part, took in spent.items()}
    return {"retarget.tick": row(safe, peers, "ms", name), **rows}


def _recorded_plans() -> list[Plan]:
    """Return recorded faces as plans of 8 frames, a new one every 4, from 0 s to past the last tick."""
    need = int(_TICKS / _RATE_HZ / FRAME_S) + 2 * _HORIZON
    clips: list[Floats] = []
    while sum(map(len, clips)) < need:
        clips += [clip for _, clip in named_faces() if len(clip) > _HORIZON]
    faces = np.concatenate(clips)
    return [
        Plan(k * FRAME_S, FRAME_S * np.arange(k + 1.0, k + _HORIZON + 1), faces[k : k + _HORIZON])
        for k in range(0, need - _HORIZON, _HOP)
    ]
