"""The loop, in the order a frame travels.

    source -> listener -> timeline -> retarget -> limits -> bus -> observers

One tick every 1/rate_hz s on absolute deadlines. What changes while it runs is a `State` handed from tick to tick, so
that whatever happens, the last whole state is there to come to rest from. The reference of a tick is the face at
(tick time + lead of the joint); speed and acceleration are central differences, so one sample lies one tick ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import (
    Bus,
    Clock,
    Life,
    Limiter,
    Observer,
    PlanFeed,
    Retargeter,
    Source,
    StopPolicy,
    Tick,
    Timeline,
)
from sfms_robot.runtime.clock import Beat, beats
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.safety import EASE_S, come_to_rest, smooth


@dataclass(frozen=True)
class Parts:
    """Everything a run is made of, put together by `app`. `leads_s` and `rest_rad` are (J,) in joint order.

    `knobs` is asked at every tick how much the head is to show; None: what its file says.
    """

    source: Source
    feed: PlanFeed
    timeline: Timeline
    retargeter: Retargeter
    limiter: Limiter
    bus: Bus
    observers: Sequence[Observer]
    leads_s: Doubles
    rest_rad: Doubles
    life: Life | None = None
    knobs: Callable[[], Any] | None = None


@dataclass(frozen=True)
class State:
    """What one tick hands to the next: the pose torque came on in and when, and two reference samples (J,) each."""

    timeline: Any
    limiter: Any
    held_rad: Doubles
    since_s: Doubles
    before_rad: Doubles
    here_rad: Doubles
    life: Any = None
    retargeter: Any = None


def drive(
    parts: Parts,
    clock: Clock,
    log: RunLog,
    *,
    rate_hz: float,
    duration_s: float,
    interrupted: Callable[[], bool],
    stop: StopPolicy = "release",
) -> str:
    """Torque on, ease in, listen for `duration_s`, ease to rest, torque off. Returns "done" or "interrupted".

    Whatever is raised on the way, the head comes to rest and `bus.stop` is called before it goes on.
    """
    try:
        held_rad = parts.bus.enable(parts.retargeter.joints)
        log.start(held_rad)
        limiter, life = parts.limiter.start(held_rad), parts.life.start() if parts.life else None
        state = State(parts.timeline.start(), limiter, held_rad, 0 * held_rad, held_rad, held_rad, life)
        state = replace(state, retargeter=parts.retargeter.start())
        start_s = clock.now_s()
        try:
            for beat in beats(clock, rate_hz, start_s):
                if interrupted():
                    return "interrupted"
                if beat.time_s > duration_s + 1e-9:  # the tick at the very end hears the last frame
                    break
                state = _tick(parts, log, clock, beat, state, start_s, 1.0 / rate_hz)
            return "done"
        finally:
            ticks = beats(clock, rate_hz, start_s)
            come_to_rest(parts.bus, parts.limiter, state.limiter, state.here_rad, parts.rest_rad, ticks, log)
    finally:
        parts.bus.stop(stop)


def _tick(parts: Parts, log: RunLog, clock: Clock, beat: Beat, state: State, start_s: float, period_s: float) -> State:
    now_s = beat.time_s  # the run's own time: 0 when torque came on
    for frame in parts.source.read(now_s):
        parts.feed.push(frame, now_s)
        log.heard(frame)
        for observer in parts.observers:
            observer.heard(frame)

    timeline = state.timeline
    for plan in parts.feed.poll(now_s):
        if not np.isfinite(plan.frames).all():
            log.refuse()  # a model gone wrong: what was planned before it stays in force
            continue
        timeline = parts.timeline.accept(plan, timeline)
        log.planned(plan)
        for observer in parts.observers:
            observer.planned(plan)

    times_s = np.concatenate([[now_s], now_s + parts.leads_s + period_s])
    motion, timeline = parts.timeline.sample(times_s, now_s, timeline)
    life = state.life
    if parts.life:
        motion, life = parts.life.step(motion, times_s, now_s, life)
    knobs = parts.knobs() if parts.knobs else None
    asked_rad, retargeter = parts.retargeter.step(motion[1:], state.retargeter, knobs)
    eased = smooth((now_s + period_s - state.since_s) / EASE_S)
    ahead_rad = state.held_rad + eased * (asked_rad - state.held_rad)
    reference = difference(state.before_rad, state.here_rad, ahead_rad, period_s)

    goals_rad, limiter = parts.limiter.step(reference, state.limiter)
    parts.bus.write(goals_rad, now_s)
    log.wrote(beat, now_s, clock.now_s() - start_s, float(times_s.max()), goals_rad, reference[0], motion[0])
    readings = parts.bus.poll(now_s)

    seen = Tick(now_s, motion[0], goals_rad, readings)
    for observer in parts.observers:
        observer.tick(seen)
    state = replace(state, timeline=timeline, life=life, retargeter=retargeter, limiter=limiter)
    state = replace(state, before_rad=state.here_rad, here_rad=ahead_rad)
    return _rejoined(parts, log, readings, state, now_s)


def _rejoined(parts: Parts, log: RunLog, readings: Mapping[str, Reading], state: State, now_s: float) -> State:
    """Joints that were away ease in again from where they stand, as all did when torque came on."""
    joints = parts.retargeter.joints
    back = np.array([joint in readings and readings[joint].rejoined for joint in joints])
    if not back.any():
        return state
    stands = np.array(
        [readings[joint].position_rad if there else 0.0 for joint, there in zip(joints, back, strict=True)]
    )
    log.restart(back, stands)
    held, since = np.where(back, stands, state.held_rad), np.where(back, now_s, state.since_s)
    before, here = np.where(back, stands, state.before_rad), np.where(back, stands, state.here_rad)
    limiter = parts.limiter.restart(back, stands, state.limiter)
    return replace(state, limiter=limiter, held_rad=held, since_s=since, before_rad=before, here_rad=here)


def difference(before: Doubles, here: Doubles, ahead: Doubles, period_s: float) -> Doubles:
    """Angle, speed and acceleration at `here` from three samples (J,) one period apart -> (3, J)."""
    return np.stack([here, (ahead - before) / (2 * period_s), (ahead - 2 * here + before) / period_s**2])
