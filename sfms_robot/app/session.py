"""Composition root: concrete parts are put together here, for every command that moves a head.

    open_head       the servos, and the parts between a plan and them (`app.open_head`); torque is untouched
    drive_head      torque on, the loop, rest, torque off, and the report
    run             both around a listener and a person: `sfms-robot run`, and `Robot`

Whatever happens after torque came on, the loop brings the head to rest, and there is a report.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, Final

from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.app.listen.report import (
    OutletObserver,
    figures_so_far,
    limitation,
    run_facts,
    run_report,
)
from sfms_robot.app.open_head import OpenHead, open_head, prepare_head, run_log
from sfms_robot.app.options import RunOptions, begin_listening
from sfms_robot.data import Report
from sfms_robot.endpoint import leads_here
from sfms_robot.errors import NOTE, ConfigError, RobotError, TorqueError
from sfms_robot.listeners.process import ListenerProcess
from sfms_robot.network import session_config
from sfms_robot.plugins import REMOTE, listener_folder
from sfms_robot.ports import Document, Observer, Output, PlanFeed, Source, Timeline
from sfms_robot.processes import realtime_priority
from sfms_robot.retarget.spontaneous import HeadLife
from sfms_robot.runtime.clock import InlineFeed
from sfms_robot.runtime.halt import halt_signals, halt_switch
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.loop import Parts, drive
from sfms_robot.runtime.observers import NotifyingObserver, RunStatus, ServiceManager
from sfms_robot.runtime.planned_events import EventWatch
from sfms_robot.runtime.recorder import Recorder, check_folder, write_report
from sfms_robot.runtime.safety import Interrupt, signals_to
from sfms_robot.sources.registry import open_source, split_kind

logger = logging.getLogger(__name__)

LOOK_S: Final = 2.0  # duration of a look at a point that the peer of an output requests

Panel = Callable[[RunControls], AbstractContextManager[object]]


# --- any motion on a head -------------------------------------------------------------------------------------------


def run_parts(opened: OpenHead, source: Source, feed: PlanFeed, **more: Any) -> Parts:
    """Return the parts of a run on an open head with a person and a listener; `more` replaces parts of the head."""
    own = {"bus": opened.bus, "observers": (), "ignored": frozenset(opened.options.without)}
    return Parts(source=source, feed=feed, **vars(opened.motion) | own | more)


def drive_head(
    opened: OpenHead,
    parts: Parts,
    interrupt: Interrupt,
    *,
    duration_s: float | None = None,
    log: RunLog | None = None,
) -> Report:
    """Switch torque on, run the loop, come to rest, switch torque off, and report. Blocks until then.

    An exception meanwhile is reported, not raised, and the head is at rest. A drive that would end as done or
    interrupted ends as failed, with TorqueError, if torque could not be confirmed off.

    Args:
        duration_s: longest duration of the drive; None: no limit.
        log: is filled; other threads may read it meanwhile.
    """
    log = log or run_log(opened.config, opened.rate_hz)
    real = not opened.options.fast
    outcome, error = "failed", None
    watched = parts.halt.watched(opened.bus) if real else nullcontext()
    with watched, realtime_priority(wanted=real) as priority:
        interrupt.arm(opened.bus)
        began_s = time.monotonic()
        try:
            outcome = drive(
                parts,
                opened.clock,
                log,
                rate_hz=opened.rate_hz,
                duration_s=math.inf if duration_s is None else duration_s,
                interrupted=interrupt,
            )
        except KeyboardInterrupt:
            outcome = "interrupted"
            opened.bus.stop("release")  # a second Ctrl-C may have cut the first one short
        except Exception as failure:
            error = failure
            if not isinstance(failure, RobotError):
                logger.exception("internal error: the run ends")
        elapsed_s = time.monotonic() - began_s if real else None
        log.torque_unconfirmed = opened.bus.statistics()["torque_unconfirmed"]
        if log.torque_unconfirmed and error is None:
            outcome, error = "failed", TorqueError(log.torque_unconfirmed)
        log.ended(opened.clock.now_s(), error)
    return run_report(opened, log, parts.feed, outcome, elapsed_s, error) | {"priority": priority}


# --- a person, a listener, a head -----------------------------------------------------------------------------------


def run(
    options: RunOptions,
    panel: Panel | None = None,
    *,
    source: Source | None = None,
    feed: PlanFeed | None = None,
    observers: Sequence[Observer] = (),
    timeline: Timeline | None = None,
    controls: RunControls | None = None,
    more: Document = dict,
    signals: bool = True,
) -> Report:
    """Listen until the duration is over or the run is interrupted. Blocks until then, and returns the report.

    The listener loads in its own process while the head is opened. After torque came on nothing is raised any more:
    the report has `"exit": "failed"` and the error, and the head is at rest.

    Args:
        panel: returns a context manager for the controls, which shows the run and reads keys.
        source, feed, controls: used instead of those that the options name.
        timeline: played instead of the listener's plans; nothing is added to it.
        observers: see `Parts`; the caller closes them.
        more: returns further entries of the status and of the report.

    Raises RobotError before torque came on.
    """
    head = prepare_head(options)
    _check(options)
    limited = limitation(options.listener) if feed is None or isinstance(feed, ListenerProcess) else None
    if limited is not None:
        logger.warning("%s: %s", options.listener_name, limited)
    controls = controls or RunControls(head, options)
    interrupt, halt, knobs = controls.interrupt, controls.halt, controls.knobs
    facts = {"head": head.name, "port": options.port, "listener": options.listener_name}
    with ExitStack() as stack:  # closes everything at the end
        if signals:
            stack.enter_context(signals_to(interrupt))
            stack.enter_context(halt_signals(halt))
        if options.halt_on is not None:
            stack.enter_context(halt_switch(options.halt_on, halt))
        sinks = _outputs(options, controls, stack)
        server = None
        if options.status is not None:  # a port in use is detected before a listener is loaded
            from sfms_robot.viewer.web_server import status_server  # importing a web server takes 50 ms

            server = stack.enter_context(closing(status_server(options.status)))
            logger.log(NOTE, "status: %s%s", server.url, server.note)
            server.begin(RunStatus((), facts).document)
        opened, person, feed = _open(options, controls, source, feed, stack)
        if feed is None:
            return {"version": 1, **facts, "exit": "done", "readings": opened.readings()}
        log = run_log(opened.config, opened.rate_hz)
        joints = log.joints
        from sfms_robot.outputs.sender import Outputs

        outputs = stack.enter_context(closing(Outputs(sinks, joints)))
        duration_s = person.duration_s if options.duration_s is None else options.duration_s
        figures = partial(figures_so_far, opened, log, person, feed, knobs, outputs, more)
        status = RunStatus(joints, {**facts, "duration_s": duration_s}, figures)
        controls.document = status.document
        watchers = [status, *observers]

        def watch(observer: Observer) -> None:
            watchers.append(stack.enter_context(closing(observer)))

        if sinks:
            log.reported = outputs.names
            watchers.append(outputs)
            watch(EventWatch(outputs.event))
        recorder = None
        if options.record is not None:
            recorder = Recorder(
                options.record,
                joints,
                run_facts(opened.config, options),
                wait=options.fast,
                record_format=options.record_format,
            )
            watch(recorder)
        if panel is not None:
            stack.enter_context(panel(controls))
        for outlet in person.outlets:
            watch(OutletObserver(outlet))
        if server is not None:
            server.begin(status.document)
        if (manager := ServiceManager()).wanted:
            watchers.append(NotifyingObserver(manager))
        if options.fleet is not None:
            from sfms_robot.app.fleet import FleetControls, FleetHead, fleet_key

            watch(FleetHead(FleetControls(controls, options.fleet, fleet_key(options.fleet_key)), options.router))
        played: Report = {"timeline": timeline}
        if timeline is None:
            played = {"life": HeadLife(head.life, options.seed, head.camera), "answers": True}
        parts = run_parts(
            opened, person, feed, knobs=lambda: knobs.now, overlay=controls.puppet.overlay, halt=halt,
            observers=watchers, missing=lambda: outputs.missing, **played,
        )  # fmt: skip
        report = drive_head(opened, parts, interrupt, duration_s=duration_s, log=log)
        status.ended(log.states[-1][1])
        outputs.close()
        report |= {"listener": facts["listener"], "seed": options.seed, "source": dict(person.statistics())}
        report |= {"limitation": limited, **more(), "outputs": outputs.statistics()}
        report |= {"wire": opened.digests()} if options.fast else {}
        if recorder is not None:
            recorder.close()
            report["recording"] = recorder.statistics()
    if options.record is not None:
        write_report(options.record, report)
    return report


def _check(options: RunOptions) -> None:
    """Raise ConfigError, before anything is opened, for options that exclude one another or cannot work here."""
    if options.fleet is not None:
        from sfms_robot.app.fleet import fleet_key, fleet_name  # its messages are pydantic models, 30 ms to import

        fleet_name(options.fleet)
        session_config("call", options.router)
        fleet_key(options.fleet_key)
    elif options.fleet_key is not None:
        raise ConfigError(f"--fleet-key {options.fleet_key}: no fleet is joined (--fleet)")
    for flag, value, excluded, why in (
        ("audio", options.hears, split_kind(options.hears)[0] == "mic", "what a microphone hears"),
        ("play", options.play, options.play is not None, "what a loudspeaker plays"),
        ("listener", options.listener, options.listener.startswith(REMOTE), "another machine"),
        ("output", " ".join(options.outputs), bool(options.outputs), "what is shown elsewhere"),
    ):
        if options.fast and excluded:
            raise ConfigError(f"--{flag} {value}: {why} takes real time, so --fast is not possible")
    if options.record is not None:
        check_folder(options.record, options.overwrite)
    elif options.record_format != "json":
        raise ConfigError(f"--record-format {options.record_format}: nothing is recorded (--record DIR)")


def _outputs(options: RunOptions, controls: RunControls, stack: ExitStack) -> list[Output]:
    """Return the outputs, not connected yet; none in a dry run. Raises ConfigError, PortError."""
    if not options.outputs or options.dry_run:
        return []
    from sfms_robot.outputs.registry import open_outputs

    sinks = open_outputs(options.outputs, router=options.router)
    for sink in sinks:
        stack.callback(sink.close)
        sink.look_at = partial(controls.puppet.look_at, seconds=LOOK_S)
    kind, argument = split_kind(options.face)
    if kind in ("vmc", "live-link"):
        from sfms_robot.sources.live_face import parse_endpoint, parse_face_argument

        port = parse_endpoint(kind, parse_face_argument(kind, argument)[0])[1]
        for sink in sinks:
            if sink.kind.startswith(("vmc", "live-link")) and leads_here(sink.peer, port):
                raise ConfigError(
                    f"--output {sink.kind}:{sink.peer}: --face {options.face} reads what is sent there: the head "
                    "would listen to itself (choose another port)"
                )
    return sinks


def _open(
    options: RunOptions, controls: RunControls, source: Source | None, feed: PlanFeed | None, stack: ExitStack
) -> tuple[OpenHead, Source, PlanFeed | None]:
    """Open the head, the person and the listener in parallel; a dry run has no listener. Blocks until all are open."""
    if feed is None and not options.dry_run:
        feed = _feed(replace(options, calmness=controls.calmness), stack)
    controls.set_rates = getattr(feed, "calm", None)
    if source is None:  # in a thread: a microphone takes a second to open, and so does the head
        worker = ThreadPoolExecutor(1, "source")
        opening = worker.submit(
            open_source,
            options.hears,
            options.face,
            options.duration_s,
            agent_audio=options.agent_audio,
            play=options.play,
            agent=controls.speech,
            visitor=controls.visitor,
            router=options.router,
        )
        worker.shutdown(wait=False)
        stack.callback(lambda: None if opening.exception() else opening.result().close())
    opened = stack.enter_context(open_head(options))
    person = opening.result() if source is None else source
    if options.fast and options.duration_s is None and person.duration_s is None:
        raise ConfigError("--fast without a recording never ends: give it a --duration")
    if (wait_loaded := getattr(feed, "wait_loaded", None)) is not None:
        wait_loaded()
    if isinstance(feed, ListenerProcess):  # a listener of this machine gets the hop that the head needs
        tick_s = 1.0 / opened.rate_hz
        feed.choose_hop_by(lambda: person.latency_s, float(opened.motion.leads_s.max(initial=0.0)) + tick_s, tick_s)
    return opened, person, feed


def _feed(options: RunOptions, stack: ExitStack) -> PlanFeed:
    """Return the listener: inline in virtual time, for reproducible runs; else in its own process, which loads now."""
    listener_folder(options.listener)
    feed: PlanFeed
    if options.fast:
        from sfms_robot.listeners.registry import engine_name, load_listener  # networks are imported only here

        listener = load_listener(options.listener, calmness=options.calmness, engine=options.engine, threads=1)
        feed = InlineFeed(listener, options.seed, engine_name(listener))
    else:
        feed = begin_listening(options)
    stack.callback(feed.close)
    return feed
