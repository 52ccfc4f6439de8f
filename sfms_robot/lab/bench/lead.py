"""How late every joint is against what was meant, with the plan's future used to lead it and without.

A made-up listener whose every channel swings on its own gives plans as the shipped listener does; the run is the real
one, on emulated servos in virtual time. The delay of a joint is where the cross-correlation of its intended and its
emulated angle is highest, between two ticks by a parabola. It counts all there is: timeline, limiter, bus, servo.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfms_robot.app.head.pose import NobodyThere
from sfms_robot.app.open_head import open_head
from sfms_robot.app.options import HeadOptions
from sfms_robot.app.session import drive_head, run_parts
from sfms_robot.app.wiring import calibration_of
from sfms_robot.config import Head
from sfms_robot.emulator.launch import Chain
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, POSE, Doubles, Floats, Plan, SpeakerFrame
from sfms_robot.lab.bench.measure import HEAD, Row, row
from sfms_robot.ports import Clock, Observer, Tick
from sfms_robot.runtime.clock import IDLE_FEED
from sfms_robot.runtime.safety import Interrupt

HORIZON, HOP = 8, 4  # frames of a plan, and between two plans
LATENCY_S = 0.010  # from the last frame heard to the plan
DURATION_S = 8.0
SETTLED_S = 1.5  # by then the head has eased in
FARTHEST_S = 0.4  # delays are looked for up to here, either way
_WAVES = 3  # sines of a channel
_RANGE_HZ = (0.3, 1.3)
_MOVED_RAD = math.radians(0.5)  # a joint that moves less has no delay to speak of


@dataclass(frozen=True)
class Delays:
    """Of each joint [s], positive when late; NaN for a joint that hardly moves. `leads_s`: what the head leads by."""

    joints: Sequence[str]
    leads_s: Doubles
    led_s: Doubles
    unled_s: Doubles


class Waves:
    """A smooth face (58,) at any time: every channel a sum of sines of its own. Implements `ports.PlanFeed` with it."""

    lost = False

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self._rates = 2 * np.pi * rng.uniform(*_RANGE_HZ, (_WAVES, MOTION_DIM))
        self._phases = rng.uniform(0, 2 * np.pi, (_WAVES, MOTION_DIM))
        self._centre = np.full(MOTION_DIM, 0.3)
        self._size = np.full(MOTION_DIM, 0.09)
        self._centre[POSE], self._size[POSE] = 0.0, 0.04  # rad
        for name in ("x", "y", "z"):
            self._size[CHANNEL_INDEX[name]] = 0.002  # m
        self._plans = 0

    def face(self, times_s: Doubles) -> Floats:
        """(N,) -> (N, 58)."""
        swing = np.sin(np.multiply.outer(times_s, self._rates) + self._phases).sum(axis=1)
        faces: Floats = (self._centre + self._size * swing).astype(np.float32)
        return faces

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """It listens to nobody."""

    def poll(self, now_s: float) -> Sequence[Plan]:
        made_at_s = self._plans * HOP * FRAME_S
        if now_s + 1e-9 < made_at_s + LATENCY_S:
            return []
        self._plans += 1
        times_s = made_at_s + FRAME_S * np.arange(1.0, HORIZON + 1)
        return [Plan(made_at_s, times_s, self.face(times_s))]

    def statistics(self) -> Mapping[str, Any]:
        return IDLE_FEED

    def close(self) -> None: ...


class Onlooker(Observer):
    """Reads the shafts off the emulated servos, whether or not their bus can."""

    def __init__(self, head: Head, chains: dict[str, Chain], clock: Clock) -> None:
        self._head, self._chains, self._clock = head, chains, clock
        self._calibration = calibration_of(head.joints)
        self.times_s: list[float] = []
        self.angles_rad: list[Doubles] = []

    def tick(self, seen: Tick) -> None:
        if seen.state == "stopping":  # nothing is followed any more
            return
        for chain in self._chains.values():
            chain.time_is(self._clock.now_s())
        ticks = [self._chains[joint.bus].state(joint.id)["position"] for joint in self._head.joints.values()]
        self.times_s.append(seen.time_s)
        self.angles_rad.append(self._calibration.to_rad(np.array(ticks)))


def delays(head: str, duration_s: float = DURATION_S) -> Delays:
    """Of a head as its file leads it, and with no lead at all."""
    found = [_delays(head, led, duration_s) for led in (1.0, 0.0)]
    (joints, leads_s, led_s), (_, _, unled_s) = found
    return Delays(joints, leads_s, led_s, unled_s)


def lead(head: str = HEAD) -> dict[str, Row]:
    """Rows of `sfms-robot bench lead`: the delay of each joint with lead [ms], its peer the one without."""
    found = delays(head)
    moved = np.isfinite(found.led_s)
    led, unled = np.abs(found.led_s[moved]) * 1e3, np.abs(found.unled_s[moved]) * 1e3
    names = [name for name, there in zip(found.joints, moved, strict=True) if there]
    rows = {f"lead.{name}": row([a], [b], "ms", "no lead") for name, a, b in zip(names, led, unled, strict=True)}
    return {"lead": row(led.tolist(), unled.tolist(), "ms", f"no lead ({head})"), **rows}


def _delays(name: str, share: float, duration_s: float) -> tuple[Sequence[str], Doubles, Doubles]:
    """Joints, their leads, and how late they are when they are led by `share` of those."""
    waves = Waves()
    with open_head(HeadOptions(head=name, fast=True, yes=True)) as opened:
        motion, rate_hz = opened.motion, opened.rate_hz
        led = replace(opened, motion=replace(motion, leads_s=share * motion.leads_s))
        chains = {bus: chain for bus, chain in opened.opened.items() if isinstance(chain, Chain)}
        seen = Onlooker(opened.config, chains, opened.clock)
        parts = run_parts(led, NobodyThere(), waves, observers=[seen])
        drove = drive_head(led, parts, Interrupt(), duration_s=duration_s)
    if drove.error is not None:
        raise drove.error
    times_s = np.array(seen.times_s)
    memory, meant = motion.retargeter.start(), []
    for face in waves.face(times_s):
        angles, memory = motion.retargeter.step(face, memory)
        meant.append(angles)
    settled = times_s > SETTLED_S
    moved = delay_ticks(np.array(meant)[settled], np.array(seen.angles_rad)[settled], round(FARTHEST_S * rate_hz))
    return motion.retargeter.joints, motion.leads_s, moved / rate_hz


def delay_ticks(meant: Doubles, seen: Doubles, farthest: int) -> Doubles:
    """By how many ticks (J,) the columns of `seen` (T, J) come after those of `meant`; NaN where one hardly moves.

    The correlation coefficient is taken over the same middle part of `meant` at every shift up to `farthest`.
    """
    middle = _standard(meant[farthest : len(meant) - farthest])
    shifts = range(-farthest, farthest + 1)
    windows = (_standard(seen[farthest + k : len(seen) - farthest + k]) for k in shifts)
    likeness = np.array([(middle * window).sum(axis=0) for window in windows])  # (shifts, J)
    best = np.clip(np.argmax(likeness, axis=0), 1, len(likeness) - 2)
    before, here, after = (likeness[best + k, np.arange(meant.shape[1])] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    moved: NDArray[np.bool_] = (np.ptp(meant, axis=0) > _MOVED_RAD) & (np.ptp(seen, axis=0) > _MOVED_RAD) & (bend < 0)
    between = 0.5 * (before - after) / np.where(moved, bend, 1.0)
    return np.where(moved, best - farthest + between, np.nan)


def _standard(angles: Doubles) -> Doubles:
    """Columns of mean 0 and length 1; a column that stands still stays 0."""
    centred = angles - angles.mean(axis=0)
    length = np.sqrt((centred**2).sum(axis=0))
    standard: Doubles = centred / np.where(length > 0, length, 1.0)
    return standard
