"""Benches of motion: CPU time from a face to servo ticks, and two benches in virtual time with synthetic plans.

`retarget`: the parts of a tick, on recorded faces, without servos.

`lead`: every channel of a synthetic listener swings at its own frequencies, and its plans arrive like those of the
shipped listener. The delay of a joint is the peak of the cross-correlation between its intended and its emulated angle,
interpolated between two ticks by a parabola. It includes the timeline, the limiter, the bus and the servo.

`memory`: resident memory of the servo process over hours of a run with a recording: loop, bus, log and recorder.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from sfms_robot.app.head.pose import NobodyThere
from sfms_robot.app.open_head import build_motion, open_head
from sfms_robot.app.options import HeadOptions, RunOptions
from sfms_robot.app.session import drive_head, run, run_parts
from sfms_robot.app.wiring import calibration_of
from sfms_robot.config import Head, load_head
from sfms_robot.emulator.launch import Chain
from sfms_robot.errors import BusError
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, POSE, Bools, Doubles, Floats, Plan, SpeakerFrame
from sfms_robot.lab.bench.measure import HEAD, ResidentMemory, Rows, row, times
from sfms_robot.motion.limits import difference
from sfms_robot.ports import Clock, Observer, Tick
from sfms_robot.runtime.clock import IDLE_FEED
from sfms_robot.runtime.safety import Interrupt

_HORIZON, _HOP = 8, 4  # frames of a plan, and between two plans
_LATENCY_S: Final = 0.010  # from the last received frame to the plan
_SETTLED_S: Final = 1.5  # by then the head has eased in
_FARTHEST_S: Final = 0.4  # largest delay of the search, in both directions
_WAVES: Final = 3  # sines of a channel
_RANGE_HZ: Final = (0.3, 1.3)
_MOVED_RAD: Final = math.radians(0.5)  # the delay of a joint that moves less is not measured
_HOUR_S: Final = 3600.0
_LOOKS: Final = 20  # measurements of memory per hour
_RETARGET_HZ: Final = 100.0
_RETARGET_TICKS: Final = 2000


class Waves:
    """A plan feed (`ports.PlanFeed`) of a smooth face (58,): every channel is a sum of sines."""

    lost = False

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self._rates = 2 * np.pi * rng.uniform(*_RANGE_HZ, (_WAVES, MOTION_DIM))
        self._phases = rng.uniform(0, 2 * np.pi, (_WAVES, MOTION_DIM))
        self._centre = np.full(MOTION_DIM, 0.3)
        self._size = np.full(MOTION_DIM, 0.09)
        self._centre[POSE], self._size[POSE] = 0.0, 0.04  # rad
        self._size[[CHANNEL_INDEX[name] for name in ("x", "y", "z")]] = 0.002  # m
        self._plans = 0

    def face(self, times_s: Doubles) -> Floats:
        """Return the faces (N, 58) at times (N,)."""
        swing = np.sin(np.multiply.outer(times_s, self._rates) + self._phases).sum(axis=1)
        faces: Floats = (self._centre + self._size * swing).astype(np.float32)
        return faces

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """Ignore the person."""

    def poll(self, now_s: float) -> Sequence[Plan]:
        made_at_s = self._plans * _HOP * FRAME_S
        if now_s + 1e-9 < made_at_s + _LATENCY_S:
            return []
        self._plans += 1
        times_s = made_at_s + FRAME_S * np.arange(1.0, _HORIZON + 1)
        return [Plan(made_at_s, times_s, self.face(times_s))]

    def statistics(self) -> Mapping[str, Any]:
        return IDLE_FEED

    def close(self) -> None: ...


class _Shafts(Observer):
    """An observer that reads the shafts of the emulated servos, even if their bus reports no positions."""

    def __init__(self, head: Head, chains: Mapping[str, Chain], clock: Clock) -> None:
        self._head, self._chains, self._clock = head, chains, clock
        self._calibration = calibration_of(head.joints)
        self.times_s: list[float] = []
        self.angles_rad: list[Doubles] = []

    def tick(self, seen: Tick) -> None:
        if seen.state == "stopping":  # the plans are no longer followed
            return
        for chain in self._chains.values():
            chain.time_is(self._clock.now_s())
        ticks = [self._chains[joint.bus].state(joint.id)["position"] for joint in self._head.joints.values()]
        self.times_s.append(seen.time_s)
        self.angles_rad.append(self._calibration.to_rad(np.array(ticks)))


def lead(head: str = HEAD) -> Rows:
    """Return rows of the delay of each joint with lead [ms]; the peer is the delay without lead."""
    joints, *both_s = delays(head)
    moved = np.isfinite(both_s[0])
    led, unled = (np.abs(each[moved]) * 1e3 for each in both_s)
    names = [name for name, there in zip(joints, moved, strict=True) if there]
    rows = {f"lead.{name}": row([a], [b], "ms", "no lead") for name, a, b in zip(names, led, unled, strict=True)}
    return {"lead": row(led.tolist(), unled.tolist(), "ms", f"no lead ({head})"), **rows}


def delays(head: str, duration_s: float = 8.0) -> tuple[Sequence[str], Doubles, Doubles]:
    """Return joints, and their delays [s] with the leads of the head's file and without lead.

    Delays are positive when late; NaN for a joint that hardly moves.
    """
    (joints, led_s), (_, unled_s) = (_delays(head, share, duration_s) for share in (1.0, 0.0))
    return joints, led_s, unled_s


def _delays(name: str, share: float, duration_s: float) -> tuple[Sequence[str], Doubles]:
    """Return joints, and their delays when the motion leads by `share` of the head's leads."""
    waves = Waves()
    with open_head(HeadOptions(head=name, fast=True, yes=True)) as opened:
        motion, rate_hz = opened.motion, opened.rate_hz
        led = replace(opened, motion=replace(motion, leads_s=share * motion.leads_s))
        chains = {bus: chain for bus, chain in opened.opened.items() if isinstance(chain, Chain)}
        seen = _Shafts(opened.config, chains, opened.clock)
        parts = run_parts(led, NobodyThere(), waves, observers=[seen])
        problem = drive_head(led, parts, Interrupt(), duration_s=duration_s)["error"]
    if problem:
        raise BusError(problem)
    times_s = np.array(seen.times_s)
    memory, meant = motion.retargeter.start(), []
    for face in waves.face(times_s):
        angles, memory = motion.retargeter.step(face, memory)
        meant.append(angles)
    settled = times_s > _SETTLED_S
    moved = delay_ticks(np.array(meant)[settled], np.array(seen.angles_rad)[settled], round(_FARTHEST_S * rate_hz))
    return motion.retargeter.joints, moved / rate_hz


def delay_ticks(meant: Doubles, seen: Doubles, farthest: int) -> Doubles:
    """Return the delay in ticks (J,) of the columns of `seen` (T, J) after those of `meant`; NaN if one hardly moves.

    The correlation coefficient uses the same middle part of `meant` at every shift up to `farthest`.
    """

    def standard(angles: Doubles) -> Doubles:
        """Return columns of mean 0 and length 1; a constant column becomes 0."""
        centred = angles - angles.mean(axis=0)
        length = np.linalg.norm(centred, axis=0)
        return np.asarray(centred / np.where(length > 0, length, 1.0))

    middle = standard(meant[farthest : len(meant) - farthest])
    shifts = range(-farthest, farthest + 1)
    windows = (standard(seen[farthest + k : len(seen) - farthest + k]) for k in shifts)
    likeness = np.array([(middle * window).sum(axis=0) for window in windows])  # (shifts, J)
    best = np.clip(np.argmax(likeness, axis=0), 1, len(likeness) - 2)
    before, here, after = (likeness[best + k, np.arange(meant.shape[1])] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    moved: Bools = (np.ptp(meant, axis=0) > _MOVED_RAD) & (np.ptp(seen, axis=0) > _MOVED_RAD) & (bend < 0)
    between = 0.5 * (before - after) / np.where(moved, bend, 1.0)
    return np.where(moved, best - farthest + between, np.nan)


def memory(hours: float = 4.0, head: str = "interbotix_wxxms") -> Rows:
    """Return the growth of resident memory after the first hour [MB]; the peer is the memory at that time. Linux only.

    `head`: A name or a folder; the default has two servos, so that hours pass quickly. Raises BusError if the run ends
    early.
    """
    looks = ResidentMemory(_HOUR_S / _LOOKS)
    with TemporaryDirectory() as folder:
        options = RunOptions(head=head, fast=True, audio="none", duration_s=hours * _HOUR_S, record=Path(folder))
        report = run(options, feed=Waves(), observers=[looks], signals=False)
    if report["exit"] != "done":
        raise BusError(f"bench memory: the run ended early ({report['exit']}: {report['error']})")
    first_s = min(1.0, hours / 2) * _HOUR_S
    settled = [mb for at_s, mb in zip(looks.times_s, looks.resident_mb, strict=True) if first_s <= at_s]
    return {"memory.growth": row([settled[-1] - settled[0]], [settled[0]], "MB", "resident after the first hour")}


def retarget() -> Rows:
    """Return rows of CPU time: `retarget.tick` = mapping + limits + calibration, each of these, and the timeline."""
    head = load_head(HEAD)
    motion = build_motion(head, _RETARGET_HZ)
    calibration = calibration_of(head.joints)
    plans = _recorded_plans()
    timeline, limiter = motion.timeline.start(), motion.limiter.start(motion.rest_rad)
    before = here = motion.rest_rad
    memory = motion.retargeter.start()
    spent: dict[str, list[float]] = {"timeline": [], "mapping": [], "limits": [], "calibration": []}
    for tick in range(_RETARGET_TICKS):
        now_s = tick / _RETARGET_HZ
        marks = [time.thread_time()]
        if now_s >= plans[0].made_at_s:
            timeline = motion.timeline.accept(plans.pop(0), timeline)
        asked_s = np.concatenate([[now_s], now_s + motion.leads_s + 1 / _RETARGET_HZ])
        faces, timeline = motion.timeline.sample(asked_s, now_s, timeline)
        marks.append(time.thread_time())
        ahead, memory = motion.retargeter.step(faces[1:], memory)
        marks.append(time.thread_time())
        goals, limiter = motion.limiter.step(difference(before, here, ahead, 1 / _RETARGET_HZ), limiter)
        marks.append(time.thread_time())
        calibration.to_ticks(goals)
        marks.append(time.thread_time())
        before, here = here, ahead
        for name, took_s in zip(spent, np.diff(marks), strict=True):
            spent[name].append(1e3 * float(took_s))
    safe = np.sum([spent["mapping"], spent["limits"], spent["calibration"]], axis=0).tolist()
    rng = np.random.default_rng(0)
    matrix, frame = rng.normal(size=(len(head.joints), MOTION_DIM)), rng.normal(size=MOTION_DIM)
    peers = times(lambda: matrix @ frame, _RETARGET_TICKS, time.thread_time)
    name = f"{len(head.joints)} x {MOTION_DIM} matrix product"
    rows = {f"retarget.{part}": row(took, peers, "ms", name) for part, took in spent.items()}
    return {"retarget.tick": row(safe, peers, "ms", name), **rows}


def _recorded_plans() -> list[Plan]:
    """Return recorded faces as plans of 8 frames, a new one every 4, from 0 s to past the last tick."""
    from sfms_robot.app.head.head_check import named_faces  # loads scipy, whose memory is not part of a run

    need = int(_RETARGET_TICKS / _RETARGET_HZ / FRAME_S) + 2 * _HORIZON
    clips = [clip for _, clip in named_faces() if len(clip) > _HORIZON]
    faces = np.resize(np.concatenate(clips), (need, MOTION_DIM))
    return [
        Plan(k * FRAME_S, FRAME_S * np.arange(k + 1.0, k + _HORIZON + 1), faces[k : k + _HORIZON])
        for k in range(0, need - _HORIZON, _HOP)
    ]
