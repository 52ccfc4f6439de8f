"""Composition root: where concrete parts are put together, for every command that moves a head.

    open_head       the servos, and what lies between a plan and them (`app.open_head`); torque is untouched
    drive_head      torque on, the loop, rest, torque off, and the report
    run             both around a listener and a person: `sfms-robot run`, and `Robot`

Whatever happens after torque came on, the loop brings the head to rest, and there is a report.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from sfms_robot.app.fleet.fleet_head import FleetControls, FleetHead, fleet_key, fleet_name
from sfms_robot.app.listen.knobs import LiveKnobs, turned
from sfms_robot.app.listen.report import Drove, RunTeller, figures_so_far, limitation, run_facts, run_report
from sfms_robot.app.loopback_server import LoopbackServer, status_server
from sfms_robot.app.open_head import HeadOptions, OpenHead, open_head, prepare_head
from sfms_robot.app.wiring import SIM
from sfms_robot.config import Calmness, Head
from sfms_robot.errors import ConfigError, RobotError, TorqueError
from sfms_robot.frames import Doubles, Floats
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.open_feed import NamedFeed, open_feed
from sfms_robot.listeners.process import ListenerProcess
from sfms_robot.network import Router, session_config
from sfms_robot.plugins import REMOTE, listener_folder
from sfms_robot.ports import Observer, PlanFeed, Retargeter, Source, Timeline
from sfms_robot.realtime import realtime_priority
from sfms_robot.retarget.spontaneous import HeadLife
from sfms_robot.runtime.clock import InlineFeed
from sfms_robot.runtime.halt import HaltLatch, halt_signals, halt_switch
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.loop import Parts, drive
from sfms_robot.runtime.observers import NotifyingObserver, RunStatus, ServiceManager
from sfms_robot.runtime.recorder import FullPolicy, Recorder, check_folder, write_report
from sfms_robot.runtime.safety import Interrupt, signals_to
from sfms_robot.sources.registry import open_source, split_kind

logger = logging.getLogger(__name__)

FAST_LATENCY_S: Final = 0.010  # in virtual time a plan becomes visible this long after its last speaker frame

Document = Callable[[], Mapping[str, Any]]
Panel = Callable[[Document, Interrupt, HaltLatch, Callable[[float], None]], AbstractContextManager[object]]


# --- what is played on a head ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Programme:
    """What a head is to do: a person who is listened to, or a timeline that is played.

    Attributes:
        source, feed: the person, and who answers.
        duration_s: None for ever.
        timeline: None for that of plans.
        retargeter: None for the head's own.
        life: what the head does of itself; None for nothing.
        knobs, overlay, answers, halt: see `Parts`.
        observers: closed by whoever made them.
    """

    source: Source
    feed: PlanFeed
    duration_s: float | None
    timeline: Timeline | None = None
    retargeter: Retargeter | None = None
    life: HeadLife | None = None
    knobs: Callable[[], Any] | None = None
    overlay: Callable[[Floats, Doubles], Floats] | None = None
    answers: bool = False
    halt: HaltLatch = field(default_factory=HaltLatch)
    observers: Sequence[Observer] = ()


def run_log(opened: OpenHead) -> RunLog:
    """An empty one, for `drive_head`."""
    return RunLog(opened.motion.retargeter.joints, 1.0 / opened.rate_hz, opened.motion.audit)


def drive_head(
    opened: OpenHead, programme: Programme, interrupt: Interrupt, *, signals: bool = True, log: RunLog | None = None
) -> Drove:
    """Switch torque on, run the loop, come to rest, switch torque off. Blocks until then.

    An exception on the way is kept, not raised: the head is at rest and the report is still to be made. A drive that
    would end as done or interrupted ends as failed, by TorqueError, where torque could not be confirmed off.
    `signals`: Ctrl-C and the like ask `interrupt`; main thread only. `log`: is filled; for readers meanwhile.
    """
    motion = opened.motion
    parts = Parts(
        source=programme.source,
        feed=programme.feed,
        timeline=programme.timeline or motion.timeline,
        retargeter=programme.retargeter or motion.retargeter,
        limiter=motion.limiter,
        bus=opened.bus,
        observers=programme.observers,
        leads_s=motion.leads_s,
        rest_rad=motion.rest_rad,
        life=programme.life,
        knobs=programme.knobs,
        overlay=programme.overlay,
        answers=programme.answers,
        halt=programme.halt,
        holds=motion.holds,
        heat=motion.heat,
        ignored=frozenset(opened.options.without),
    )
    log = run_log(opened) if log is None else log
    duration_s = math.inf if programme.duration_s is None else programme.duration_s
    real = not opened.options.fast
    outcome, error = "failed", None
    watched = programme.halt.watched(opened.bus) if real else nullcontext()
    with signals_to(interrupt) if signals else nullcontext(), watched, realtime_priority(wanted=real) as priority:
        interrupt.arm(opened.bus)
        began_s = time.monotonic()
        try:
            outcome = drive(
                parts, opened.clock, log, rate_hz=opened.rate_hz, duration_s=duration_s, interrupted=interrupt
            )
        except KeyboardInterrupt:
            outcome = "interrupted"
            opened.bus.stop("release")  # a second Ctrl-C may have cut the first one short
        except Exception as failure:
            error = failure
            if not isinstance(failure, RobotError):
                logger.exception("the run ends by an error that nobody expected")
        elapsed_s = time.monotonic() - began_s if real else None
        log.torque_unconfirmed = opened.bus.statistics()["torque_unconfirmed"]
        if log.torque_unconfirmed and error is None:
            outcome, error = "failed", TorqueError(log.torque_unconfirmed)
        log.ended(opened.clock.now_s(), error)
    return Drove(outcome, log, elapsed_s, priority, error)


# --- a person, a listener, a head -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class RunOptions:
    """The flags of `sfms-robot run`; None where a flag has a default that depends on the others."""

    head: str = "face28"
    port: str = SIM
    listener: str = "sfms-small"
    audio: str = "default"
    face: str = "auto"
    agent_audio: str = "none"
    duration_s: float | None = None
    fast: bool = False
    seed: int = 0
    record: Path | None = None
    overwrite: bool = False
    dry_run: bool = False
    yes: bool = False
    intensity: tuple[str, ...] = ()
    style: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    halt_on: str | None = None
    status: str | None = None
    calmness: Calmness | None = None
    play: str | None = None
    fleet: str | None = None
    zenoh: Path | None = None
    engine: EngineName = "auto"
    packages: tuple[str, ...] = ()
    insecure: bool = False
    fleet_key: Path | None = None

    @property
    def router(self) -> Router:
        """Router of a fleet, or of a listener on another machine."""
        return Router(self.zenoh, self.insecure)

    @property
    def hears(self) -> str:
        """`audio`, where "default" is the microphone for servos that are not emulated here."""
        return "mic" if self.audio == "default" and self.port != SIM and not self.dry_run else self.audio

    def facts(self, head: Head) -> dict[str, str]:
        """What a recording says of the run."""
        rates = None if self.calmness is None else self.calmness.model_dump(exclude_none=True)
        return run_facts(head, self.listener, {**asdict(self), "audio": self.hears, "calmness": rates})

    @property
    def servos(self) -> HeadOptions:
        """The head and its servos."""
        return HeadOptions(self.head, self.port, self.fast, self.yes or self.dry_run, self.without)


def run(
    options: RunOptions,
    panel: Panel | None = None,
    *,
    source: Source | None = None,
    feed: PlanFeed | None = None,
    observers: Sequence[Observer] = (),
    knobs: LiveKnobs | None = None,
    overlay: Callable[[Floats, Doubles], Floats] | None = None,
    interrupt: Interrupt | None = None,
    halt: HaltLatch | None = None,
    more: Callable[[], Mapping[str, Any]] = dict,
    signals: bool = True,
) -> dict[str, Any]:
    """Listen until the duration is over or somebody interrupts. Returns the report.

    Blocks until then. What is cheap to check is checked first; the listener loads in its own process meanwhile. After
    torque came on nothing is raised any more: the report says `"exit": "failed"` and why, the head is at rest.

    Args:
        panel: from the status document, what ends, what halts the run and what turns the face up: shows it, and takes
            keys, while inside.
        source, feed: instead of those that the options name.
        knobs: instead of those that the options name.
        observers, overlay: see `Programme`.
        interrupt: asked to end the run from another thread.
        halt: closed and opened from other threads.
        more: what else the status and the report hold.

    Raises RobotError before torque came on.
    """
    head = prepare_head(options.servos)
    _check(options)
    limited = limitation(options.listener) if feed is None or isinstance(feed, ListenerProcess) else None
    if limited is not None:
        logger.warning("%s: %s", Path(options.listener).name, limited)
    interrupt, halt = interrupt or Interrupt(), halt or HaltLatch()
    facts = {"head": head.name, "port": options.port, "listener": Path(options.listener).name}
    with signals_to(interrupt) if signals else nullcontext(), ExitStack() as stack:  # until all is closed again
        _enter_halts(options, halt, signals, stack)
        server = _status_server(options, facts, stack)
        if feed is None and not options.dry_run:
            feed = _feed(options, stack)
        opening = _opening(options, stack) if source is None else _opened(source)
        opened = stack.enter_context(open_head(options.servos))
        person = opening.result()
        duration_s = person.duration_s if options.duration_s is None else options.duration_s
        if options.fast and duration_s is None:
            raise ConfigError("--fast without a recording never ends: give it a --duration")
        if feed is None:
            return {"version": 1, "head": opened.config.name, "port": options.port, "exit": "done", **_present(opened)}
        _make_ready(feed, person, opened)
        live = turned(opened.config, options.intensity, options.style) if knobs is None else knobs
        recorder = _recorder(options, opened.config, stack)
        log = run_log(opened)
        status = _status(options, {**facts, "duration_s": duration_s}, opened, log, person, feed, live, more)
        if panel is not None:
            stack.enter_context(panel(status.document, interrupt, halt, live.turn_all))
        tellers = [stack.enter_context(closing(RunTeller(outlet))) for outlet in person.outlets]
        if server is not None:
            server.begin(status.document)
        watchers = _watchers(options, status, FleetControls(halt, interrupt, live, getattr(feed, "calm", None)), stack)
        programme = Programme(
            person, feed, duration_s,
            life=HeadLife(opened.config.life, options.seed, opened.config.camera),
            knobs=lambda: live.now,
            overlay=overlay,
            answers=True,
            halt=halt,
            observers=[status, *watchers, *observers, *tellers, *([] if recorder is None else [recorder])],
        )  # fmt: skip
        drove = drive_head(opened, programme, interrupt, signals=False, log=log)
        status.ended(log.states[-1][1])
        report = _report(options, opened, drove, feed, person) | {"limitation": limited, **more()}
        if recorder is not None:
            recorder.close()
            report["recording"] = recorder.statistics()
    if options.record is not None:
        write_report(options.record, report)
    return report


def _check(options: RunOptions) -> None:
    """What cannot be had together, or not here, before anything is opened. Raises ConfigError."""
    if options.fleet is not None:
        fleet_name(options.fleet)
        session_config("call", options.router)
        fleet_key(options.fleet_key)
    elif options.fleet_key is not None:
        raise ConfigError(f"--fleet-key {options.fleet_key}: no fleet is joined (--fleet)")
    if options.fast and split_kind(options.hears)[0] == "mic":
        raise ConfigError(f"--audio {options.hears}: what a microphone hears takes real time, --fast has none")
    if options.fast and options.play is not None:
        raise ConfigError(f"--play {options.play}: what is heard of a loudspeaker takes real time, --fast has none")
    if options.fast and options.listener.startswith(REMOTE):
        raise ConfigError(f"--listener {options.listener}: another machine takes real time, --fast has none")
    if options.record is not None:
        check_folder(options.record, options.overwrite)


def _enter_halts(options: RunOptions, halt: HaltLatch, signals: bool, stack: ExitStack) -> None:
    """Who may halt the head from outside: a signal, a switch."""
    if signals:
        stack.enter_context(halt_signals(halt))
    if options.halt_on is not None:
        stack.enter_context(halt_switch(options.halt_on, halt))


def _status_server(options: RunOptions, facts: Mapping[str, Any], stack: ExitStack) -> LoopbackServer | None:
    """Serves that a run begins; a port that is taken is found before a listener is loaded."""
    if options.status is None:
        return None
    server = stack.enter_context(closing(status_server(options.status)))
    server.begin(RunStatus((), facts).document)
    logger.warning("status: %s%s", server.url, server.note)
    return server


def _make_ready(feed: PlanFeed, person: Source, opened: OpenHead) -> None:
    """Blocks until a listener of another machine is loaded; one of this machine gets the hop that the head needs."""
    if isinstance(feed, NamedFeed):
        feed.wait_loaded()
    if isinstance(feed, ListenerProcess):
        tick_s = 1.0 / opened.rate_hz
        feed.choose_hop_by(lambda: person.latency_s, float(opened.motion.leads_s.max()) + tick_s, tick_s)


def _status(
    options: RunOptions, facts: Mapping[str, Any], opened: OpenHead, log: RunLog, person: Source, feed: PlanFeed,
    live: LiveKnobs, more: Callable[[], Mapping[str, Any]],
) -> RunStatus:  # fmt: skip
    """How it goes, for whoever asks meanwhile."""

    def figures() -> dict[str, Any]:
        return {
            **figures_so_far(log, opened.rate_hz, real=not options.fast),
            "source": dict(person.statistics()),
            "listener_state": dict(feed.statistics()),
            "intensity": live.values["intensity"],
            **more(),
        }

    return RunStatus(list(opened.config.joints), facts, figures)


def _report(options: RunOptions, opened: OpenHead, drove: Drove, feed: PlanFeed, person: Source) -> dict[str, Any]:
    report = run_report(opened, drove, feed, Path(options.listener).name, options.seed)
    report |= {"source": dict(person.statistics())}
    return report | {"wire": opened.digests()} if options.fast else report


def _watchers(options: RunOptions, status: RunStatus, controls: FleetControls, stack: ExitStack) -> list[Observer]:
    """Who else is told how it goes: a service manager, where there is one, and the fleet."""
    watchers: list[Observer] = []
    manager = ServiceManager()
    if manager.wanted:
        watchers.append(NotifyingObserver(manager))
    if options.fleet is not None:
        head = FleetHead(options.fleet, status.document, controls, options.router, fleet_key(options.fleet_key))
        stack.callback(head.close)
        watchers.append(head)
    return watchers


def _opened(source: Source) -> Future[Source]:
    """One that need not be opened."""
    opened: Future[Source] = Future()
    opened.set_result(source)
    return opened


def _opening(options: RunOptions, stack: ExitStack) -> Future[Source]:
    """The person, being opened in a thread: a microphone takes a second, and so does the head."""
    worker = ThreadPoolExecutor(1, "source")
    opening = worker.submit(
        open_source, options.hears, options.face, options.duration_s, agent_audio=options.agent_audio,
        play=options.play,
    )  # fmt: skip
    worker.shutdown(wait=False)
    stack.callback(lambda: None if opening.exception() else opening.result().close())
    return opening


def _feed(options: RunOptions, stack: ExitStack) -> PlanFeed:
    """Inline in virtual time, so that one seed is one run; else in a process of its own, which loads from now on."""
    listener_folder(options.listener)
    feed: PlanFeed
    if options.fast:
        from sfms_robot.listeners.registry import engine_name, load_listener  # networks: only here in this process

        listener = load_listener(options.listener, calmness=options.calmness, engine=options.engine, threads=1)
        feed = InlineFeed(listener, options.seed, FAST_LATENCY_S, engine_name(listener))
    else:
        feed = open_feed(options.listener, options.seed, options.calmness, options.router, options.engine)
    stack.callback(feed.close)
    return feed


def _recorder(options: RunOptions, head: Head, stack: ExitStack) -> Recorder | None:
    if options.record is None:
        return None
    when_full: FullPolicy = "wait" if options.fast else "drop"
    recorder = Recorder(options.record, list(head.joints), when_full=when_full, about=options.facts(head))
    return stack.enter_context(closing(recorder))


def _present(opened: OpenHead) -> dict[str, Any]:
    """What the servos say of themselves, torque untouched."""
    readings: Mapping[str, Any] = opened.bus.poll(opened.clock.now_s())
    return {"readings": {name: {"position_rad": r.position_rad, "fault": r.fault} for name, r in readings.items()}}
