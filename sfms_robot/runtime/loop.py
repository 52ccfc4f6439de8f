"""The loop, in the order a frame travels.

    source -> listener -> timeline -> retarget -> limits -> bus -> observers

One tick every 1/rate_hz s on absolute deadlines. What changes while it runs is a `State` handed from step to step. It
is kept as soon as the limiter has decided, so whatever is raised after that, and wherever, the way to rest begins at
the last command. The reference of a tick is the face at (tick time + lead of the joint, as far as the plan in force
goes); speed and acceleration are central differences, so one sample lies one tick ahead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import BusError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM, Doubles, Floats, Reading
from sfms_robot.ports import (
    Bus,
    Clock,
    Limiter,
    Observer,
    PlanFeed,
    Retargeter,
    Source,
    SpontaneousMotion,
    StopPolicy,
    Tick,
    Timeline,
)
from sfms_robot.runtime.clock import tick_times
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.observers import Observers
from sfms_robot.runtime.safety import EASE_S, Heat, HeatGuard, come_to_rest, temperatures_C
from sfms_robot.runtime.states import Fade, Presence, RunState, Situation, following
from sfms_robot.signals.minimum_jerk import ease

LOOK_S: Final = 0.1  # between two looks at what is lost
WARMTH_S: Final = 1.0  # and at how warm servos are
AWAY_S: Final = 1.0  # a position older than this: the servo is away
PINCH: Final = "pinch"  # a fault that begins so
_LOADED: Final = np.fft, np.ma  # numpy imports both at their first use, which must not be inside the loop
_TURNING: Final = [CHANNEL_INDEX[name] for name in CHANNELS if name in ("yaw", "pitch") or name.startswith("eyeLook")]


@dataclass(frozen=True)
class Parts:
    """Everything a run is made of, put together by `app`; (J,) in joint order.

    Attributes:
        leads_s, rest_rad: (J,).
        knobs: asked at every tick how much the head is to show; None: what its file says.
        overlay: (motion (N, 58), times (N,)) -> motion lays what somebody asks for by hand over what is planned.
        answers: what is planned shows only while somebody is there.
        halt: asked at every tick.
        holds: (J,) joints that keep their torque when halted; None: no joint does.
        heat: None: temperatures are nobody's business here.
        ignored: joints whose faults are known and wanted.
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
    life: SpontaneousMotion | None = None
    knobs: Callable[[], Any] | None = None
    overlay: Callable[[Floats, Doubles], Floats] | None = None
    answers: bool = False
    halt: HaltLatch = field(default_factory=HaltLatch)
    holds: NDArray[np.bool_] | None = None
    heat: HeatGuard | None = None
    ignored: frozenset[str] = frozenset()


@dataclass(frozen=True)
class State:
    """What one tick hands to the next.

    Attributes:
        held_rad, since_s: (J,) the pose torque came on in, and when.
        before_rad, here_rad: (J,) two samples of the reference.
        goals_rad: (J,) the last command; `motion` (58,) the face behind it.
        run: the state of the run; `presence` and `lost_joints` are what it is judged by.
        answer: how much of the listener's answer shows.
        released: (J,) joints that a halt has let go of and that have not come back; their goals stand still.
        stands: it is halted, and has let go of all that it does not hold.
    """

    timeline: Any
    limiter: Any
    held_rad: Doubles
    since_s: Doubles
    before_rad: Doubles
    here_rad: Doubles
    goals_rad: Doubles
    life: Any
    retargeter: Any
    heat: Heat
    released: NDArray[np.bool_]
    presence: Presence = field(default_factory=Presence.start)
    run: RunState = RunState()
    lost_joints: tuple[str, ...] = ()
    answer: Fade = Fade()
    stands: bool = False
    motion: Floats = field(default_factory=lambda: np.zeros(MOTION_DIM, np.float32))


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
                before_rad = state.goals_rad
                state = _heard(parts, observers, log, tick.time_s, state)
                state = _judged(parts, log, tick.time_s, state)
                if state.run.name == "halted":
                    state, command = _halted(parts, tick.time_s, state)
                else:
                    if state.stands:
                        state = _resumed(parts, log, tick.time_s, state)
                    state, command = _commanded(parts, tick.time_s, 1.0 / rate_hz, state)
                log.commanded(tick, command.goals_rad, command.asked_rad, command.motion)
                parts.bus.write(command.goals_rad, tick.time_s)
                written_s = clock.now_s() - start_s
                log.wrote(written_s, command.reach_s)
                readings = parts.bus.poll(tick.time_s)
                state = _rejoined(parts, log, readings, state, tick.time_s)
                state = _noticed(parts, readings, state, tick.time_s, 1.0 / rate_hz)
                parts.source.moves(float(np.abs(command.goals_rad - before_rad).sum() * rate_hz))
                observers.tick(
                    Tick(
                        tick.time_s, command.motion, command.goals_rad, readings, state.run.name, state.run.why,
                        written_s,
                    )
                )  # fmt: skip
        finally:
            state = _ending(log, clock.now_s() - start_s, state)
            if not parts.halt.causes:  # a head that was halted moves no more
                way = tick_times(clock, rate_hz, start_s)
                seen = partial(_seen_on_the_way, observers, state)
                come_to_rest(parts.bus, parts.limiter, state.limiter, state.here_rad, parts.rest_rad, way, log, seen)
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
        if parts.halt.causes:
            parts.bus.torque_off("release")  # again: what the watcher sent may have come between two joints
            raise BusError(f"halted by {', '.join(parts.halt.causes)} while joints were switched on")
    log.start(held_rad)
    return State(
        parts.timeline.start(), parts.limiter.start(held_rad), held_rad, 0 * held_rad, held_rad, held_rad, held_rad,
        parts.life.start() if parts.life else None, parts.retargeter.start(), Heat.cool(len(held_rad)),
        np.zeros(len(held_rad), np.bool_),
    )  # fmt: skip


def _heard(parts: Parts, observers: Observers, log: RunLog, now_s: float, state: State) -> State:
    """Frames of the person go to the listener, plans that are ready join the timeline."""
    presence = state.presence
    for frame in parts.source.read(now_s):
        presence = presence.after(frame)
        parts.feed.push(frame, now_s)
        log.heard(frame)
        observers.heard(frame)
    timeline = state.timeline
    for plan in parts.feed.poll(now_s):
        if not np.isfinite(plan.frames).all():
            log.refused_plans += 1  # a model gone wrong: the plans before it stay in force
            continue
        timeline = parts.timeline.accept(plan, timeline)
        log.planned(plan)
        observers.planned(plan)
    return replace(state, timeline=timeline, presence=presence)


def _judged(parts: Parts, log: RunLog, now_s: float, state: State) -> State:
    """Return the state with what the run is doing from here on."""
    presence = state.presence
    lost = (*parts.source.missing, *(("listener",) if parts.feed.lost else ()), *state.lost_joints)
    eased_in = bool(now_s - state.since_s.max() >= EASE_S)
    halted, released = parts.halt.causes, state.released
    if not halted and state.run.name == "halted" and not state.stands:
        halted = state.run.why  # it ends when the head stands, not before
    run = following(
        state.run, Situation(eased_in, presence.person(now_s), presence.speaking(now_s), lost, halted), now_s
    )
    if run.name == "halted" and parts.halt.answer():  # torque went off meanwhile
        released = np.ones_like(released)
    if (run.name, run.why) != (state.run.name, state.run.why) or not log.states:
        log.entered(run, now_s)
    return replace(state, run=run, released=released)


def _ending(log: RunLog, now_s: float, state: State) -> State:
    run = following(state.run, Situation(ending=True), now_s)
    log.entered(run, now_s)
    return replace(state, run=run)


def _seen_on_the_way(
    observers: Observers, state: State, now_s: float, ahead: float, goals_rad: Doubles, readings: Mapping[str, Reading]
) -> None:
    """A tick of the way to rest, of which the share `ahead` is still to go: the last face fades with it."""
    motion = state.motion * np.float32(ahead)
    observers.tick(Tick(now_s, motion, goals_rad, readings, state.run.name, state.run.why))


def turned_by_hand(planned: Floats, asked: Floats) -> bool:
    """Whether what is asked (N, 58) turns head or eyes otherwise than what was planned (N, 58)."""
    return asked is not planned and not np.array_equal(asked[:, _TURNING], planned[:, _TURNING])


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
    answer = state.answer
    if parts.answers:
        answer = answer.toward(float(state.presence.answered(now_s)), times_s)
        motion = motion * answer.at(times_s)[:, None].astype(np.float32)
    planned = motion
    if parts.overlay:
        motion = parts.overlay(motion, times_s)
    life, knobs = state.life, parts.knobs() if parts.knobs else None
    if parts.life:
        shown_pose = partial(parts.retargeter.shown_pose, knobs=knobs)
        watched = replace(state.presence.watched, by_hand=turned_by_hand(planned, motion))
        motion, life = parts.life.step(motion, times_s, now_s, life, shown_pose, watched)
    angles_rad, retargeter = parts.retargeter.step(motion[1:], state.retargeter, knobs)
    if not state.heat.none:
        angles_rad = parts.rest_rad + state.heat.share * (angles_rad - parts.rest_rad)
    eased = ease((now_s + period_s - state.since_s) / EASE_S)
    if state.released.any():
        eased = np.where(state.released, 0.0, eased)
    ahead_rad = state.held_rad + eased * (angles_rad - state.held_rad)
    reference = difference(state.before_rad, state.here_rad, ahead_rad, period_s)
    goals_rad, limiter = parts.limiter.step(reference, state.limiter)
    state = replace(
        state, timeline=timeline, limiter=limiter, before_rad=state.here_rad, here_rad=ahead_rad, goals_rad=goals_rad,
        life=life, retargeter=retargeter, answer=answer, motion=motion[0],
    )  # fmt: skip
    return state, Command(goals_rad, reference[0], motion[0], float(times_s.max()))


def _halted(parts: Parts, now_s: float, state: State) -> tuple[State, Command]:
    """Brake; once all joints stand, let go of those that need not hold themselves."""
    goals_rad, limiter = parts.limiter.brake(state.limiter)
    released, stands = state.released, state.stands
    if state.run.since_s == now_s and released.any():  # on their way back from a halt before: not now
        _let_go(parts, released)
    if not stands and np.array_equal(goals_rad, state.goals_rad):
        stands, released = True, np.ones_like(released) if parts.holds is None else released | ~parts.holds
        _let_go(parts, released)
    command = Command(goals_rad, goals_rad, np.zeros(MOTION_DIM, np.float32), -math.inf)
    return replace(state, limiter=limiter, goals_rad=goals_rad, released=released, stands=stands), command


def _let_go(parts: Parts, which: NDArray[np.bool_]) -> None:
    parts.bus.release([joint for joint, each in zip(parts.retargeter.joints, which, strict=True) if each])


def _resumed(parts: Parts, log: RunLog, now_s: float, state: State) -> State:
    """End a halt: held joints ease in from where they stand now, the others from where they come back."""
    parts.bus.resume(parts.retargeter.joints)
    every = np.ones_like(state.released)
    back = state.released & [joint not in parts.ignored for joint in parts.retargeter.joints]
    return replace(_eased_in_from(parts, log, state.goals_rad, every, state, now_s), released=back, stands=False)


def _rejoined(parts: Parts, log: RunLog, readings: Mapping[str, Reading], state: State, now_s: float) -> State:
    """Ease joints that were away in again from where they stand, as all did when torque came on."""
    joints = parts.retargeter.joints
    back = np.array([joint in readings and readings[joint].rejoined for joint in joints])
    if not back.any():
        return state
    stands_rad = state.goals_rad.copy()  # of a servo that cannot tell its position, too
    for index in np.flatnonzero(back).tolist():
        position_rad = readings[joints[index]].position_rad
        stands_rad[index] = stands_rad[index] if position_rad is None else position_rad
    return replace(_eased_in_from(parts, log, stands_rad, back, state, now_s), released=state.released & ~back)


def _eased_in_from(
    parts: Parts, log: RunLog, stands_rad: Doubles, which: NDArray[np.bool_], state: State, now_s: float
) -> State:
    """`which` (J,) joints stand still at `stands_rad` (J,) from `now_s` on, and are led into the face; others go on."""
    log.restart(which, stands_rad)

    def stand(angles_rad: Doubles) -> Doubles:
        return np.where(which, stands_rad, angles_rad)

    return replace(
        state, limiter=parts.limiter.restart(which, stands_rad, state.limiter), held_rad=stand(state.held_rad),
        since_s=np.where(which, now_s, state.since_s), before_rad=stand(state.before_rad),
        here_rad=stand(state.here_rad), goals_rad=stand(state.goals_rad),
    )  # fmt: skip


def _noticed(parts: Parts, readings: Mapping[str, Reading], state: State, now_s: float, period_s: float) -> State:
    """Take what the servos say: which are away, faulty or warm; a pinch while halted lets go of all at once."""
    heat = state.heat
    if parts.heat:
        if _due(now_s, period_s, WARMTH_S):
            heat = parts.heat.judge(temperatures_C(parts.retargeter.joints, readings), heat)
        heat = parts.heat.after(heat, period_s)
    if not _due(now_s, period_s, LOOK_S):
        return replace(state, heat=heat) if heat is not state.heat else state
    lost = tuple(joint for joint, reading in readings.items() if joint not in parts.ignored and _is_lost(reading))
    if state.run.name == "halted" and any((readings[joint].fault or "").startswith(PINCH) for joint in lost):
        every = np.ones_like(state.released)
        _let_go(parts, every)
        state = replace(state, released=every, stands=True)
    return replace(state, heat=heat, lost_joints=lost)


def _is_lost(reading: Reading) -> bool:
    return reading.fault is not None or (reading.position_rad is not None and reading.age_s > AWAY_S)


def _due(now_s: float, period_s: float, every_s: float) -> bool:
    """Whether this is the first tick of a new `every_s`."""
    return math.floor(now_s / every_s + 1e-9) != math.floor((now_s - period_s) / every_s + 1e-9)


def difference(before: Doubles, here: Doubles, ahead: Doubles, period_s: float) -> Doubles:
    """Angle, speed and acceleration at `here` from three samples (J,) one period apart -> (3, J)."""
    return np.stack([here, (ahead - before) / (2 * period_s), (ahead - 2 * here + before) / period_s**2])
