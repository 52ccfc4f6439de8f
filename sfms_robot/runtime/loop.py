"""The loop, in the order a frame travels.

    source -> listener -> timeline -> retarget -> limits -> bus -> observers

There is one tick every 1/rate_hz s, on absolute deadlines. Everything that changes during a run is in a `LoopState`
that is passed from step to step. The new state is kept as soon as the limiter has returned its goals, so after a later
error the way to rest begins at the last command. The reference of a tick is the face at the tick's time plus the lead
of the joint, as far as the plan in force reaches. Its speed and acceleration are central differences, so one sample
lies one tick ahead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import numpy as np

from sfms_robot.errors import BusError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, NEUTRAL, Bools, Doubles, Floats, Readings
from sfms_robot.motion.limits import JerkLimiter, LimiterState, difference
from sfms_robot.ports import Bus, Clock, Observer, PlanFeed, Retargeter, Source, Tick, Timeline
from sfms_robot.retarget.spontaneous import HeadLife, LifeState
from sfms_robot.runtime.clock import TickTime, tick_times
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.observers import Observers
from sfms_robot.runtime.safety import EASE_S, Heat, HeatGuard, come_to_rest, temperatures_C
from sfms_robot.runtime.states import Fade, Presence, RunState
from sfms_robot.signals.minimum_jerk import ease

LOOK_S: Final = 0.1  # period of the check for lost servos
WARMTH_S: Final = 1.0  # period of the check of temperatures
AWAY_S: Final = 1.0  # a servo whose position is older than this is away
PINCH: Final = "pinch"  # beginning of the fault of a joint that pinches
_LOADED: Final = np.fft, np.ma  # numpy imports both at their first use, which must not be inside the loop
_TURNING: Final = [CHANNEL_INDEX[name] for name in CHANNELS if name in ("yaw", "pitch") or name.startswith("eyeLook")]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The parts between a plan and the bus; (J,) in joint order.

    Attributes:
        leads_s, rest_rad: (J,) lead and rest angle of each joint.
        holds: (J,) joints that keep their torque when halted; None: no joint does.
        heat: temperature derating; None disables it.
    """

    timeline: Timeline
    retargeter: Retargeter
    limiter: JerkLimiter
    leads_s: Doubles
    rest_rad: Doubles
    holds: Bools | None = None
    heat: HeatGuard | None = None


@dataclass(frozen=True, kw_only=True)
class Parts(Motion):
    """The parts of a run, put together by `app`.

    Attributes:
        knobs: function called at every tick, returns the knobs of the head; None: those of its file.
        overlay: function (motion (N, 58), times (N,)) -> motion, which adds the commands of a program to the plan.
        answers: whether the plan is shown only while `Presence.answered` is true.
        halt: the emergency stop, read at every tick.
        ignored: joints whose faults are known and accepted.
        missing: function called at every tick, returns the names of further lost parts.
    """

    source: Source
    feed: PlanFeed
    bus: Bus
    observers: Sequence[Observer]
    life: HeadLife | None = None
    knobs: Callable[[], Any] | None = None
    overlay: Callable[[Floats, Doubles], Floats] | None = None
    answers: bool = False
    halt: HaltLatch = field(default_factory=HaltLatch)
    ignored: frozenset[str] = frozenset()
    missing: Callable[[], Sequence[str]] = tuple


@dataclass(frozen=True, kw_only=True)
class LoopState:
    """State of the loop between two ticks.

    Attributes:
        held_rad, since_s: (J,) the pose in which torque came on, and its time.
        before_rad, here_rad: (J,) two samples of the reference: the one of the last command and that of the next.
        goals_rad: (J,) the last command; `motion` (58,) the face that it shows, `reach_s` the latest instant of the
            timeline that it used.
        run: the state of the run, judged by `presence` and `lost_joints`.
        answer: share of the listener's answer that is shown.
        released: (J,) joints that a halt has released and that are not back yet; their goals do not change.
        stands: whether the head stands in a halt and has released all joints that it does not hold.
    """

    timeline: Any
    limiter: LimiterState
    held_rad: Doubles
    since_s: Doubles
    before_rad: Doubles
    here_rad: Doubles
    goals_rad: Doubles
    reach_s: float = -math.inf
    retargeter: Any
    heat: Heat
    released: Bools
    life: LifeState = LifeState()
    presence: Presence = field(default_factory=Presence)
    run: RunState = RunState()
    lost_joints: tuple[str, ...] = ()
    answer: Fade = Fade()
    stands: bool = False
    motion: Floats = field(default_factory=lambda: NEUTRAL)


def drive(
    parts: Parts,
    clock: Clock,
    log: RunLog,
    *,
    rate_hz: float,
    duration_s: float,
    interrupted: Callable[[], bool],
) -> str:
    """Run: torque on, ease in, listen for `duration_s`, ease to rest, torque off. Return "done" or "interrupted".

    Blocks until then. After any error every bus that still works eases its joints to rest, and `bus.stop` is called
    before the error leaves this function.
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
                # The tick due at the very end reads the last frame, however late it is.
                if interrupted() or tick.time_s - tick.skipped / rate_hz > duration_s + 1e-9:
                    break
                before_rad = state.goals_rad
                state = _heard(parts, observers, log, tick.time_s, state)
                state = _judged(parts, log, tick.time_s, state)
                if state.run.name == "halted":
                    state = _halted(parts, tick.time_s, state)
                else:
                    if state.stands:
                        state = _resumed(parts, log, tick.time_s, state)
                    state = _commanded(parts, tick.time_s, 1.0 / rate_hz, state)
                goals_rad, motion = state.goals_rad, state.motion
                log.commanded(tick, goals_rad, state.before_rad, motion)
                parts.bus.write(goals_rad, tick.time_s)
                written_s = clock.now_s() - start_s
                log.wrote(written_s, state.reach_s)
                readings = parts.bus.poll(tick.time_s)
                state = _rejoined(parts, log, readings, state, tick.time_s)
                state = _noticed(parts, readings, state, tick.time_s, 1.0 / rate_hz)
                parts.source.moves(float(np.abs(goals_rad - before_rad).sum() * rate_hz))
                observers.tick(
                    Tick(
                        time_s=tick.time_s,
                        motion=motion,
                        goals_rad=goals_rad,
                        readings=readings,
                        state=state.run.name,
                        why=state.run.why,
                        written_s=written_s,
                        origin_s=clock.origin_s + start_s,
                        busy=log.pace.busy,
                    )
                )
        finally:
            log.state = _ended(
                parts, observers, log, tick_times(clock, rate_hz, start_s), clock.now_s() - start_s, state
            )
    finally:
        parts.bus.stop("release")
    return "interrupted" if interrupted() else "done"


def _enabled(parts: Parts, log: RunLog, interrupted: Callable[[], bool]) -> LoopState | None:
    """Switch torque on, joint by joint, and return the first state; None if the run is interrupted meanwhile."""
    held_rad = np.zeros(len(parts.retargeter.joints))
    for index, joint in enumerate(parts.retargeter.joints):
        if interrupted():
            return None
        held_rad[index] = parts.bus.enable([joint])[0]
        if parts.halt.causes:
            parts.bus.torque_off("release")  # again: the watcher's packet may have come between two joints
            raise BusError(f"halted by {', '.join(parts.halt.causes)} while joints were switched on")
    log.start(held_rad)
    return LoopState(
        timeline=parts.timeline.start(),
        limiter=parts.limiter.start(held_rad),
        held_rad=held_rad,
        since_s=0 * held_rad,
        before_rad=held_rad,
        here_rad=held_rad,
        goals_rad=held_rad,
        retargeter=parts.retargeter.start(),
        heat=Heat.cool(len(held_rad)),
        released=np.zeros(len(held_rad), np.bool_),
    )


def _heard(parts: Parts, observers: Observers, log: RunLog, now_s: float, state: LoopState) -> LoopState:
    """Pass frames of the person to the listener, and plans that are ready to the timeline."""
    presence = state.presence
    for frame in parts.source.read(now_s):
        presence = presence.after(frame)
        parts.feed.push(frame, now_s)
        log.heard(frame)
        observers.heard(frame)
    timeline = state.timeline
    for plan in parts.feed.poll(now_s):
        if not np.isfinite(plan.frames).all():
            log.refused_plans += 1  # an error of the model: earlier plans stay in force
            continue
        timeline = parts.timeline.accept(plan, timeline)
        log.planned(plan)
        observers.planned(plan)
    return replace(state, timeline=timeline, presence=presence)


def _judged(parts: Parts, log: RunLog, now_s: float, state: LoopState) -> LoopState:
    """Return the loop's state with the present state of the run in `run`."""
    presence = state.presence
    listener = ("listener",) if parts.feed.lost else ()
    lost = (*parts.source.missing, *listener, *parts.missing(), *state.lost_joints)
    halted, released = parts.halt.causes, state.released
    if not halted and state.run.name == "halted" and not state.stands:
        halted = state.run.why  # a halt does not end before the head stands
    run = state.run.then(
        now_s,
        eased_in=bool(now_s - state.since_s.max(initial=0.0) >= EASE_S),
        person=presence.person(now_s),
        speaking=presence.speaking(now_s),
        lost=lost,
        halted=halted,
    )
    if run.name == "halted" and parts.halt.answer():  # torque went off meanwhile
        released = np.ones_like(released)
    if (run.name, run.why) != (state.run.name, state.run.why) or not log.states:
        log.entered(run, now_s)
    return replace(state, run=run, released=released)


def _ended(
    parts: Parts, observers: Observers, log: RunLog, ticks: Iterator[TickTime], now_s: float, state: LoopState
) -> LoopState:
    """Bring the head to rest; return the last state."""
    run = state.run.then(now_s, ending=True)
    log.entered(run, now_s)

    def seen(time_s: float, ahead: float, goals_rad: Doubles, readings: Readings) -> None:
        """Report a tick of the way to rest to the observers; the last face fades with `ahead`, the remaining share."""
        observers.tick(Tick(time_s, state.motion * np.float32(ahead), goals_rad, readings, run.name, run.why))

    if not parts.halt.causes:  # a halted head does not move to rest
        come_to_rest(
            parts.bus,
            parts.limiter,
            state.limiter,
            from_rad=state.here_rad,
            rest_rad=parts.rest_rad,
            ticks=ticks,
            log=log,
            seen=seen,
        )
    return replace(state, run=run)


def turned_by_hand(planned: Floats, asked: Floats) -> bool:
    """Return whether the requested motion (N, 58) turns head or eyes differently from the planned one (N, 58)."""
    return asked is not planned and not np.array_equal(asked[:, _TURNING], planned[:, _TURNING])


def _commanded(parts: Parts, now_s: float, period_s: float, state: LoopState) -> LoopState:
    """Return the state with goals inside the limits for the face of this instant, each joint ahead by its lead."""
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
    return replace(
        state, timeline=timeline, limiter=limiter, before_rad=state.here_rad, here_rad=ahead_rad, goals_rad=goals_rad,
        reach_s=float(times_s.max()), life=life, retargeter=retargeter, answer=answer, motion=motion[0],
    )  # fmt: skip


def _halted(parts: Parts, now_s: float, state: LoopState) -> LoopState:
    """Brake all joints; once they stand, release those that need not hold."""
    goals_rad, limiter = parts.limiter.brake(state.limiter)
    released, stands = state.released, state.stands
    if state.run.since_s == now_s and released.any():  # joints on their way back from an earlier halt
        _let_go(parts, released)
    if not stands and np.array_equal(goals_rad, state.goals_rad):
        stands, released = True, np.ones_like(released) if parts.holds is None else released | ~parts.holds
        _let_go(parts, released)
    return replace(
        state, limiter=limiter, before_rad=goals_rad, here_rad=goals_rad, goals_rad=goals_rad, reach_s=-math.inf,
        released=released, stands=stands, motion=NEUTRAL,
    )  # fmt: skip


def _let_go(parts: Parts, which: Bools) -> None:
    parts.bus.release([joint for joint, each in zip(parts.retargeter.joints, which, strict=True) if each])


def _resumed(parts: Parts, log: RunLog, now_s: float, state: LoopState) -> LoopState:
    """End a halt: held joints ease in from their present angles, the others from the angles at which they come back."""
    parts.bus.resume(parts.retargeter.joints)
    every = np.ones_like(state.released)
    back = state.released & np.array([joint not in parts.ignored for joint in parts.retargeter.joints], np.bool_)
    return replace(_eased_in_from(parts, log, state.goals_rad, every, state, now_s), released=back, stands=False)


def _rejoined(parts: Parts, log: RunLog, readings: Readings, state: LoopState, now_s: float) -> LoopState:
    """Ease in joints that have come back, from their present angles, as at the start."""
    joints = parts.retargeter.joints
    back = np.array([joint in readings and readings[joint].rejoined for joint in joints], np.bool_)
    if not back.any():
        return state
    stands_rad = state.goals_rad.copy()  # the goal stays in use for a servo without a position
    for index in np.flatnonzero(back).tolist():
        position_rad = readings[joints[index]].position_rad
        stands_rad[index] = stands_rad[index] if position_rad is None else position_rad
    return replace(_eased_in_from(parts, log, stands_rad, back, state, now_s), released=state.released & ~back)


def _eased_in_from(
    parts: Parts, log: RunLog, stands_rad: Doubles, which: Bools, state: LoopState, now_s: float
) -> LoopState:
    """Return the state in which the joints `which` (J,) stand at `stands_rad` (J,) and ease in from `now_s` on."""
    log.restart(which, stands_rad)

    def stand(angles_rad: Doubles) -> Doubles:
        return np.where(which, stands_rad, angles_rad)

    return replace(
        state, limiter=parts.limiter.restart(which, stands_rad, state.limiter), held_rad=stand(state.held_rad),
        since_s=np.where(which, now_s, state.since_s), before_rad=stand(state.before_rad),
        here_rad=stand(state.here_rad), goals_rad=stand(state.goals_rad),
    )  # fmt: skip


def _noticed(parts: Parts, readings: Readings, state: LoopState, now_s: float, period_s: float) -> LoopState:
    """Note servos that are away, faulty or warm by their readings; a pinch while halted releases all joints at once."""
    heat = state.heat
    if parts.heat:
        if _due(now_s, period_s, WARMTH_S):
            heat = parts.heat.judge(temperatures_C(parts.retargeter.joints, readings), heat)
        heat = parts.heat.after(heat, period_s)
    if not _due(now_s, period_s, LOOK_S):
        return replace(state, heat=heat) if heat is not state.heat else state
    lost = tuple(
        joint
        for joint, reading in readings.items()
        if reading.fault is not None or (reading.position_rad is not None and reading.age_s > AWAY_S)
        if joint not in parts.ignored
    )
    if state.run.name == "halted" and any((readings[joint].fault or "").startswith(PINCH) for joint in lost):
        every = np.ones_like(state.released)
        _let_go(parts, every)
        state = replace(state, released=every, stands=True)
    return replace(state, heat=heat, lost_joints=lost)


def _due(now_s: float, period_s: float, every_s: float) -> bool:
    """Return whether this is the first tick in a new period of `every_s`."""
    return math.floor(now_s / every_s + 1e-9) != math.floor((now_s - period_s) / every_s + 1e-9)
