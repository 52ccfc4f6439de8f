"""A live run to which everything happens, in real time: what it misses, what it says, and how it ends.

At random, in turn:

    killed    the listener's process gets SIGKILL
    stopped   it gets SIGSTOP, and nobody wakes it
    cut       a source is gone for some seconds: the microphone is unplugged, and next time the phone silent
    unplugged a servo falls silent for some seconds

After each the run has to be `degraded` for that reason within the time of docs/safety.md, and be well again before the
next; no tick may be missed that an idle stretch would not miss; at the end the recording tells the same states, and
every servo's torque is off.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from sfms_robot.app.replay.run_file import read_recording, states_of
from sfms_robot.app.wiring import emulated
from sfms_robot.config import Head, load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import BusError
from sfms_robot.lab.bench import live_bench
from sfms_robot.lab.bench.live_bench import (
    SINK,
    Audio,
    LivePerson,
    Say,
    check_audio,
    children,
    free_port,
    idle_loop,
    live_person,
    patient_head,
)
from sfms_robot.lab.bench.measure import HEAD, LISTENER, MAIN, Told

MINUTES: Final = 30.0
EACH: Final = 20  # of a kind, in half an hour
KINDS: Final = ("killed", "stopped", "cut", "unplugged")
LONGEST_S: Final[Mapping[str, float]] = {"killed": 1.0, "stopped": 1.0, "cut": 1.0, "unplugged": 1.5}
LOOK_S: Final = 0.1  # between two looks at the status, all the time: a state may be seen so much later
_TOLERANCE_S: Final = 0.3
_AWAY_S: Final = 3.0  # of a source or a servo
_START_S: Final = 60.0
_AFTER_S: Final = 2.0  # ticks missed within this time after something happened count as its own
_END_S: Final = 30.0


@dataclass(frozen=True)
class Blow:
    """One thing that happened. Times in seconds; None: not within its slot.

    Attributes:
        why: by which name the run has to be degraded.
        at_s: loop time.
        degraded_s: until the run said so, with the right reason.
        well_s: from then on, or from the moment that the source or servo was back, until that reason was gone.
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


def tortured(minutes: float, audio: Audio, say: Say, seed: int = 0) -> dict[str, Any]:
    """Half an hour, or another time with as many blows as fit; Linux only. Blocks.

    Raises ConfigError without PulseAudio, BusError when the run does not begin.
    """
    check_audio(audio)
    idle = idle_loop(3.0)
    each = max(1, round(EACH * minutes / MINUTES))
    order = [kind for kind in KINDS for _ in range(each)]
    random.Random(seed).shuffle(order)
    config = load_head(HEAD)
    with TemporaryDirectory() as name, live_person(Path(name), audio) as person:
        folder = Path(name)
        with launch(emulated(config)["main"], timing="wire") as chain:
            with _running(folder, chain, person, audio) as command:
                blows = _strike(_Victim(command, chain, config, person), order, minutes * 60, seed, say)
                report = _ended(command)
            torque = [servo.id for servo in chain.servos if chain.state(servo.id)["torque"]]
        result = _judged(blows, report, folder / "run", torque)
    return {"minutes": minutes, "audio": audio, "idle": idle, "load": round(os.getloadavg()[0], 2), **result}


class _Victim:
    """The run, what it hangs on, and what it says."""

    def __init__(self, command: _Command, chain: Chain, head: Head, person: LivePerson) -> None:
        self.command, self.chain, self.head, self.person = command, chain, head, person
        self._cuts = 0

    def status(self) -> dict[str, Any]:
        """Raises BusError when the run is over."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.command.port}/", timeout=5) as answer:
                document: dict[str, Any] = json.load(answer)
                return document
        except OSError as error:
            raise BusError(f"bench live: the run tells no status any more: {error}") from error

    def strike(self, kind: str, chance: random.Random) -> tuple[str, str, Callable[[], None] | None]:
        """Do it: what was hit, how the run calls it, and what ends it; None: the run helps itself."""
        if kind in ("killed", "stopped"):
            (pid,) = [pid for role, pid in children(self.command.process.pid) if role == "listener"]
            os.kill(pid, signal.SIGKILL if kind == "killed" else signal.SIGSTOP)
            return "listener", "listener", None
        if kind == "unplugged":
            joint = chance.choice(list(self.head.joints))
            servo = self.head.joints[joint].id
            self.chain.kill(servo)
            return joint, joint, lambda: self.chain.revive(servo)
        self._cuts += 1
        if (server := self.person.server) is not None and self._cuts % 2:
            server.unplug(SINK)
            return "microphone", "voice", lambda: server.plug(SINK)
        self.person.phone_silent.set()
        return "phone", "face", self.person.phone_silent.clear

    def until(self, wanted: Callable[[dict[str, Any]], bool], limit_s: float) -> float | None:
        """Seconds until the status is as wanted; None: not within the limit."""
        began_s = time.monotonic()
        while (taken_s := time.monotonic() - began_s) < limit_s:
            if wanted(self.status()):
                return taken_s
            time.sleep(LOOK_S)
        return None


def _strike(victim: _Victim, order: Sequence[str], duration_s: float, seed: int, say: Say) -> list[Blow]:
    """Each in a slot of its own, at a random time in the first fifth of it."""
    chance, slot_s = random.Random(seed), duration_s / len(order)
    blows = []
    for number, kind in enumerate(order):
        ends_s = time.monotonic() + slot_s
        victim.until(_never, chance.uniform(0.0, slot_s / 5))
        at_s = victim.status()["time_s"]
        began_s = time.monotonic()
        what, why, end = victim.strike(kind, chance)
        degraded_s = victim.until(partial(_degraded_by, why, True), slot_s / 2)
        if end is not None:
            victim.until(_never, began_s + _AWAY_S - time.monotonic())
            end()
        well_s = victim.until(partial(_degraded_by, why, False), max(1.0, ends_s - time.monotonic()))
        blow = Blow(kind, what, why, at_s, _rounded(degraded_s), _rounded(well_s))
        blows.append(blow)
        told = f"degraded after {blow.degraded_s} s, well after {blow.well_s} s"
        say(f"{number + 1} of {len(order)}: {kind} {what}: {told}")
        victim.until(_never, ends_s - time.monotonic())
    return blows


def _never(_: Mapping[str, Any]) -> bool:
    return False


def _degraded_by(why: str, wanted: bool, status: Mapping[str, Any]) -> bool:
    return (why in status["why"]) == wanted


def _judged(blows: Sequence[Blow], report: Mapping[str, Any], folder: Path, torque: Sequence[int]) -> dict[str, Any]:
    recording = read_recording(folder)
    missed = missed_ticks(recording.times_s, [blow.at_s for blow in blows])
    near = {kind: missed_ticks(recording.times_s, [blow.at_s for blow in blows if blow.kind == kind]) for kind in KINDS}
    states = states_of(folder)
    recorded = sum(_recorded(blow, states) for blow in blows)
    changes = [each["state"] for each in report["states"]["changes"]]
    counts = {
        kind: {
            "done": len(of_kind := [blow for blow in blows if blow.kind == kind]),
            "passed": sum(blow.passed for blow in of_kind),
            "degraded_s": max((blow.degraded_s for blow in of_kind if blow.degraded_s is not None), default=None),
            "well_s": max((blow.well_s for blow in of_kind if blow.well_s is not None), default=None),
            "missed_ticks": near[kind]["after_a_blow"],
        }
        for kind in KINDS
    }
    passed = (
        all(blow.passed for blow in blows)
        and missed["after_a_blow"] <= missed["expected_after_a_blow"]
        and not torque
        and recording.whole
        and report["exit"] == "interrupted"
        and recorded == len(blows)
    )
    return {
        "passed": passed,
        "counts": counts,
        "missed_ticks": missed,
        "late_ticks": report["tick"]["late"],
        "jitter_ms": report["tick"]["jitter_ms"],
        "ticks": report["ticks"],
        "exit": report["exit"],
        "torque_left_on": list(torque),
        "recording": {"whole": recording.whole, "ticks": len(recording.times_s), "blows": recorded},
        "states": {"changes": len(changes), "seconds": report["states"]["seconds"]},
        "listener": report["listener_state"],
        "violations": report["limits"]["violations"],
        "blows": [asdict(blow) | {"passed": blow.passed} for blow in blows],
    }


def _recorded(blow: Blow, states: Sequence[tuple[float, str, tuple[str, ...]]]) -> bool:
    """Whether the recording holds that the run was degraded by it, in time."""
    until_s = blow.at_s + LONGEST_S[blow.kind] + _TOLERANCE_S
    return any(blow.at_s <= at_s <= until_s and blow.why in why for at_s, state, why in states if state == "degraded")


def missed_ticks(times_s: Any, blows_s: Sequence[float]) -> dict[str, float]:
    """Ticks that are not in the recording, near blows and elsewhere, and how many the rest would lead to expect there.

    Expected is the mean of the rest and three standard deviations of a Poisson count.
    """
    gaps = np.diff(times_s)
    period_s = float(np.median(gaps))
    lost = np.round(gaps / period_s).astype(int) - 1
    near = np.zeros(len(gaps), bool)
    for at_s in blows_s:
        near |= (times_s[1:] >= at_s) & (times_s[:-1] <= at_s + _AFTER_S)
    after, calm = int(lost[near].sum()), int(lost[~near].sum())
    mean = calm * near.sum() / max(1, (~near).sum())
    return {"after_a_blow": after, "otherwise": calm, "expected_after_a_blow": round(float(mean + 3 * mean**0.5), 2)}


# --- the run --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Command:
    """`run`, its status port, and where it says something."""

    process: subprocess.Popen[bytes]
    port: int
    said: Path


@contextmanager
def _running(folder: Path, chain: Chain, person: LivePerson, audio: Audio) -> Iterator[_Command]:
    port, said = free_port(), folder / "said"
    words = [
        "run", "--head", str(patient_head(folder, chain.read_deadline_s)), "--port", chain.device,
        "--listener", LISTENER, "--audio", audio,
        "--face", person.face, "--record", str(folder / "run"), "--status", str(port), "--json", "--yes",
    ]  # fmt: skip
    paths = os.pathsep.join(filter(None, sys.path))
    with ExitStack() as stack:
        out = stack.enter_context((folder / "out").open("wb"))
        err = stack.enter_context(said.open("wb"))
        process = subprocess.Popen(
            [sys.executable, *MAIN, *words], stdout=out, stderr=err, stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths, **person.environment},
        )  # fmt: skip
        command = _Command(process, port, said)
        try:
            _wait_listening(command)
            yield command
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()


def _wait_listening(command: _Command) -> None:
    """Block until the listener listens. Raises BusError when the run ends, or that takes too long."""
    ends_s = time.monotonic() + _START_S
    while time.monotonic() < ends_s and command.process.poll() is None:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{command.port}/", timeout=5) as answer:
                told = json.load(answer)
            if told.get("listener_state", {}).get("state") == "listening" and told["state"] not in (
                "starting",
                "degraded",
            ):
                return
        except OSError:
            pass  # not yet
        time.sleep(LOOK_S)
    lines = command.said.read_text(encoding="utf-8").strip().splitlines()
    raise BusError(f"bench live: the run did not begin to listen: {lines[-1:]}")


def _ended(command: _Command) -> dict[str, Any]:
    """Interrupt the run; its report. Blocks until it is over."""
    command.process.send_signal(signal.SIGINT)
    try:
        command.process.wait(_END_S)
    except subprocess.TimeoutExpired as error:
        raise BusError(f"bench live: the run did not end within {_END_S:g} s of Ctrl-C") from error
    report: dict[str, Any] = json.loads((command.said.parent / "out").read_text(encoding="utf-8").splitlines()[-1])
    return report


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def measure(say: Say, minutes: float = 0.0, audio: Audio = "mic", torture: bool = False) -> Told:
    """A live run, tortured or not, as `bench` tells it; 0 minutes: as many as it mostly takes."""
    if torture:
        blows = tortured(minutes or MINUTES, audio, say)
        return Told(blows, table(blows), words(blows), blows["passed"])
    result = live_bench.live(minutes or live_bench.MINUTES, audio, say)
    return Told(result, live_bench.table(result), live_bench.words(result))


def table(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row per kind, for people."""
    return [{"what": kind, **row} for kind, row in result["counts"].items()]


def words(result: Mapping[str, Any]) -> Sequence[str]:
    """What the table leaves out, a line each."""
    missed = result["missed_ticks"]
    return [
        f"load {result['load']}, an empty loop has a jitter p99 of {result['idle']['jitter_ms']['p99']} ms",
        f"{result['ticks']} ticks; missed within {_AFTER_S:g} s of a blow {missed['after_a_blow']}, otherwise "
        f"{missed['otherwise']}; torque left on: {result['torque_left_on'] or 'none'}; the run ended: {result['exit']}",
        "passed" if result["passed"] else "not passed",
    ]
