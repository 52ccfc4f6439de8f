"""A head that listens live: `face28` on emulated servos with the timing of a wire, `sfms-small`, a microphone and a
phone, all in real time.

    idle          an empty loop of 100 Hz: how punctual this machine is with nothing of ours to do
    live          the run that is measured, with a recording of it
    file          the same head and listener with a recorded person, for comparison
    first_write   `run` is typed with live sources -> its first goal on the wire; the median of some starts

The microphone is a null sink of a PulseAudio of our own, into which a recorded voice is played, so that PortAudio's
callbacks, the audio process and the grid are those of a real one; "push" hands the same voice over by calls. The phone
sends recorded packets of Live Link Face at their pace. A run is a process of its own, so that processor time and memory
are those of a run.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Literal

import numpy as np
import yaml

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.data import data_dir
from sfms_robot.emulator.launch import READ_DEADLINE_S, launch
from sfms_robot.emulator.phone import EmulatedPhone
from sfms_robot.emulator.sound_server import SoundServer
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.frames import AUDIO_HZ
from sfms_robot.lab.bench.live_stamps import SETTLED_S, StampedSource, Stamps
from sfms_robot.lab.bench.measure import HEAD, LISTENER
from sfms_robot.lab.bench.memory_bench import ResidentMemory
from sfms_robot.lab.bench.procfs import children_of, processor_time_s
from sfms_robot.lab.bench.startup_bench import first_goal_s
from sfms_robot.ports import Observer, Source
from sfms_robot.processes import realtime_priority
from sfms_robot.runtime.clock import RealClock, tick_times
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.quantiles import Quantiles
from sfms_robot.sources.live_link import open_live_link
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.push import PushedVoice
from sfms_robot.sources.registry import DEFAULT_SPEAKER, open_source, voice_file

Audio = Literal["mic", "push"]
MINUTES: Final = 10.0
IDLE_S: Final = 5.0
FILE_S: Final = 60.0
STARTS: Final = 5
SINK: Final = "person"
BUSY_JITTER_MS: Final = 0.5  # of an empty loop, p99
GOALS: Final[Mapping[str, float]] = {  # at most, but for the share of ticks in time
    "in_time_share": 0.999, "jitter_p99_ms": 0.5, "sound_to_goal_p50_ms": 95, "sound_to_goal_p95_ms": 135,
    "face_to_goal_p95_ms": 80, "first_write_s": 2.2,
}  # fmt: skip
_PIECE: Final = 160  # samples that are pushed at once
_MEMORY_LOOKS: Final = 200
_ROLES: Final = {"listeners.process": "listener", "sources.worker": "audio", "emulator": "emulator"}
_CHILD: Final = "from sfms_robot.lab.bench.live_bench import measured_run; measured_run()"

Say = Callable[[str], None]


def live(minutes: float, audio: Audio, say: Say) -> dict[str, Any]:
    """All parts, one after the other; Linux only. `say` is told what is going on.

    Raises ConfigError where PulseAudio is not installed and `audio` asks for it.
    """
    check_audio(audio)
    say("an empty loop")
    idle = idle_loop(IDLE_S)
    with TemporaryDirectory() as folder, live_person(Path(folder), audio) as person:
        say(f"a live run of {minutes:g} minutes")
        told = _run(person.environment, audio=audio, face=person.face, duration_s=minutes * 60, record=f"{folder}/run")
        say("the same with a recorded person")
        compared = _run({}, audio="default", face="auto", duration_s=min(minutes * 60, FILE_S), record=None)
        say("`run` until its first goal")
        words = ["--head", str(patient_head(Path(folder))), "--audio", audio, "--face", person.face]
        typed_s = _median([first_goal_s(words, {**os.environ, **person.environment}) for _ in range(STARTS)])
    result = {"audio": audio, "idle": idle, "live": told, "file": compared, "first_write_s": typed_s}
    return {**result, "goals": goals(result)}


def _median(times_s: Sequence[float | None]) -> float | None:
    """None where one start had no goal."""
    told = [each for each in times_s if each is not None]
    return float(np.median(told)) if len(told) == len(times_s) else None


def idle_loop(duration_s: float, rate_hz: float = 100.0) -> dict[str, Any]:
    """Jitter of a loop that does nothing, at the priority of a run, and how busy the machine is. Blocks."""
    clock, late_ms = RealClock(), Quantiles()
    with realtime_priority(wanted=True) as priority:
        for tick in tick_times(clock, rate_hz, clock.now_s()):
            if tick.time_s > duration_s:
                break
            late_ms.add((tick.late_s + tick.skipped / rate_hz) * 1e3)
    jitter_ms = late_ms.report(p50=50, p99=99, max=100)
    busy = late_ms.at(99) > BUSY_JITTER_MS or _load() > (os.cpu_count() or 1) / 2
    return {"jitter_ms": jitter_ms, "busy": busy, "load": _load(), "cores": os.cpu_count(), "priority": priority}


def goals(result: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What was wanted, what came, and whether that is met; None where nothing was measured."""
    told = result["live"]
    came = {
        "in_time_share": told["in_time_share"],
        "jitter_p99_ms": told["jitter_ms"]["p99"],
        "sound_to_goal_p50_ms": told["sound_to_goal_ms"]["p50"],
        "sound_to_goal_p95_ms": told["sound_to_goal_ms"]["p95"],
        "face_to_goal_p95_ms": told["face_to_goal_ms"]["p95"],
        "first_write_s": result["first_write_s"],
    }
    return {
        name: {"wanted": wanted, "measured": came[name], "met": _met(name, wanted, came[name])}
        for name, wanted in GOALS.items()
    }


def _met(name: str, wanted: float, came: float | None) -> bool | None:
    if came is None:
        return None
    return came >= wanted if name == "in_time_share" else came <= wanted


def table(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row per figure of `goals`, for people."""
    words = {True: "yes", False: "no", None: "-"}
    return [
        {"what": name, "measured": row["measured"], "wanted": row["wanted"], "met": words[row["met"]]}
        for name, row in result["goals"].items()
    ]


# --- a person who is there ------------------------------------------------------------------------------------------


class LivePerson:
    """A voice in a microphone and a phone before a face, while `live_person` lasts.

    Attributes:
        environment: what a program needs to find the microphone.
        face: what `--face` says.
        phone_silent: set: the phone sends nothing.
        server: the microphone's; None without.
    """

    def __init__(self, environment: Mapping[str, str], port: int, server: SoundServer | None) -> None:
        self.environment, self.server = environment, server
        self.face = f"live-link:127.0.0.1:{port}"
        self.phone_silent = threading.Event()


def check_audio(audio: Audio) -> None:
    """Raises ConfigError where PulseAudio is needed and missing."""
    if audio == "mic" and (missing := SoundServer.missing()) is not None:
        raise ConfigError(f"bench live: PulseAudio is not installed ({missing}, or --audio push)")


@contextmanager
def live_person(folder: Path, audio: Audio) -> Iterator[LivePerson]:
    """Somebody talks and is seen."""
    with ExitStack() as stack:
        server, environment = None, {}
        if audio == "mic":
            server = SoundServer(folder)
            server.start(SINK)
            stack.callback(server.stop)
            environment = server.environment
        person = LivePerson(environment, free_port(socket.SOCK_DGRAM), server)
        over = threading.Event()
        work = [lambda: _send(person, over)] + ([lambda: _talk(server, over)] if server else [])
        threads = [threading.Thread(target=each, daemon=True) for each in work]
        for thread in threads:
            thread.start()
        try:
            yield person
        finally:
            over.set()
            for thread in threads:
                thread.join()


def patient_head(folder: Path, deadline_s: float = READ_DEADLINE_S) -> Path:
    """`HEAD`, with the patience for emulated servos that `--port sim` has: they share this computer's cores."""
    place = folder / HEAD
    shutil.copytree(data_dir("configs") / "heads" / HEAD, place)
    raw = yaml.safe_load((place / "head.yaml").read_text(encoding="utf-8"))
    raw["buses"]["main"]["read_deadline_ms"] = deadline_s * 1e3
    raw.pop("calibrate_first", None)
    (place / "head.yaml").write_text(yaml.safe_dump(raw, sort_keys=False), encoding="utf-8")
    return place


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """A port of loopback that nobody has."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _send(person: LivePerson, over: threading.Event) -> None:
    """The phone: packets at their pace; those of a silence are not made up for."""
    phone = EmulatedPhone(port=int(person.face.rpartition(":")[2]))
    began_s = time.monotonic()
    while not over.wait(1 / 240):
        if person.phone_silent.is_set():
            phone.sent = int((time.monotonic() - began_s) * 60) + 1
        else:
            phone.send_until(time.monotonic() - began_s)
    phone.close()


def _talk(server: SoundServer, over: threading.Event) -> None:
    """The voice, again and again; where there is no sink it tries again."""
    voice = voice_file(DEFAULT_SPEAKER)
    assert voice is not None
    while not over.is_set():
        player = server.play(SINK, voice)
        while player.poll() is None and not over.wait(0.1):
            pass
        if player.poll() is None:
            player.terminate()
        player.wait()
        over.wait(0.5)


# --- the run, in a process of its own -------------------------------------------------------------------------------


def _run(environment: Mapping[str, str], **options: Any) -> dict[str, Any]:
    """`measured_run` in a process. Raises BusError with the last it said when it does not come to an end."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", _CHILD, json.dumps(options)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise BusError(f"bench live: the run ended with {done.returncode}: {done.stderr.strip().splitlines()[-1:]}")
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return told


def measured_run() -> None:
    """Run what the first argument says, as JSON, and print what was measured."""
    options = json.loads(sys.argv[1])
    record = None if options["record"] is None else Path(options["record"])
    over = threading.Event()
    source = StampedSource(_source(options["audio"], options["face"], options["duration_s"], over))
    rate_hz = max(bus.rate_hz for bus in load_head(HEAD).buses.values())
    stamps = Stamps(source.loop_s, lambda: source.latency_s, rate_hz)
    memory = ResidentMemory(options["duration_s"] / _MEMORY_LOOKS)
    cpu = ProcessorTime()
    how = {"listener": LISTENER, "duration_s": options["duration_s"], "record": record}
    try:
        with TemporaryDirectory() as folder, launch(emulated(load_head(HEAD))["main"], timing="wire") as chain:
            head = str(patient_head(Path(folder), chain.read_deadline_s))
            report = run(
                RunOptions(head=head, port=chain.device, yes=True, **how),
                source=source,
                observers=[stamps, memory, cpu],
            )
    finally:
        over.set()
        source.close()
    stamped = stamps.report()
    due = stamped["ticks"] + stamped["missed_ticks"]
    in_time = None if not due else round((stamped["ticks"] - report["tick"]["late"]) / due, 5)
    measured = {
        **stamped,
        "in_time_share": in_time,
        "jitter_ms": report["tick"]["jitter_ms"],
        "hop": report["hop"],
        "budget_ms": report["budget_ms"],
        "listener_step_ms": report["listener_step_ms"],
        "skipped_frames": report["listener_state"]["skipped_frames"],
        "cpu_s_per_s": cpu.report(),
        "resident_mb": _growth(memory),
        "overruns": report["source"].get("overruns"),
        "wait_ms": report["source"].get("wait_ms"),
        "recording": report.get("recording"),
        "exit": report["exit"],
        "load": _load(),
    }
    sys.stdout.write(json.dumps(measured) + "\n")


def _source(audio: str, face: str, duration_s: float, over: threading.Event) -> Source:
    if audio != "push":
        return open_source(audio, face, duration_s)
    voice = PushedVoice()
    threading.Thread(target=_push, args=(voice, over), daemon=True).start()
    return PairedSource(voice, open_live_link(face.partition(":")[2]), None, duration_s)


def _push(voice: PushedVoice, over: threading.Event) -> None:
    """The recorded voice in pieces of 10 ms, at its pace."""
    file = voice_file(DEFAULT_SPEAKER)
    assert file is not None
    samples, began_s, piece = read_audio(file), time.monotonic(), 0
    while not over.wait(max(0.0, began_s + (piece + 1) * _PIECE / AUDIO_HZ - time.monotonic())):
        start = piece * _PIECE % (len(samples) - _PIECE)
        voice.hear(np.asarray(samples[start : start + _PIECE], np.float32), AUDIO_HZ)
        piece += 1


class ProcessorTime(Observer):
    """An observer of processor time: of this process and those that it started, between two ticks a second apart."""

    def __init__(self) -> None:
        self._next_s = SETTLED_S
        self._first: dict[str, float] | None = None
        self._first_s = self._last_s = 0.0
        self._last: dict[str, float] = {}

    def tick(self, seen: Any) -> None:
        if seen.time_s < self._next_s:
            return
        self._next_s = seen.time_s + 1.0
        self._last_s, self._last = time.monotonic(), processor_times_s()
        if self._first is None:
            self._first_s, self._first = self._last_s, self._last

    def report(self) -> dict[str, float]:
        """Seconds a second, by role."""
        if self._first is None or self._last_s <= self._first_s:
            return {}
        first, over_s = self._first, self._last_s - self._first_s
        return {role: round((used_s - first.get(role, 0.0)) / over_s, 4) for role, used_s in self._last.items()}


def processor_times_s() -> dict[str, float]:
    """Of this process ("main") and its children by role, since each began."""
    used = {"main": time.process_time()}
    for role, pid in children(os.getpid()):
        with suppress(OSError):
            used[role] = used.get(role, 0.0) + processor_time_s(pid)
    return used


def children(pid: int) -> list[tuple[str, int]]:
    """Roles and ids of the processes that a run has started: listener, audio, emulator."""
    found = []
    for child in children_of(pid):
        with suppress(OSError):
            command = Path(f"/proc/{child}/cmdline").read_text(encoding="utf-8")
            found += [(role, child) for part, role in _ROLES.items() if part in command]
    return found


def _growth(memory: ResidentMemory) -> dict[str, float]:
    """Resident memory after a fifth of the time, and how much more of it there was at the end."""
    settled = memory.resident_mb[len(memory.resident_mb) // 5 :]
    return {"settled": round(settled[0], 2), "growth": round(settled[-1] - settled[0], 2)} if settled else {}


def _load() -> float:
    return round(os.getloadavg()[0], 2)


def words(result: Mapping[str, Any]) -> Sequence[str]:
    """What the table leaves out, a line each."""
    told, idle, compared = result["live"], result["idle"], result["file"]
    stages = ", ".join(f"{name} {ms['p50']}/{ms['p95']}" for name, ms in told["stages_ms"].items())
    busy = "; other programs have it too, so figures mean little" if idle["busy"] else ""
    return [
        f"load {told['load']} on {idle['cores']} cores; empty loop: jitter p99 {idle['jitter_ms']['p99']} ms{busy}",
        f"hop {told['hop']} frames; p50/p95 ms of its stages: {stages}",
        f"CPU seconds a second: {told['cpu_s_per_s']}; resident MB: {told['resident_mb']}",
        f"with a file: {compared['in_time_share']} of ticks in time, jitter p99 {compared['jitter_ms']['p99']} ms, "
        f"sound to goal p50 {compared['sound_to_goal_ms']['p50']} ms, p95 {compared['sound_to_goal_ms']['p95']} ms",
    ]
