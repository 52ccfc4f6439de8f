"""`bench live --torture`: a live run with faults in real time: its missed ticks, its reports and its end.

The faults come in random order:

    killed    the listener's process gets SIGKILL
    stopped   the listener's process gets SIGSTOP and no SIGCONT
    cut       a source is gone for some seconds: the microphone is unplugged, or, every other time, the phone is silent
    unplugged a servo is silent for some seconds

After each fault the run has to become `degraded` for that reason within the time of docs/safety.md, and recover before
the next fault. It must not miss more ticks than in calm stretches. At the end the recording must have the same states,
and the torque of every servo must be off.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.app.wiring import emulated
from sfms_robot.config import Head, load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import BusError
from sfms_robot.lab import Figures
from sfms_robot.lab.bench.live_bench import (
    SINK,
    Audio,
    LivePerson,
    check_audio,
    free_port,
    idle_loop,
    live,
    live_person,
    load,
    patient_head,
)
from sfms_robot.lab.bench.measure import (
    HEAD,
    LISTENER,
    MAIN,
    BenchResult,
    Say,
    children_of,
    last_line,
    package_environment,
)
from sfms_robot.lab.bench.throttle_bench import OUT, SAID, Process, held

KINDS: Final = ("killed", "stopped", "cut", "unplugged")
LONGEST_S: Final = {"killed": 1.0, "stopped": 1.0, "cut": 1.0, "unplugged": 1.5}
_MINUTES: Final = 30.0
_EACH: Final = 20  # faults of a kind in half an hour
_LOOK_S: Final = 0.1  # between two requests of the status; a state may be seen late by this time
_TOLERANCE_S: Final = 0.3
_AWAY_S: Final = 3.0  # absence of a source or a servo
_START_S: Final = 60.0
_AFTER_S: Final = 2.0  # ticks missed within this time after a blow count as caused by it
_END_S: Final = 30.0
_SEED: Final = 0


@dataclass(frozen=True, kw_only=True)
class Blow:
    """One fault. Times in seconds; None: not within its slot.

    Attributes:
        why: The reason that the run has to report as degraded.
        at_s: Loop time.
        degraded_s: Time until the run reported the right reason.
        well_s: Time from then, or from the return of the source or servo, until that reason was gone.
    """

    kind: str
    what: str
    why: str
    at_s: float
    degraded_s: float | None
    well_s: float | None

    @property
    def passed(self) -> bool:
        in_time = self.degraded_s is not None and self.degraded_s <= LONGEST_S[self.kind] + _TOLERANCE_S
        return in_time and self.well_s is not None


def measure(say: Say, minutes: float = 0.0, audio: Audio = "mic", torture: bool = False) -> BenchResult:
    """Measure a live run, if `torture` with faults in proportion to its length; Linux only. 0 minutes: default length.

    Raises ConfigError without PulseAudio, BusError if the run does not begin.
    """
    if not torture:
        return live(minutes, audio, say)
    minutes = minutes or _MINUTES
    check_audio(audio)
    idle = idle_loop(3.0)
    order = [kind for kind in KINDS for _ in range(max(1, round(_EACH * minutes / _MINUTES)))]
    random.Random(_SEED).shuffle(order)
    head = load_head(HEAD)
    with TemporaryDirectory() as name, live_person(Path(name), audio) as person:
        folder = Path(name)
        with launch(emulated(head)["main"], timing="wire") as chain:
            with _running(folder, chain, person, audio) as (process, port):
                victim = _Victim(process=process, port=port, chain=chain, head=head, person=person)
                blows = _strike(victim, order, minutes * 60, say)
                report = _ended(process, folder)
            torque = [servo.id for servo in chain.servos if chain.state(servo.id)["torque"]]
        result = _judged(blows, report, folder / "run", torque)
    result = {"minutes": minutes, "audio": audio, "idle": idle, "load": load(), **result}
    missed = result["missed_ticks"]
    lines = [
        f"load {result['load']}, an empty loop has a jitter p99 of {result['idle']['jitter_ms']['p99']} ms",
        f"{result['ticks']} ticks; missed within {_AFTER_S:g} s of a blow {missed['after_a_blow']}, otherwise "
        f"{missed['otherwise']}; torque left on: {result['torque_left_on'] or 'none'}; the run ended: {result['exit']}",
        "passed" if result["passed"] else "not passed",
    ]
    table = [{"what": kind, **row} for kind, row in result["counts"].items()]
    return BenchResult(result, table, lines, result["passed"])


@dataclass(kw_only=True)
class _Victim:
    """The run, the devices that it uses, and its status."""

    process: Process
    port: int
    chain: Chain
    head: Head
    person: LivePerson
    cuts: int = 0

    def status(self) -> Figures:
        """Return the status document. Raises BusError when the run is over."""
        try:
            return _status(self.port)
        except OSError as error:
            raise BusError(f"bench live: the run answers no status request any more: {error}") from error

    def strike(self, kind: str, chance: random.Random) -> tuple[str, str, Callable[[], None] | None]:
        """Cause a fault. Return the thing hit, the run's name for it, and a function that ends the fault, if needed."""
        if kind in ("killed", "stopped"):
            os.kill(listener_of(self.process.pid), signal.SIGKILL if kind == "killed" else signal.SIGSTOP)
            return "listener", "listener", None
        if kind == "unplugged":
            joint = chance.choice(list(self.head.joints))
            servo = self.head.joints[joint].id
            self.chain.kill(servo)
            return joint, joint, lambda: self.chain.revive(servo)
        self.cuts += 1
        if (server := self.person.server) is not None and self.cuts % 2:
            server.unplug(SINK)
            return "microphone", "voice", lambda: server.plug(SINK)
        self.person.phone_silent.set()
        return "phone", "face", self.person.phone_silent.clear

    def watch(self, limit_s: float, why: str = "", wanted: bool = True) -> float | None:
        """Return the seconds until the run is degraded by `why` (if not `wanted`: no longer is); None at the limit.

        Without `why`, read the status for `limit_s` and return None.
        """
        began_s = time.monotonic()
        while (taken_s := time.monotonic() - began_s) < limit_s:
            if (why in self.status()["why"]) == wanted:
                return round(taken_s, 2)
            time.sleep(_LOOK_S)
        return None


def listener_of(pid: int) -> int:
    """Return the id of the listener's process of a run. Raises BusError if there is none."""
    for child in children_of(pid):
        with suppress(OSError):
            if "listeners.process" in Path(f"/proc/{child}/cmdline").read_text(encoding="utf-8"):
                return child
    raise BusError("bench live: the run has no listener's process")


def _status(port: int) -> Figures:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5) as answer:
        document: Figures = json.load(answer)
    return document


def _strike(victim: _Victim, order: Sequence[str], duration_s: float, say: Say) -> list[Blow]:
    """Cause each fault in its slot of the time, at a random moment in the first fifth of the slot."""
    chance, slot_s = random.Random(_SEED), duration_s / len(order)
    blows = []
    for number, kind in enumerate(order):
        ends_s = time.monotonic() + slot_s
        victim.watch(chance.uniform(0.0, slot_s / 5))
        at_s = victim.status()["time_s"]
        began_s = time.monotonic()
        what, why, end = victim.strike(kind, chance)
        degraded_s = victim.watch(slot_s / 2, why)
        if end is not None:
            victim.watch(began_s + _AWAY_S - time.monotonic())
            end()
        well_s = victim.watch(max(1.0, ends_s - time.monotonic()), why, wanted=False)
        blows.append(Blow(kind=kind, what=what, why=why, at_s=at_s, degraded_s=degraded_s, well_s=well_s))
        say(f"{number + 1} of {len(order)}: {kind} {what}: degraded after {degraded_s} s, well after {well_s} s")
        victim.watch(ends_s - time.monotonic())
    return blows


def _judged(blows: Sequence[Blow], report: Figures, folder: Path, torque: Sequence[int]) -> Figures:
    recording = read_recording(folder)
    by_kind = {kind: [blow for blow in blows if blow.kind == kind] for kind in KINDS}

    def missed(of: Sequence[Blow]) -> dict[str, float]:
        return missed_ticks(recording.times_s, [blow.at_s for blow in of])

    def recorded(blow: Blow) -> bool:
        until_s = blow.at_s + LONGEST_S[blow.kind] + _TOLERANCE_S
        return any(
            state == "degraded" and blow.at_s <= at_s <= until_s and blow.why in why
            for at_s, state, why in recording.states
        )

    counts = {
        kind: {
            "done": len(found),
            "passed": sum(blow.passed for blow in found),
            "degraded_s": max((blow.degraded_s for blow in found if blow.degraded_s is not None), default=None),
            "well_s": max((blow.well_s for blow in found if blow.well_s is not None), default=None),
            "missed_ticks": missed(found)["after_a_blow"],
        }
        for kind, found in by_kind.items()
    }
    every, seen = missed(blows), sum(map(recorded, blows))
    passed = (
        all(blow.passed for blow in blows)
        and every["after_a_blow"] <= every["expected_after_a_blow"]
        and not torque
        and recording.whole
        and report["exit"] == "interrupted"
        and seen == len(blows)
    )
    return {
        "passed": passed,
        "counts": counts,
        "missed_ticks": every,
        "late_ticks": report["tick"]["late"],
        "jitter_ms": report["tick"]["jitter_ms"],
        "ticks": report["ticks"],
        "exit": report["exit"],
        "torque_left_on": list(torque),
        "recording": {"whole": recording.whole, "ticks": len(recording.times_s), "blows": seen},
        "states": {"changes": len(report["states"]["changes"]), "seconds": report["states"]["seconds"]},
        "listener": report["listener_state"],
        "violations": report["limits"]["violations"],
        "blows": [asdict(blow) | {"passed": blow.passed} for blow in blows],
    }


def missed_ticks(times_s: Any, blows_s: Sequence[float]) -> dict[str, float]:
    """Count ticks missing from the recording after blows and elsewhere, and those expected after blows by chance.

    The expected number is the mean of the rest plus three standard deviations of a Poisson count.
    """
    gaps = np.diff(times_s)
    lost = np.round(gaps / float(np.median(gaps))).astype(int) - 1
    near = np.zeros(len(gaps), bool)
    for at_s in blows_s:
        near |= (times_s[1:] >= at_s) & (times_s[:-1] <= at_s + _AFTER_S)
    after, calm = int(lost[near].sum()), int(lost[~near].sum())
    mean = calm * near.sum() / max(1, (~near).sum())
    return {"after_a_blow": after, "otherwise": calm, "expected_after_a_blow": round(float(mean + 3 * mean**0.5), 2)}


# --- the run --------------------------------------------------------------------------------------------------------


@contextmanager
def _running(folder: Path, chain: Chain, person: LivePerson, audio: Audio) -> Iterator[tuple[Process, int]]:
    """Start `run` and yield its process and status port once the listener listens.

    Raises BusError if the run ends before that, or if it does not listen in time.
    """
    port = free_port()
    words = [
        "run", "--head", str(patient_head(folder, chain.read_deadline_s)), "--port", chain.device,
        "--listener", LISTENER, "--audio", audio,
        "--face", person.face, "--record", str(folder / "run"), "--status", str(port), "--json", "--yes",
    ]  # fmt: skip
    environment = {**package_environment(), **person.environment}
    with held([*MAIN, *words], None, folder, environment) as process:
        ends_s, waits = time.monotonic() + _START_S, True
        while waits:
            if time.monotonic() >= ends_s or process.poll() is not None:
                said = (folder / SAID).read_text(encoding="utf-8")
                raise BusError(f"bench live: the run did not begin to listen: {last_line(said)}")
            time.sleep(_LOOK_S)
            with suppress(OSError):  # the server is not up yet
                status = _status(port)
                hears = status.get("listener_state", {}).get("state") == "listening"
                waits = not hears or status["state"] in ("starting", "degraded")
        yield process, port


def _ended(process: Process, folder: Path) -> Figures:
    """Interrupt the run and return its report. Blocks until it is over."""
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired as error:
        raise BusError(f"bench live: the run did not end within {_END_S:g} s of Ctrl-C") from error
    report: Figures = json.loads(last_line((folder / OUT).read_text(encoding="utf-8")))
    return report
