"""Faces and plans that no face makes break no limit of any head.

Half of the time a wild face goes straight into the mapping at every tick, finite or not; the other half wild plans go
through the timeline, some with frames that are not finite, of the wrong width, or with time running backwards. After a
refused face the limiter has no reference. `motion.audit` counts the commands outside the limits.
"""

import numpy as np
import pytest

from sfms_robot.app.open_head import build_motion
from sfms_robot.config import load_head
from sfms_robot.data import head_names
from sfms_robot.frames import FRAME_S, MOTION_DIM, Plan
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.runtime.loop import difference

BLOCK = 400  # ticks of one kind of wildness
SPOILT = 0.2  # share of faces, and of plans, that are broken
HORIZON = 8


def wild(rng, count):
    """Frames (count, 58): waves, jumps between extremes, absurd sizes, and stretches without motion."""
    waves = np.sin(np.outer(np.arange(count), rng.uniform(0.01, 2.0, MOTION_DIM)))
    jumps = rng.choice([0.0, 1.0, -1.0], (count, MOTION_DIM))
    absurd = rng.choice([0.0, 3e38, -3e38, 1e-45, -7.0], (count, MOTION_DIM))
    kind = np.repeat(rng.integers(0, 4, count // 20 + 1), 20)[:count]
    return np.choose(kind[:, None], [waves, jumps, absurd, np.zeros_like(waves)]).astype(np.float32)


def wild_plan(now_s, rng):
    """A wild plan; one in five is broken in one of four ways."""
    times_s, frames = now_s + FRAME_S * np.arange(1.0, HORIZON + 1), wild(rng, HORIZON)
    broken = rng.integers(4) if rng.random() < SPOILT else None
    if broken == 0:
        frames[rng.integers(HORIZON), rng.integers(MOTION_DIM)] = rng.choice([np.nan, np.inf])
    elif broken == 1:
        frames = frames[:, :-1]
    elif broken == 2:
        times_s = times_s[::-1]
    return Plan(now_s - (broken == 3), times_s, frames)


def asked(motion, rate_hz, rng):
    """Yield requested angles (J,) tick after tick, without end, and how many faces or plans were refused for them."""
    memory, nothing = motion.retargeter.start(), np.full(len(motion.rest_rad), np.nan)
    while True:
        for face in wild(rng, BLOCK):
            if rng.random() < SPOILT:
                face[rng.integers(MOTION_DIM)] = rng.choice([np.nan, np.inf, -np.inf])
            try:
                angles, memory = motion.retargeter.step(face[:-1] if rng.random() < 0.01 else face, memory)
            except ValueError:
                yield nothing, 1
            else:
                yield angles, 0
        timeline = motion.timeline.start()
        for tick in range(BLOCK):
            now_s, refused = tick / rate_hz, timeline.refused
            if tick % 10 == 0:
                timeline = motion.timeline.accept(wild_plan(now_s, rng), timeline)
            faces, timeline = motion.timeline.sample(now_s + motion.leads_s + 1 / rate_hz, now_s, timeline)
            angles, memory = motion.retargeter.step(faces, memory)
            yield angles, timeline.refused - refused


@pytest.mark.parametrize("frames, seed", [(1200, 3), pytest.param(10_000, 4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", head_names())
def test_faces_and_plans_that_no_face_makes_break_no_limit(name, frames, seed):
    head = load_head(name)
    rate_hz = max(bus.rate_hz for bus in head.buses.values())
    motion = build_motion(head, rate_hz)
    limiter, audit = motion.limiter.start(motion.rest_rad), motion.audit.start(motion.rest_rad)
    before = here = motion.rest_rad
    refused = 0
    for _, (angles, bad) in zip(range(frames), asked(motion, rate_hz, np.random.default_rng(seed)), strict=False):
        refused += bad
        with np.errstate(invalid="ignore"):  # inf - inf
            reference = difference(before, here, angles, 1 / rate_hz)
        goals, limiter = motion.limiter.step(reference, limiter)
        audit = motion.audit.step(goals, here, audit)
        before, here = here, angles
    assert audit.violations == 0 and refused > 50


@pytest.mark.parametrize("name", head_names())
def test_wild_faces_move_every_joint_that_anything_moves(name):
    retargeter = HeadRetargeter(load_head(name))
    faces = wild(np.random.default_rng(0), 1000)[:, None].repeat(len(retargeter.joints), axis=1)
    travel = np.ptp(retargeter.angles(faces), axis=0)
    assert (travel > 0.01).sum() >= len(travel) - len(retargeter.dead_joints)
