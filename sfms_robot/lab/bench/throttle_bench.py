"""`bench throttle`: a head that listens on a quarter of one core, compared with the same on all of this machine.

    free    the default head listens to a recorded person, in real time
    held    the same, with the run and its listener limited to `SHARE` of one core

The process and all its descendants stay on one core and run for a share of every `_SLICE_S`; SIGSTOP and SIGCONT stop
them for the rest. A slower computer is evenly slow, while here a tick can be late by up to a slice only because its
process is stopped. A process that was late gets no extra time, so the share is never exceeded. Linux only.

The servos are emulated outside of the held processes, since real servos are not slower either, and are observed there.
On a computer of any speed no command outside the limits may reach the servos, and the states have to be those of
docs/safety.md. Each transition that its table lacks, each silent or late listener that is not named, each missing
reason and torque that is left on adds one line and makes the exit code 1.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.app.wiring import calibration_of, emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.frames import Plan
from sfms_robot.lab.bench.live_bench import patient_head
from sfms_robot.lab.bench.measure import (
    HEAD,
    LISTENER,
    BenchResult,
    Say,
    children_of,
    package_environment,
    result_of,
    row,
)
from sfms_robot.listeners.thread import HUNG_S, LATE_S
from sfms_robot.ports import Observer, Tick
from sfms_robot.processes import realtime_priority
from sfms_robot.runtime.safety import EASE_S
from sfms_robot.runtime.states import ARROWS
from sfms_robot.sources.registry import DEFAULT_SPEAKER

Process = subprocess.Popen[bytes]
Change = tuple[float, str, tuple[str, ...]]  # time_s, state, why

SHARE: Final = 0.25
_RUN_S: Final = 20.0
_TOLERANCE_S: Final = 0.5  # for the times of states: the loop checks them only while it runs
_LOOK_S: Final = 0.5  # between two readings of the servos
_LIMIT_S: Final = 120.0  # longest time of a run with its start
_OUTSIDE_S: Final = 2.0  # additional time to ease in, for joints found outside their range
_SLICE_S: Final = 0.008  # not a multiple of a tick, so that ticks fall on different places of a slice
_PROCESSES_S: Final = 0.2  # between two searches for new processes
OUT, SAID = "out", "said"  # files of stdout and stderr
_CHILD: Final = "from sfms_robot.lab.bench.throttle_bench import observed_run; observed_run()"


@dataclass(frozen=True, kw_only=True)
class ObservedRun:
    """A run and the observations of its servos.

    Attributes:
        report: The report of the run.
        plans_s: Arrival of each plan, and time of its last frame, in loop time.
        looks, outside: Readings of servos, and the number of them with a goal outside the joint's range.
        torque: Servos that have torque after the run.
    """

    report: Mapping[str, Any]
    plans_s: Sequence[tuple[float, float]]
    looks: int
    outside: int
    torque: Sequence[int]

    def figures(self) -> dict[str, float]:
        """Return the share of the due ticks that came in time [%], ticks a second, and plans a second."""
        tick = self.report["tick"]
        punctual = 1 - float(tick["late"]) / float(self.report["ticks"])
        rate_hz = float(tick["achieved_hz"])
        in_time = 100 * punctual * min(1.0, rate_hz / float(tick["target_hz"]))
        return {"in_time": in_time, "rate": rate_hz, "plans": len(self.plans_s) / self.report["duration_s"]}


def measure(say: Say) -> BenchResult:
    """Measure both runs; takes a minute.

    Raises ConfigError if processes cannot be held here, BusError if a run fails.
    """
    check()
    say(f"{_RUN_S:g} s on all of this machine")
    free = _observed(None)
    say(f"{_RUN_S:g} s on {SHARE:g} of one core")
    held = _observed(SHARE)
    problems = [f"{name}: {each}" for name, seen in (("all", free), ("held", held)) for each in problems_of(seen)]
    peers, units = free.figures(), {"in_time": "% of ticks", "rate": "ticks a second", "plans": "plans a second"}
    rows = {
        f"throttle.{name}": row([value], [peers[name]], units[name], "the same run on all cores")
        for name, value in held.figures().items()
    }
    seconds = held.report["states"]["seconds"]
    states = {name: round(100 * of_s / sum(seconds.values()), 1) for name, of_s in seconds.items()}
    lines = [f"states on {SHARE:g} of one core, % of the time: {states}"]
    lines += problems or ["commands inside limits, states as docs/safety.md says"]
    return BenchResult.of_rows(rows, lines, passed=not problems, share=SHARE, problems=problems, states=states)


# --- problems -------------------------------------------------------------------------------------------------------


def problems_of(seen: ObservedRun) -> list[str]:
    """Return one line for each deviation from docs/safety.md."""
    report = seen.report
    found = [f"the run ended by itself: {report['exit']} {report['error'] or ''}"] if report["exit"] != "done" else []
    if report["limits"]["violations"]:
        found.append(f"{report['limits']['violations']} commands outside limits")
    if seen.outside:
        found.append(f"{seen.outside} of {seen.looks} looks at a servo found a goal outside its joint's range")
    if seen.torque:
        found.append(f"torque is left on: servos {', '.join(map(str, seen.torque))}")
    changes = [(each["time_s"], each["state"], tuple(each["why"])) for each in report["states"]["changes"]]
    return found + state_problems(changes, seen.plans_s)


def state_problems(changes: Sequence[Change], plans_s: Sequence[tuple[float, float]]) -> list[str]:
    """Return one line for each state, transition or reason of a run that the table of docs/safety.md lacks.

    Args:
        changes: State changes, in order.
        plans_s: Arrival of each plan, and time of its last frame.
    """
    found = []
    for (_, before, _), (at_s, after, _) in pairwise(changes):
        if before != after and (before, after) not in ARROWS:
            found.append(f"{before} to {after} at {at_s:.2f} s is not a transition of the table")
    for at_s, name, why in changes:
        if bool(why) != (name in ("degraded", "halted", "fault")):
            found.append(f"{name} at {at_s:.2f} s has the reason {why or 'none'}")
    if [name for _, name, _ in changes][-2:] != ["stopping", "stopped"]:
        found.append(f"it ends {changes[-1][1]}")
    easing_s = EASE_S + _OUTSIDE_S + _TOLERANCE_S
    if len(changes) > 1 and changes[0][1] == "starting" and changes[1][0] - changes[0][0] > easing_s:
        found.append(f"starting for {changes[1][0] - changes[0][0]:.1f} s, {easing_s:g} at most")
    ends_s = [at_s for at_s, _, _ in changes[1:]] + [float("inf")]
    over_s = [at_s for at_s, name, _ in changes if name in ("stopping", "stopped", "fault")][:1]
    in_time_s = [came_s for place, (came_s, last_s) in enumerate(plans_s) if not place or came_s <= last_s]
    for since_s, until_s in pairwise([*in_time_s, *over_s]):
        # A late plan shows only on its arrival that the listener is late, so the limit is the sum of both times.
        if until_s - since_s > HUNG_S + LATE_S + _TOLERANCE_S and not any(
            "listener" in why and at_s <= until_s and end_s >= since_s
            for (at_s, _, why), end_s in zip(changes, ends_s, strict=True)
        ):
            found.append(f"no plan in time from {since_s:.2f} to {until_s:.2f} s, and the listener is not named")
    return found


# --- a run ----------------------------------------------------------------------------------------------------------


def _observed(share: float | None) -> ObservedRun:
    """Start a run, observe its servos, and return the observations. Raises BusError if the run fails."""
    with TemporaryDirectory() as name, launch(emulated(load_head(HEAD))["main"]) as chain:
        folder, goals = Path(name), _Goals(chain)
        words = ["-P", "-c", _CHILD, json.dumps({"head": str(patient_head(folder)), "port": chain.device})]
        with held(words, share, folder, package_environment()) as process:
            ends_s = time.monotonic() + _LIMIT_S
            while process.poll() is None:
                if time.monotonic() > ends_s:
                    raise BusError(f"bench throttle: the run has not ended after {_LIMIT_S:g} s")
                goals.look()
                time.sleep(_LOOK_S)
        printed, errors = ((folder / file).read_text(encoding="utf-8") for file in (OUT, SAID))
        found = result_of(process.returncode, errors, printed, "throttle")
        torque = [servo.id for servo in chain.servos if chain.state(servo.id)["torque"]]
    return ObservedRun(**found, looks=goals.looks, outside=goals.outside, torque=torque)


class _Goals:
    """A counter of goals outside the joints' ranges, read from the emulated servos without the bus."""

    def __init__(self, chain: Chain) -> None:
        joints = load_head(HEAD).joints
        ticks = calibration_of(joints)
        self._chain = chain
        self._ranges = []
        for joint, low, high in zip(joints.values(), ticks.low_ticks, ticks.high_ticks, strict=True):
            found = round(chain.state(joint.id)["position"])  # a joint found outside its range moves in from there
            self._ranges.append((joint.id, min(low, found), max(high, found)))
        self.looks = self.outside = 0

    def look(self) -> None:
        for servo, low, high in self._ranges:
            state = self._chain.state(servo)
            if state["torque"] and state["goal"] is not None:
                self.looks += 1
                self.outside += not low <= state["goal"] <= high


def observed_run() -> None:
    """Run a session in the child process with the options of the first argument (JSON); print report and plan times."""
    plans = _Plans()
    options = RunOptions(listener=LISTENER, audio=DEFAULT_SPEAKER, duration_s=_RUN_S, **json.loads(sys.argv[1]))
    report = run(options, observers=[plans])
    sys.stdout.write(json.dumps({"report": report, "plans_s": plans.came_s}) + "\n")


class _Plans(Observer):
    """An observer of the arrival times of plans, and of the times of their last frames."""

    def __init__(self) -> None:
        self.came_s: list[tuple[float, float]] = []
        self._now_s = 0.0

    def tick(self, seen: Tick) -> None:
        self._now_s = seen.time_s

    def planned(self, plan: Plan) -> None:
        self.came_s.append((round(self._now_s, 3), round(float(plan.times_s[-1]), 3)))


# --- processes that are held ----------------------------------------------------------------------------------------


def check() -> None:
    """Raise ConfigError if processes cannot be held here."""
    if not Path("/proc/self/task").is_dir() or not hasattr(os, "sched_setaffinity"):
        raise ConfigError("bench throttle: holding processes to a share of a core takes Linux (/proc, SIGSTOP)")
    if len(os.sched_getaffinity(0)) < 2:
        raise ConfigError("bench throttle: takes two cores, one for the run, one for this program and the servos")


@contextmanager
def _on_cores(cores: set[int]) -> Iterator[None]:
    """Keep this thread, and everything that it starts, on these cores inside the context."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def processes_of(pid: int) -> list[int]:
    """Return a process and all its running descendants."""
    found, ahead = [], [pid]
    while ahead:
        one = ahead.pop()
        found.append(one)
        with suppress(OSError):
            ahead += children_of(one)
    return found


@contextmanager
def held(
    arguments: Sequence[str], share: float | None, folder: Path, environment: Mapping[str, str]
) -> Iterator[Process]:
    """Run `sys.executable ARGUMENTS`, limited with all its descendants to a share of one core; kill it on exit.

    Args:
        arguments: Arguments of the command.
        share: Share of a core; None: no limit.
        folder: Folder of the files `OUT` (stdout) and `SAID` (stderr) with the output of the command.
        environment: Environment of the command.
    """
    cores = os.sched_getaffinity(0)
    first = {min(cores)}
    with (
        _on_cores(cores if share is None else first),
        (folder / OUT).open("wb") as out,
        (folder / SAID).open("wb") as said,
    ):
        process = subprocess.Popen(
            [sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=out, stderr=said, env=environment
        )
    over = threading.Event()
    thread = threading.Thread(target=_hold, args=(process, share or 1.0, cores - first, over), daemon=True)
    if share is not None:
        thread.start()
    try:
        yield process
    finally:
        over.set()
        if share is not None:
            thread.join()
        process.kill()
        process.wait()


def _hold(process: Process, share: float, cores: set[int], over: threading.Event) -> None:
    """Stop and continue a process and its descendants in slices until `over` is set or it ends; leave them running."""
    pids, looked_s, begins_s = [process.pid], 0.0, time.monotonic()

    def send(number: signal.Signals) -> None:
        for pid in pids:
            with suppress(OSError):
                os.kill(pid, number)

    with _on_cores(cores), realtime_priority():
        while not over.is_set() and process.poll() is None:
            send(signal.SIGCONT)
            time.sleep(share * _SLICE_S)
            send(signal.SIGSTOP)
            if (now_s := time.monotonic()) - looked_s >= _PROCESSES_S:
                pids, looked_s = processes_of(process.pid), now_s
            begins_s = max(begins_s + _SLICE_S, now_s)
            time.sleep(max(0.0, begins_s - time.monotonic()))
        send(signal.SIGCONT)
