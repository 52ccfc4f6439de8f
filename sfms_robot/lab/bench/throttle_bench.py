"""`bench throttle`: a head that listens on a quarter of one core, beside the same on all of this machine.

    free    the default head listens to a recorded person, in real time
    held    the same, the run and its listener held to `SHARE` of one core (`throttled_tree`)

Servos are emulated outside of what is held: real ones are not slower either. From there they are looked at, past the
bus. However slow the computer is, no command outside the limits may reach them, and the states have to be what
docs/safety.md says they are. An arrow that its table has not, a listener that is silent or always late and not named, a
reason that is not told, torque that is left on: a line each, and exit code 1.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
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
from sfms_robot.errors import BusError
from sfms_robot.frames import Plan
from sfms_robot.lab.bench.live_bench import patient_head
from sfms_robot.lab.bench.measure import HEAD, LISTENER, Row, Told, row
from sfms_robot.lab.bench.throttled_tree import Tree, check
from sfms_robot.listeners.thread import HUNG_S, LATE_S
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.safety import EASE_S
from sfms_robot.runtime.states import ARROWS
from sfms_robot.sources.registry import DEFAULT_SPEAKER

Change = tuple[float, str, tuple[str, ...]]  # time_s, state, why

SHARE: Final = 0.25
RUN_S: Final = 20.0
TOLERANCE_S: Final = 0.5  # of a state: the loop looks when it is awake
_LOOK_S: Final = 0.5  # between two looks at the servos
_LIMIT_S: Final = 120.0  # for a run, its start with it
_OUTSIDE_S: Final = 2.0  # more to ease in, for joints found outside their range
_PEER: Final = "the same run on all cores"
_CHILD: Final = "from sfms_robot.lab.bench.throttle_bench import observed_run; observed_run()"


@dataclass(frozen=True)
class Seen:
    """A run.

    Attributes:
        report: its own.
        plans_s: when plans came, and the last of their frames, loop time.
        looks, outside: at servos, and how many of them held a goal outside their joint's range.
        torque: servos that have torque when it is over.
        core_share: of one core that it used, its start with it.
    """

    report: Mapping[str, Any]
    plans_s: Sequence[tuple[float, float]]
    looks: int
    outside: int
    torque: Sequence[int]
    core_share: float

    @property
    def in_time(self) -> float:
        """The share of ticks that were due and came in time."""
        tick = self.report["tick"]
        punctual = 1 - float(tick["late"]) / float(self.report["ticks"])
        return punctual * min(1.0, float(tick["achieved_hz"]) / float(tick["target_hz"]))


def measure(say: Callable[[str], None]) -> Told:
    """Both runs, a minute. Raises ConfigError where processes cannot be held, BusError when a run does not come to
    its end.
    """
    check()
    say(f"{RUN_S:g} s on all of this machine")
    free = _seen(None)
    say(f"{RUN_S:g} s on {SHARE:g} of one core")
    held = _seen(SHARE)
    problems = [f"{name}: {each}" for name, seen in (("all", free), ("held", held)) for each in problems_of(seen)]
    figures: dict[str, Any] = {**_rows(free, held), "share": SHARE, "problems": problems}
    figures |= {name: _figures(seen) for name, seen in (("free", free), ("held", held))}
    told = [
        {"measured": key, "all cores": value, f"{SHARE:g} of one": figures["held"][key]}
        for key, value in figures["free"].items()
        if not isinstance(value, dict)
    ]
    states = [
        {"measured": f"% of the time {name}", "all cores": all_s, f"{SHARE:g} of one": held_s}
        for name, all_s, held_s in _beside(figures["free"]["states"], figures["held"]["states"])
    ]
    return Told(
        figures, [*told, *states], problems or ["commands inside limits, states as docs/safety.md says"], not problems
    )


def _rows(free: Seen, held: Seen) -> dict[str, Row]:
    def beside(figure: Callable[[Seen], float], unit: str) -> Row:
        return row([figure(held)], [figure(free)], unit, _PEER)

    return {
        "throttle.in_time": beside(lambda seen: 100 * seen.in_time, "% of ticks"),
        "throttle.rate": beside(lambda seen: float(seen.report["tick"]["achieved_hz"]), "ticks a second"),
        "throttle.plans": beside(lambda seen: len(seen.plans_s) / seen.report["duration_s"], "plans a second"),
    }


def _figures(seen: Seen) -> dict[str, Any]:
    """What a run did, and what it gave up."""
    report = seen.report
    total_s = sum(report["states"]["seconds"].values())
    return {
        "core share used": round(seen.core_share, 2),
        "ticks in time %": round(100 * seen.in_time, 1),
        "ticks a second": report["tick"]["achieved_hz"],
        "tick late ms p99": report["tick"]["jitter_ms"]["p99"],
        "hop frames": report["hop"],
        "leads cut ms": (report["budget_ms"] or {}).get("lead_cut"),
        "a plan takes ms p50": report["listener_step_ms"]["p50"],
        "frame to wire ms p50": report["latency_ms"]["frame_to_wire"]["p50"],
        "plans": len(seen.plans_s),
        "plans late": report["plans"].get("late"),
        "ticks past a plan": report["plans"].get("held", 0) + report["plans"].get("eased", 0),
        "frames left out": report["listener_state"]["skipped_frames"],
        "listener started anew": report["listener_state"]["restarts"],
        "limit violations": report["limits"]["violations"],
        "goals outside": seen.outside,
        "states": {name: round(100 * of_s / total_s, 1) for name, of_s in report["states"]["seconds"].items()},
    }


def _beside(free: Mapping[str, float], held: Mapping[str, float]) -> Iterator[tuple[str, float, float]]:
    for name in dict.fromkeys([*free, *held]):
        yield name, free.get(name, 0.0), held.get(name, 0.0)


# --- what must not be -----------------------------------------------------------------------------------------------


def problems_of(seen: Seen) -> list[str]:
    """A line for everything that is not as docs/safety.md says; none: all is."""
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
    """A line for everything about the states of a run that its table has not.

    Args:
        changes: in order.
        plans_s: when plans came, and the last of their frames.
    """
    found = []
    for (_, before, _), (at_s, after, _) in pairwise(changes):
        if before != after and (before, after) not in ARROWS:
            found.append(f"{before} to {after} at {at_s:.2f} s is no arrow of the table")
    for at_s, name, why in changes:
        if bool(why) != (name in ("degraded", "halted", "fault")):
            found.append(f"{name} at {at_s:.2f} s says {why or 'nothing'}")
    if [name for _, name, _ in changes][-2:] != ["stopping", "stopped"]:
        found.append(f"it ends {changes[-1][1]}")
    easing_s = EASE_S + _OUTSIDE_S + TOLERANCE_S
    if len(changes) > 1 and changes[0][1] == "starting" and changes[1][0] - changes[0][0] > easing_s:
        found.append(f"starting for {changes[1][0] - changes[0][0]:.1f} s, {easing_s:g} at most")
    return found + [
        f"no plan in time from {since_s:.2f} to {until_s:.2f} s, and the listener is not named"
        for since_s, until_s in _silences(changes, plans_s)
        if not _named("listener", since_s, until_s, changes)
    ]


def _silences(changes: Sequence[Change], plans_s: Sequence[tuple[float, float]]) -> Iterator[tuple[float, float]]:
    """From the last plan in time to the next, where that is longer than it may stay without a name, once there was a
    plan at all. A plan that comes late shows that the listener is late only when it comes, hence two of these times.
    """
    if not plans_s:
        return
    ends_s = next(at_s for at_s, name, _ in changes if name in ("stopping", "stopped", "fault"))
    in_time_s = [plans_s[0][0], *(came_s for came_s, last_s in plans_s[1:] if came_s <= last_s), ends_s]
    for before_s, next_s in pairwise(in_time_s):
        if next_s - before_s > HUNG_S + LATE_S + TOLERANCE_S:
            yield before_s, next_s


def _named(why: str, since_s: float, until_s: float, changes: Sequence[Change]) -> bool:
    """Whether a state between two times says so."""
    ends_s = [at_s for at_s, _, _ in changes[1:]] + [float("inf")]
    return any(
        why in told and at_s <= until_s and end_s >= since_s
        for (at_s, _, told), end_s in zip(changes, ends_s, strict=True)
    )


# --- a run ----------------------------------------------------------------------------------------------------------


def _seen(share: float | None) -> Seen:
    """A run to its end. Raises BusError with the last it said when there is none."""
    head = load_head(HEAD)
    with TemporaryDirectory() as name, launch(emulated(head)["main"]) as chain:
        folder, goals = Path(name), _Goals(chain)
        options = {"head": str(patient_head(folder)), "port": chain.device}
        with _started(options, share, folder) as tree:
            began_s = time.monotonic()
            while tree.process.poll() is None:
                if time.monotonic() - began_s > _LIMIT_S:
                    raise BusError(f"bench throttle: the run has not ended after {_LIMIT_S:g} s")
                goals.look()
                time.sleep(_LOOK_S)
            core_share = tree.used_s / (time.monotonic() - began_s)
        lines = (folder / "out").read_text(encoding="utf-8").splitlines()
        if tree.process.returncode or not lines:
            said = (folder / "said").read_text(encoding="utf-8").strip().splitlines()
            raise BusError(f"bench throttle: the run ended with {tree.process.returncode}: {said[-1:]}")
        told = json.loads(lines[-1])
        torque = [servo.id for servo in chain.servos if chain.state(servo.id)["torque"]]
    return Seen(told["report"], told["plans_s"], goals.looks, goals.outside, torque, core_share)


class _Goals:
    """What servos hold, seen past the bus."""

    def __init__(self, chain: Chain) -> None:
        joints = load_head(HEAD).joints
        ticks = calibration_of(joints)
        self._chain = chain
        self._ranges = []
        for joint, low, high in zip(joints.values(), ticks.low_ticks, ticks.high_ticks, strict=True):
            found = round(chain.state(joint.id)["position"])  # one found outside its range comes in from there
            self._ranges.append((joint.id, min(low, found), max(high, found)))
        self.looks = self.outside = 0

    def look(self) -> None:
        for servo, low, high in self._ranges:
            state = self._chain.state(servo)
            if state["torque"] and state["goal"] is not None:
                self.looks += 1
                self.outside += not low <= state["goal"] <= high


@contextmanager
def _started(options: Mapping[str, Any], share: float | None, folder: Path) -> Iterator[Tree]:
    """`observed_run` in a process; what it prints is in the folder's out and said."""
    with (folder / "out").open("wb") as out, (folder / "said").open("wb") as said:
        paths = os.pathsep.join(filter(None, sys.path))
        with Tree(
            ["-P", "-c", _CHILD, json.dumps(options)], share, stdin=subprocess.DEVNULL, stdout=out, stderr=said,
            env={**os.environ, "PYTHONPATH": paths},
        ) as tree:  # fmt: skip
            yield tree


def observed_run() -> None:
    """In a process of its own: run what the first argument says, as JSON, and print report and arrivals of plans."""
    plans = _Plans()
    options = RunOptions(listener=LISTENER, audio=DEFAULT_SPEAKER, duration_s=RUN_S, **json.loads(sys.argv[1]))
    report = run(options, observers=[plans])
    sys.stdout.write(json.dumps({"report": report, "plans_s": plans.came_s}) + "\n")


class _Plans(Observer):
    """When plans came, and the last of their frames."""

    def __init__(self) -> None:
        self.came_s: list[tuple[float, float]] = []
        self._now_s = 0.0

    def tick(self, seen: Tick) -> None:
        self._now_s = seen.time_s

    def planned(self, plan: Plan) -> None:
        self.came_s.append((round(self._now_s, 3), round(float(plan.times_s[-1]), 3)))
