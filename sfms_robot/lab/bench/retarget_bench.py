"""`bench retarget`: CPU time from a face to servo ticks; and, with `--frames`, limits under impossible faces.

For `--frames` every head gets faces that no face makes. Half of the time a wild face goes straight into the mapping at
every tick, finite or not; the other half wild plans go through the timeline, some with frames that are not finite, of
the wrong width, or with time running backwards. After a refused face the limiter has no reference. `motion.audit`
counts the commands outside the limits.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfms_robot.app.head.head_check import named_faces
from sfms_robot.app.open_head import Motion, build_motion
from sfms_robot.config import load_firmware_map, load_head
from sfms_robot.data import head_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_S, MOTION_DIM, Doubles, Floats, Plan
from sfms_robot.lab.bench.measure import HEAD, Row, row, times
from sfms_robot.motion.calibration import Calibration
from sfms_robot.processes import cores, process_pool
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.retarget.stewart import Stewart
from sfms_robot.runtime.loop import difference

CHUNK = 20_000  # wild frames that one process drives without a break
_BLOCK = 400  # ticks of one kind of wildness
_SPOILT = 0.2  # share of faces, and of plans, that are broken
_RATE_HZ = 100.0
_TICKS = 2000
_HORIZON, _HOP = 8, 4
_STEWART_HEAD = "reachy_mini"


def retarget(head: str | None = None, frames: int | None = None) -> dict[str, Row]:
    """Return rows of CPU time, or with `frames` of violations over so many wild frames, of all heads or of one.

    Raises ConfigError for a head without frames.
    """
    if frames is not None:
        return adversarial(frames, (head,) if head else ())
    if head is not None:
        raise ConfigError(f"--head {head}: 'bench retarget' takes a head with --frames N")
    return {**_tick(), "retarget.stewart": _stewart()}


def _tick() -> dict[str, Row]:
    """Measure `retarget.tick` = mapping + limits + calibration, each of these, and the timeline before them."""
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


def _stewart() -> Row:
    """Measure the closed-form inverse of six legs beside one product of six rows of three."""
    neck = HeadRetargeter(load_head(_STEWART_HEAD)).neck
    if not isinstance(neck, Stewart):
        raise TypeError(f"{_STEWART_HEAD}: expected a Stewart platform as neck, got {type(neck).__name__}")
    pose: Doubles = np.array([0.05, 0.1, 0.02, 0.003, 0.002, 0.001])
    rows, way = np.random.default_rng(0).normal(size=(6, 3)), np.array([0.1, 0.2, 0.3])
    calls = (lambda: neck.geometry.inverse(pose), lambda: rows @ way)
    ours, peers = (times(call, _TICKS, time.thread_time) for call in calls)
    return row(ours, peers, "ms", "6 x 3 matrix product")


# --- wild faces -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tally:
    """The outcome of `frames` faces, one a tick: `violations` in ticks x joints, `refused` faces and plans."""

    frames: int
    violations: int
    refused: int

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.frames + other.frames, self.violations + other.violations, self.refused + other.refused)


def adversarial(frames: int, heads: tuple[str, ...] = (), seed: int = 0) -> dict[str, Row]:
    """Return one row per head, of all shipped heads unless named.

    Every `CHUNK` frames begin at rest with the next seed and run in one of several processes. Blocks: a frame takes up
    to 2 ms of a core, nearly all of it in the limiter and the neck that are tested.
    """
    names = heads or head_names()
    starts = range(0, frames, CHUNK)
    parts = [(name, min(CHUNK, frames - start), seed + start // CHUNK) for name in names for start in starts]
    tallies = {name: Tally(0, 0, 0) for name in names}
    with process_pool(min(len(parts), cores())) as pool:
        for (name, _, _), tally in zip(parts, pool.map(torment, *zip(*parts, strict=True)), strict=True):
            tallies[name] += tally
    return {
        f"retarget.wild.{name}": {
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
        for name, tally in tallies.items()
    }


def torment(name: str, frames: int, seed: int = 0) -> Tally:
    """Drive the shipped head `name` with `frames` wild faces, one a tick."""
    head = load_head(name)
    rate_hz = max(bus.rate_hz for bus in head.buses.values())
    motion, rng = build_motion(head, rate_hz), np.random.default_rng(seed)
    limiter, audit = motion.limiter.start(motion.rest_rad), motion.audit.start(motion.rest_rad)
    before = here = motion.rest_rad
    refused = 0
    for _, (asked, bad) in zip(range(frames), _asked(motion, rate_hz, rng), strict=False):
        refused += bad
        with np.errstate(invalid="ignore"):  # inf - inf
            reference = difference(before, here, asked, 1 / rate_hz)
        goals, limiter = motion.limiter.step(reference, limiter)
        audit = motion.audit.step(goals, here, audit)
        before, here = here, asked
    return Tally(frames, audit.violations, refused)


def wild(rng: np.random.Generator, count: int) -> Floats:
    """Return frames (count, 58): waves, jumps between extremes, absurd sizes, and stretches without motion."""
    waves = np.sin(np.outer(np.arange(count), rng.uniform(0.01, 2.0, MOTION_DIM)))
    jumps = rng.choice([0.0, 1.0, -1.0], (count, MOTION_DIM))
    absurd = rng.choice([0.0, 3e38, -3e38, 1e-45, -7.0], (count, MOTION_DIM))
    still = np.zeros((count, MOTION_DIM))
    kind = np.repeat(rng.integers(0, 4, count // 20 + 1), 20)[:count]
    return np.choose(kind[:, None], [waves, jumps, absurd, still]).astype(np.float32)


def _asked(motion: Motion, rate_hz: float, rng: np.random.Generator) -> Iterator[tuple[Doubles, int]]:
    """Yield requested angles (J,) tick after tick, without end, and how many faces or plans were refused for them."""
    memory, nothing = motion.retargeter.start(), np.full(len(motion.rest_rad), np.nan)
    while True:
        for face in wild(rng, _BLOCK):
            if rng.random() < _SPOILT:
                face[rng.integers(MOTION_DIM)] = rng.choice([np.nan, np.inf, -np.inf])
            try:
                asked, memory = motion.retargeter.step(face[:-1] if rng.random() < 0.01 else face, memory)
            except ValueError:
                yield nothing, 1
            else:
                yield asked, 0
        timeline = motion.timeline.start()
        for tick in range(_BLOCK):
            now_s, refused = tick / rate_hz, timeline.refused
            if tick % 10 == 0:
                timeline = motion.timeline.accept(_wild_plan(now_s, rng), timeline)
            times_s = now_s + motion.leads_s + 1 / rate_hz
            faces, timeline = motion.timeline.sample(times_s, now_s, timeline)
            asked, memory = motion.retargeter.step(faces, memory)
            yield asked, timeline.refused - refused


def _wild_plan(now_s: float, rng: np.random.Generator) -> Plan:
    """Return a wild plan; one in five is broken in one of four ways."""
    times_s, frames = now_s + FRAME_S * np.arange(1.0, _HORIZON + 1), wild(rng, _HORIZON)
    broken = rng.integers(4) if rng.random() < _SPOILT else None
    if broken == 0:
        frames[rng.integers(_HORIZON), rng.integers(MOTION_DIM)] = rng.choice([np.nan, np.inf])
    elif broken == 1:
        frames = frames[:, :-1]
    elif broken == 2:
        times_s = times_s[::-1]
    return Plan(now_s - (broken == 3), times_s, frames)
