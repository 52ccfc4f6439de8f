"""The loop, in the order a frame travels.

    source -> listener -> timeline -> retarget -> limits -> bus -> observers

One tick every 1/rate_hz s on absolute deadlines. What changes while it runs is a `State` handed from step to step. It
is kept as soon as the limiter has decided, so whatever is raised after that, and wherever, the way to rest begins at
the last command. The reference of a tick is the face at (tick time + lead of the joint, as far as the plan in force
goes); speed and acceleration are central differences, so one sample lies one tick ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sfms_robot.frames import Doubles, Floats, Reading
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
from sfms_robot.runtime.clock import tick_times
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.observers import Observers
from sfms_robot.runtime.safety import EASE_S, come_to_rest, smooth


@dataclass(frozen=True)
class Parts:
    """Everything a run is made of, put together by `app`. `leads_s` and `rest_rad` are (J,) in joint order.

    `knobs` is asked at every tick how much the head is to show; None: what its file says. `overlay` (motion (N, 58),
    times (N,)) -> motion lays what somebody asks for by hand over what the listener planned.
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
    overlay: Callable[[Floats, Doubles], Floats] | None = None


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

    Blocks until then. Whatever is raised on the way, wherever, every bus that still works eases its joints to rest,
    and `bus.stop` is called before it is raised further.
    """
    observers = Observers(parts.observers)
    log.detached = observers.detached
    try:
        state = _enabled(parts, log, interrupted)
        if state is None:
            return "interrupted"
        start_s = clock.now_s()
        try:
            parts.source.start(clock.origin_s + start_s)
            for tick in tick_times(clock, rate_hz, start_s):
                if interrupted() or tick.time_s > duration_s + 1e-9:  # the tick at the very end hears the last frame
                    break
                state = _heard(parts, observers, log, tick.time_s, state)
                state, command = _commanded(parts, tick.time_s, 1.0 / rate_hz, state)
                log.commanded(tick, command.goals_rad, command.asked_rad, command.motion)
                parts.bus.write(command.goals_rad, tick.time_s)
                log.wrote(clock.now_s() - start_s, command.reach_s)
                readings = parts.bus.poll(tick.time_s)
                state = _rejoined(parts, log, readings, state, tick.time_s)
                observers.tick(Tick(tick.time_s, command.motion, command.goals_rad, readings))
        finally:
            way = tick_times(clock, rate_hz, start_s)
            come_to_rest(parts.bus, parts.limiter, state.limiter, state.here_rad, parts.rest_rad, way, log)
            log.state = state
    finally:
        parts.bus.stop(stop)
    return "interrupted" if interrupted() else "done"


def _enabled(parts: Parts, log: RunLog, interrupted: Callable[[], bool]) -> State | None:
    """Torque on, joint by joint, so that who asks to end need not wait for all of them; None when somebody did."""
    held_rad = np.zeros(len(parts.retargeter.joints))
    for index, joint in enumerate(parts.retargeter.joints):
        if interrupted():
            return None
        held_rad[index] = parts.bus.enable([joint])[0]
    log.start(held_rad)
    return State(
        parts.timeline.start(), parts.limiter.start(held_rad), held_rad, 0 * held_rad, held_rad, held_rad,
        parts.life.start() if parts.life else None, parts.retargeter.start(),
    )  # fmt: skip


def _heard(parts: Parts, observers: Observers, log: RunLog, now_s: float, state: State) -> State:
    """Frames of the person go to the listener, plans that are ready join the timeline."""
    for frame in parts.source.read(now_s):
        parts.feed.push(frame, now_s)
        log.heard(frame)
        observers.heard(frame)
    timeline = state.timeline
    for plan in parts.feed.poll(now_s):
        if not np.isfinite(plan.frames).all():
            log.refuse()  # a model gone wrong: what was planned before it stays in force
            continue
        timeline = parts.timeline.accept(plan, timeline)
        log.planned(plan)
        observers.planned(plan)
    return replace(state, timeline=timeline)


@dataclass(frozen=True)
class Command:
    """What a tick asks of the servos: goals (J,), what the limiter was asked for (J,), the face (58,) behind it.

    `reach_s`: how far into the timeline it looked.
    """

    goals_rad: Doubles
    asked_rad: Doubles
    motion: Floats
    reach_s: float


def _commanded(parts: Parts, now_s: float, period_s: float, state: State) -> tuple[State, Command]:
    """The face of this instant, each joint ahead by its lead, as goals inside the limits."""
    ahead_s = np.minimum(parts.leads_s + period_s, parts.timeline.lead_limit_s(state.timeline))
    times_s = np.concatenate([[now_s], now_s + ahead_s])
    motion, timeline = parts.timeline.sample(times_s, now_s, state.timeline)
    if parts.overlay:
        motion = parts.overlay(motion, times_s)
    life, knobs = state.life, parts.knobs() if parts.knobs else None
    if parts.life:
        shown_pose = partial(parts.retargeter.shown_pose, knobs=knobs)
        motion, life = parts.life.step(motion, times_s, now_s, life, shown_pose)
    angles_rad, retargeter = parts.retargeter.step(motion[1:], state.retargeter, knobs)
    eased = smooth((now_s + period_s - state.since_s) / EASE_S)
    ahead_rad = state.held_rad + eased * (angles_rad - state.held_rad)
    reference = difference(state.before_rad, state.here_rad, ahead_rad, period_s)
    goals_rad, limiter = parts.limiter.step(reference, state.limiter)
    state = State(timeline, limiter, state.held_rad, state.since_s, state.here_rad, ahead_rad, life, retargeter)
    return state, Command(goals_rad, reference[0], motion[0], float(times_s.max()))


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
