"""Faces that no face makes, at every head: how often does a command leave the limits?

Half of the time a wild face goes straight into the mapping at every tick, finite or not; the other half wild plans go
through the timeline, some with frames that are not finite, of the wrong width, or with time running backwards. A face
that is refused leaves the limiter without a reference. The judge is `motion.audit`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfms_robot.app.open_head import Motion, build_motion
from sfms_robot.config import load_head
from sfms_robot.data import head_names
from sfms_robot.frames import FRAME_S, MOTION_DIM, Doubles, Floats, Plan
from sfms_robot.lab.bench.measure import Row
from sfms_robot.processes import cores, process_pool
from sfms_robot.runtime.loop import difference

CHUNK = 20_000  # frames that one process does without a pause
BLOCK = 400  # ticks of one kind
_HORIZON = 8
_SPOILT = 0.2  # share of faces, and of plans, that are broken


@dataclass(frozen=True)
class Tally:
    """What came of `frames` faces, one a tick: `violations` in ticks x joints, `refused` faces and plans."""

    frames: int
    violations: int
    refused: int

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.frames + other.frames, self.violations + other.violations, self.refused + other.refused)


def adversarial(frames: int, heads: tuple[str, ...] = (), seed: int = 0) -> dict[str, Row]:
    """Rows of `sfms-robot bench retarget --frames N`, one per head, all that are shipped unless named.

    Every `CHUNK` frames begin at rest with a seed of their own, and are spread over the processors. Blocks: a frame
    takes up to 2 ms of one, nearly all of it in the limiter and the neck that are tested.
    """
    names = heads or head_names()
    starts = range(0, frames, CHUNK)
    parts = [(name, min(CHUNK, frames - start), seed + start // CHUNK) for name in names for start in starts]
    tallies = {name: Tally(0, 0, 0) for name in names}
    with process_pool(min(len(parts), cores())) as pool:
        for (name, _, _), tally in zip(parts, pool.map(torment, *zip(*parts, strict=True)), strict=True):
            tallies[name] += tally
    return {f"retarget.wild.{name}": _row(tally) for name, tally in tallies.items()}


def _row(tally: Tally) -> Row:
    return {
        "median": float(tally.violations),
        "p99": None,
        "unit": "violations",
        "peer": f"{tally.frames} wild frames",
        "peer_median": float(tally.frames),
        "ratio": tally.violations / tally.frames,
        "violations": tally.violations,
        "frames": tally.frames,
        "refused": tally.refused,
    }


def torment(name: str, frames: int, seed: int = 0) -> Tally:
    """Drive the shipped head `name` with `frames` wild faces, one a tick."""
    head = load_head(name)
    rate_hz = max(bus.rate_hz for bus in head.buses.values())
    motion, rng = build_motion(head, rate_hz), np.random.default_rng(seed)
    limiter, audit = motion.limiter.start(motion.rest_rad), motion.audit.start(motion.rest_rad)
    before = here = motion.rest_rad
    refused = done = 0
    for asked, bad in _asked(motion, rate_hz, rng):
        if done == frames:
            break
        done, refused = done + 1, refused + bad
        with np.errstate(invalid="ignore"):  # inf - inf
            reference = difference(before, here, asked, 1 / rate_hz)
        goals, limiter = motion.limiter.step(reference, limiter)
        audit = motion.audit.step(goals, here, audit)
        before, here = here, asked
    return Tally(frames, audit.violations, refused)


def wild(rng: np.random.Generator, count: int) -> Floats:
    """Frames (count, 58): waves, jumps between extremes, absurd sizes, and stretches in which all stands still."""
    waves = np.sin(np.outer(np.arange(count), rng.uniform(0.01, 2.0, MOTION_DIM)))
    jumps = rng.choice([0.0, 1.0, -1.0], (count, MOTION_DIM))
    absurd = rng.choice([0.0, 3e38, -3e38, 1e-45, -7.0], (count, MOTION_DIM))
    still = np.zeros((count, MOTION_DIM))
    kind = np.repeat(rng.integers(0, 4, count // 20 + 1), 20)[:count]
    return np.choose(kind[:, None], [waves, jumps, absurd, still]).astype(np.float32)


def _asked(motion: Motion, rate_hz: float, rng: np.random.Generator) -> Iterator[tuple[Doubles, int]]:
    """Angles (J,) asked for tick after tick, without end, and how many faces or plans were refused on the way."""
    memory, nothing = motion.retargeter.start(), np.full(len(motion.rest_rad), np.nan)
    while True:
        for face in wild(rng, BLOCK):
            if rng.random() < _SPOILT:
                face[rng.integers(MOTION_DIM)] = rng.choice([np.nan, np.inf, -np.inf])
            try:
                asked, memory = motion.retargeter.step(face[:-1] if rng.random() < 0.01 else face, memory)
            except ValueError:
                yield nothing, 1
            else:
                yield asked, 0
        timeline = motion.timeline.start()
        for tick in range(BLOCK):
            now_s, refused = tick / rate_hz, timeline.refused
            if tick % 10 == 0:
                timeline = motion.timeline.accept(_plan(now_s, rng), timeline)
            times_s = now_s + motion.leads_s + 1 / rate_hz
            faces, timeline = motion.timeline.sample(times_s, now_s, timeline)
            asked, memory = motion.retargeter.step(faces, memory)
            yield asked, timeline.refused - refused


def _plan(now_s: float, rng: np.random.Generator) -> Plan:
    """Wild, and one in five broken in one of four ways."""
    times_s, frames = now_s + FRAME_S * np.arange(1.0, _HORIZON + 1), wild(rng, _HORIZON)
    if rng.random() >= _SPOILT:
        return Plan(now_s, times_s, frames)
    broken = rng.integers(4)
    if broken == 0:
        frames[rng.integers(_HORIZON), rng.integers(MOTION_DIM)] = rng.choice([np.nan, np.inf])
    elif broken == 1:
        frames = frames[:, :-1]
    elif broken == 2:
        times_s = times_s[::-1]
    return Plan(now_s - (broken == 3), times_s, frames)
