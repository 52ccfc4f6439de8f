"""Composition root of `sfms-robot run`: options -> parts -> loop -> report.

Everything that can be wrong is looked at before a port is opened: head, maps, recording, weights. Then the port,
then torque. Whatever happens after torque-on, the loop brings the head to rest; the exit stack closes what is open.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sfms_robot.app.calibrated_head import unit_head
from sfms_robot.app.listen.knobs import turned
from sfms_robot.app.listen.limitation import limitation
from sfms_robot.app.listen.report import run_report
from sfms_robot.app.session import SIM, Motion, Opened, build_bus, build_motion, devices, on_boards, plugged_in
from sfms_robot.config import Head, find
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import ConfigError
from sfms_robot.listeners.registry import load_listener, one_thread
from sfms_robot.listeners.remote import RemoteFeed
from sfms_robot.ports import Bus, Clock, Observer, PlanFeed
from sfms_robot.retarget.life import Life
from sfms_robot.runtime.clock import RealClock, VirtualClock
from sfms_robot.runtime.feed import InlineFeed
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.loop import Parts, drive
from sfms_robot.runtime.recorder import FullPolicy, Recorder, write_report
from sfms_robot.runtime.safety import interrupt_flag, realtime_priority
from sfms_robot.sources.registry import open_source

logger = logging.getLogger(__name__)

FAST_LATENCY_S = 0.010  # in virtual time a plan becomes visible this long after its last speaker frame


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
    dry_run: bool = False
    yes: bool = False
    intensity: tuple[str, ...] = ()
    style: tuple[str, ...] = ()


def run_head(options: RunOptions, progress: Callable[[float | None], Observer] | None = None) -> dict[str, Any]:
    """Run until the duration is over or somebody interrupts. Returns the report.

    `progress` makes an observer that shows a run of that many seconds. Raises RobotError, the head at rest.
    """
    if options.fast and options.port != SIM:
        raise ConfigError(f"--port {options.port!r}: --fast needs emulated servos, time is virtual (sim)")
    head = unit_head(options.head, options.port)
    where = {} if options.port == SIM else devices(head, options.port)
    if options.port != SIM and not options.dry_run:
        _confirmed(head, options.yes)
    rate_hz = max(bus.rate_hz for bus in head.buses.values())
    motion = build_motion(head, rate_hz)
    knobs = turned(motion.retargeter, options.intensity, options.style)
    weights = find("listeners", options.listener, "config.yaml")
    limited = limitation(options.listener)
    if limited is not None:
        logger.warning("%s: %s", weights.name, limited)
    source = open_source(options.audio, options.face, options.duration_s, agent_audio=options.agent_audio)
    if options.fast and source.duration_s is None:
        raise ConfigError("--fast without a recording never ends: give it a --duration")
    clock = VirtualClock() if options.fast else RealClock()
    with ExitStack() as stack:
        feed = _feed(weights, options)
        stack.callback(feed.close)
        opened: Opened = dict(where)
        if options.port == SIM:
            chains = plugged_in(options.head, head)
            opened = {name: stack.enter_context(launch(chains[name], options.fast)) for name in chains}
        bus = build_bus(head, opened, clock, confirmed=options.yes)
        stack.callback(bus.close)
        bus.connect()
        if options.dry_run:
            return {"version": 1, "head": head.name, "port": options.port, "exit": "done", **_present(bus, clock)}
        observers = _observers(options, head, source.duration_s, progress, stack)
        parts = Parts(
            source, feed, motion.timeline, motion.retargeter, motion.limiter, bus, observers,
            motion.leads_s, motion.rest_rad, Life(head.life, options.seed), lambda: knobs,
        )  # fmt: skip
        report = _drive(options, parts, motion, clock, rate_hz, weights.name, head.name)
        report["limitation"] = limited
        if options.fast:
            report["wire"] = {name: _digest(chain) for name, chain in opened.items() if isinstance(chain, Chain)}
    if options.record is not None:
        write_report(options.record, report)
    return report


def _confirmed(head: Head, yes: bool) -> None:
    """Hobby servos cannot come on without a jump. Raises ConfigError unless somebody said that this is understood."""
    if (jumping := on_boards(head)) and not yes:
        raise ConfigError(
            f"head {head.name!r}: hobby servos report no position, and each jumps to rest when it comes on "
            f"({', '.join(jumping)}); keep clear, and confirm it with --yes"
        )


def _drive(
    options: RunOptions, parts: Parts, motion: Motion, clock: Clock, rate_hz: float, listener: str, head: str
) -> dict[str, Any]:
    log = RunLog(motion.retargeter.joints, 1.0 / rate_hz, motion.audit)
    duration_s = parts.source.duration_s if parts.source.duration_s is not None else math.inf
    with interrupt_flag() as interrupted, realtime_priority(wanted=not options.fast) as priority:
        began_s = time.monotonic()
        outcome = drive(parts, clock, log, rate_hz=rate_hz, duration_s=duration_s, interrupted=interrupted)
        elapsed_s = None if options.fast else time.monotonic() - began_s
    return run_report(
        log,
        parts.bus,
        parts.feed,
        head=head,
        listener=listener,
        port=options.port,
        seed=options.seed,
        outcome=outcome,
        rate_hz=rate_hz,
        elapsed_s=elapsed_s,
        priority=priority,
    )


def _digest(chain: Chain) -> dict[str, Any]:
    """What went over an emulated wire: two runs that say the same here sent the same bytes."""
    sha256, count = chain.digest()
    return {"sha256": sha256, "bytes": count}


def _feed(weights: Path, options: RunOptions) -> PlanFeed:
    """Inline in virtual time, so that one seed is one run; else in a process of its own."""
    if options.fast:
        one_thread()
        return InlineFeed(load_listener(weights), options.seed, FAST_LATENCY_S)
    return RemoteFeed(partial(load_listener, weights), options.seed)


def _observers(
    options: RunOptions,
    head: Head,
    duration_s: float | None,
    progress: Callable[[float | None], Observer] | None,
    stack: ExitStack,
) -> list[Observer]:
    observers: list[Observer] = []
    if options.record is not None:
        about = {
            "head": head.name,
            "listener": Path(options.listener).name,
            "seed": str(options.seed),
            "audio": Path(options.audio).name,
        }
        when_full: FullPolicy = "wait" if options.fast else "drop"
        observers.append(Recorder(options.record, list(head.joints), when_full=when_full, about=about))
    if progress is not None:
        observers.append(progress(duration_s))
    for observer in observers:
        stack.callback(observer.close)
    return observers


def _present(bus: Bus, clock: Clock) -> dict[str, Any]:
    """What the servos say of themselves, torque untouched."""
    readings = bus.poll(clock.now_s())
    return {"readings": {name: {"position_rad": r.position_rad, "fault": r.fault} for name, r in readings.items()}}
