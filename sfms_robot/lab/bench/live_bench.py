"""`bench live`: a head that listens live, with a microphone and a phone, in real time.

    idle          an empty loop of 100 Hz: the punctuality of this machine without load from this program
    live          the measured run of `face28` and `sfms-small`, on servos with the timing of a wire, with a recording
    file          the same head and listener with a recorded person, for comparison
    first_write   time from typing `run` with live sources to its first goal on the wire; median of some starts

The microphone is a null sink of a private PulseAudio server into which a recorded voice is played, so that PortAudio's
callbacks, the audio process and the grid are those of a real microphone; "push" passes the same voice by function
calls. The phone sends recorded packets of Live Link Face at their pace. A run is a separate process, so that processor
time and memory are those of a run.
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
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
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
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_S, Plan, SpeakerFrame
from sfms_robot.lab import Figures
from sfms_robot.lab.bench.measure import (
    HEAD,
    LISTENER,
    BenchResult,
    ResidentMemory,
    Say,
    package_environment,
    result_of,
)
from sfms_robot.lab.bench.startup_bench import start_and_end
from sfms_robot.ports import Observer, Source, Tick
from sfms_robot.processes import realtime_priority
from sfms_robot.runtime.clock import RealClock, tick_times
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.quantiles import Quantiles
from sfms_robot.sources.live_link import open_live_link
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.push import PushedVoice
from sfms_robot.sources.registry import DEFAULT_SPEAKER, open_source, shipped_speaker

Audio = Literal["mic", "push"]
SINK: Final = "person"
GOALS: Final = {  # upper limits, except the share of ticks in time
    "in_time_share": 0.999, "jitter_p99_ms": 0.5, "sound_to_goal_p50_ms": 95, "sound_to_goal_p95_ms": 135,
    "face_to_goal_p95_ms": 80, "first_write_s": 2.2,
}  # fmt: skip
_MINUTES: Final = 10.0
_IDLE_S, _IDLE_HZ = 5.0, 100.0
_FILE_S: Final = 60.0
_STARTS: Final = 5
_BUSY_JITTER_MS: Final = 0.5  # p99 jitter of an empty loop above which the machine counts as busy
_PIECE: Final = 160  # samples that are pushed at once
_MEMORY_LOOKS: Final = 200
_CHILD: Final = "from sfms_robot.lab.bench.live_bench import measured_run; measured_run()"


def live(minutes: float, audio: Audio, say: Say) -> BenchResult:
    """Measure all four parts, one after the other; Linux only. 0 minutes means ten minutes.

    Raises ConfigError if `audio` needs PulseAudio and it is not installed, BusError if the run fails.
    """
    check_audio(audio)
    run_s = (minutes or _MINUTES) * 60
    say("an empty loop")
    idle = idle_loop(_IDLE_S)
    with TemporaryDirectory() as folder, live_person(Path(folder), audio) as person:
        say(f"a live run of {run_s / 60:g} minutes")
        live = _run(person.environment, audio=audio, face=person.face, duration_s=run_s, record=f"{folder}/run")
        say("the same with a recorded person")
        file = _run({}, audio="default", face="auto", duration_s=min(run_s, _FILE_S), record=None)
        say("`run` until its first goal")
        words = ["--head", str(patient_head(Path(folder))), "--audio", audio, "--face", person.face]
        starts = [start_and_end({**os.environ, **person.environment}, words) for _ in range(_STARTS)]
    typed_s = float(np.median([each["first_goal"] for each in starts]))  # NaN if one of them wrote no goal
    result = {
        "audio": audio,
        "idle": idle,
        "live": live,
        "file": file,
        "first_write_s": None if np.isnan(typed_s) else typed_s,
    }
    found = goals(result)
    met = {True: "yes", False: "no", None: "-"}
    table = [{"what": name, **row, "met": met[row["met"]]} for name, row in found.items()]
    return BenchResult({**result, "goals": found}, table, _lines(result))


def idle_loop(duration_s: float) -> Figures:
    """Measure the jitter of a loop of 100 Hz that does nothing, at the priority of a run, and the load. Blocks."""
    clock, late_ms = RealClock(), Quantiles()
    with realtime_priority(wanted=True) as priority:
        for tick in tick_times(clock, _IDLE_HZ, clock.now_s()):
            if tick.time_s > duration_s:
                break
            late_ms.add((tick.late_s + tick.skipped / _IDLE_HZ) * 1e3)
    jitter_ms = late_ms.report(p50=50, p99=99, max=100)
    busy = late_ms.at(99) > _BUSY_JITTER_MS or load() > (os.cpu_count() or 1) / 2
    return {"jitter_ms": jitter_ms, "busy": busy, "load": load(), "cores": os.cpu_count(), "priority": priority}


def load() -> float:
    return round(os.getloadavg()[0], 2)


def goals(result: Figures) -> dict[str, Figures]:
    """Return each of `GOALS` with the measured figure and whether it is met; None where it was not measured."""
    live = result["live"]
    came = {
        "in_time_share": live["in_time_share"],
        "jitter_p99_ms": live["jitter_ms"]["p99"],
        "sound_to_goal_p50_ms": live["sound_to_goal_ms"]["p50"],
        "sound_to_goal_p95_ms": live["sound_to_goal_ms"]["p95"],
        "face_to_goal_p95_ms": live["face_to_goal_ms"]["p95"],
        "first_write_s": result["first_write_s"],
    }
    return {
        name: {
            "measured": (value := came[name]),
            "wanted": wanted,
            "met": None if value is None else value >= wanted if name == "in_time_share" else value <= wanted,
        }
        for name, wanted in GOALS.items()
    }


def _lines(result: Figures) -> Sequence[str]:
    live, idle, file = result["live"], result["idle"], result["file"]
    stages = ", ".join(f"{name} {ms['p50']}/{ms['p95']}" for name, ms in live["stages_ms"].items())
    busy = "; other programs use this machine too, so the figures mean little" if idle["busy"] else ""
    return [
        f"load {live['load']} on {idle['cores']} cores; empty loop: jitter p99 {idle['jitter_ms']['p99']} ms{busy}",
        f"hop {live['hop']} frames; p50/p95 ms of its stages: {stages}",
        f"resident MB: {live['resident_mb']}",
        f"with a file: {file['in_time_share']} of ticks in time, jitter p99 {file['jitter_ms']['p99']} ms, "
        f"sound to goal p50 {file['sound_to_goal_ms']['p50']} ms, p95 {file['sound_to_goal_ms']['p95']} ms",
    ]


# --- stages of the time between a sound and the servos ---------------------------------------------------------------
#
# The stages are computed from the time stamps of samples, frames and plans:
#
#     hop      from a sample to the end of the frame with which the listener plans
#     block    until the source has that frame (the latency that the source states)
#     grid     until a tick passes the frame to the listener
#     plan     until a tick has the listener's plan
#     write    until the goals of that tick are written
#
# Their sum is the time from a sample at the microphone to the first goal of a plan that uses it. It is measured for
# four samples of each frame, ten milliseconds apart. The delay of a face begins at the arrival of its packet.

SETTLED_S: Final = 5.0  # until then the listener catches up with speech from before it was ready
STAGES: Final = ("hop", "block", "grid", "plan", "write")
_SAMPLES: Final = 4  # measured samples of a frame
_REMEMBERED: Final = 100  # frames


class Stamps(Observer):
    """An observer that measures the stages. Its memory does not grow with the run.

    Args:
        latency_s: Returns the latency that the source states.
        rate_hz: Ticks due per second.
        now_s: Returns the time on the clock of `Tick.origin_s`.
    """

    def __init__(
        self, latency_s: Callable[[], float], rate_hz: float, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._latency_s, self._rate_hz, self._now_s = latency_s, rate_hz, now_s
        self._origin_s = 0.0
        self._heard: dict[int, tuple[float, float]] = {}  # frame -> time at which a tick passed it on, source latency
        self._waiting: deque[SpeakerFrame] = deque(maxlen=_REMEMBERED)
        self._plans: list[tuple[float, float]] = []  # of this tick: made_at_s, time at which it was received
        self._stages = {name: Quantiles() for name in STAGES}
        self._sound, self._face = Quantiles(), Quantiles()
        self._last_face_s = -1.0
        self._first_s: float | None = None
        self._last_s = 0.0
        self._ticks = 0

    def heard(self, frame: SpeakerFrame) -> None:
        index = round(frame.time_s * FRAME_HZ)
        self._heard[index] = self._now_s(), self._latency_s()
        self._heard.pop(index - _REMEMBERED, None)
        self._waiting.append(frame)

    def planned(self, plan: Plan) -> None:
        self._plans.append((plan.made_at_s, self._now_s()))

    def tick(self, seen: Tick) -> None:
        self._first_s = seen.time_s if self._first_s is None else self._first_s
        self._last_s, self._ticks = seen.time_s, self._ticks + 1
        self._origin_s = self._origin_s if seen.origin_s is None else seen.origin_s
        written_s = self._now_s() - self._origin_s if seen.written_s is None else seen.written_s
        for made_at_s, taken_s in self._plans:
            self._followed(made_at_s, taken_s - self._origin_s, written_s)
        self._plans = []

    def _followed(self, made_at_s: float, taken_s: float, written_s: float) -> None:
        """Record the stages of every frame up to `made_at_s`, since the plan made from them is on the wire."""
        given_s, latency_s = self._heard.get(round(made_at_s * FRAME_HZ), (self._origin_s + made_at_s, 0.0))
        heard_s = given_s - self._origin_s
        late_s = max(0.0, heard_s - made_at_s)
        block_s = min(latency_s, late_s)
        while self._waiting and self._waiting[0].time_s <= made_at_s + FRAME_S / 2:
            frame = self._waiting.popleft()
            if frame.time_s < SETTLED_S:
                continue
            if frame.face is not None and frame.face.time_s > self._last_face_s:
                self._last_face_s = frame.face.time_s
                self._face.add(max(0.0, written_s - frame.face.time_s) * 1e3)
            if not len(frame.audio):
                continue
            for k in range(_SAMPLES):
                sample_s = frame.time_s - FRAME_S * (1 - k / _SAMPLES)
                parts_s = (made_at_s - sample_s, block_s, late_s - block_s, taken_s - heard_s, written_s - taken_s)
                for name, part_s in zip(STAGES, parts_s, strict=True):
                    self._stages[name].add(max(0.0, part_s) * 1e3)
                self._sound.add(max(0.0, written_s - sample_s) * 1e3)

    def report(self) -> Figures:
        """Return `ticks`, `missed_ticks`, `sound_to_goal_ms`, `stages_ms` and `face_to_goal_ms`."""
        due = 0 if self._first_s is None else round((self._last_s - self._first_s) * self._rate_hz) + 1
        return {
            "ticks": self._ticks,
            "missed_ticks": due - self._ticks,
            "sound_to_goal_ms": self._sound.report(p50=50, p95=95),
            "stages_ms": {name: each.report(p50=50, p95=95) for name, each in self._stages.items()},
            "face_to_goal_ms": self._face.report(p50=50, p95=95),
        }


# --- a person in front of the head ----------------------------------------------------------------------------------


class LivePerson:
    """A voice in a microphone and a phone in front of a face, inside the context of `live_person`.

    Attributes:
        environment: Variables with which a program finds the microphone.
        face: The value of `--face`.
        phone_silent: While it is set, the phone sends nothing.
        server: The PulseAudio server of the microphone; None without a microphone.
    """

    def __init__(self, environment: Mapping[str, str], port: int, server: SoundServer | None) -> None:
        self.environment, self.server = environment, server
        self.face = f"live-link:127.0.0.1:{port}"
        self.phone_silent = threading.Event()


def check_audio(audio: Audio) -> None:
    """Raise ConfigError if `audio` needs PulseAudio and it is missing."""
    if audio == "mic" and (missing := SoundServer.missing()) is not None:
        raise ConfigError(f"bench live: PulseAudio is not installed ({missing}, or --audio push)")


@contextmanager
def live_person(folder: Path, audio: Audio) -> Iterator[LivePerson]:
    """Start a voice and a phone, and stop them on leaving."""
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
    """Write `HEAD` with the read deadline of `--port sim`, since emulated servos share the cores of this computer."""
    place = folder / HEAD
    shutil.copytree(data_dir("configs") / "heads" / HEAD, place)
    raw = yaml.safe_load((place / "head.yaml").read_text(encoding="utf-8"))
    raw["buses"]["main"]["read_deadline_ms"] = deadline_s * 1e3
    raw.pop("calibrate_first", None)
    (place / "head.yaml").write_text(yaml.safe_dump(raw, sort_keys=False), encoding="utf-8")
    return place


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """Return a free port on loopback."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _send(person: LivePerson, over: threading.Event) -> None:
    """Send the phone's packets at their pace; packets of a silence are skipped, not sent later."""
    phone = EmulatedPhone(port=int(person.face.rpartition(":")[2]))
    began_s = time.monotonic()
    while not over.wait(1 / 240):
        if person.phone_silent.is_set():
            phone.sent = int((time.monotonic() - began_s) * 60) + 1
        else:
            phone.send_until(time.monotonic() - began_s)
    phone.close()


def _talk(server: SoundServer, over: threading.Event) -> None:
    """Play the voice in a loop; while the sink is missing, try again."""
    voice = shipped_speaker(DEFAULT_SPEAKER).audio
    while not over.is_set():
        player = server.play(SINK, voice)
        while player.poll() is None and not over.wait(0.1):
            pass
        if player.poll() is None:
            player.terminate()
        player.wait()
        over.wait(0.5)


# --- the run, in a separate process ---------------------------------------------------------------------------------


def _run(environment: Mapping[str, str], **options: Any) -> Figures:
    """Run `measured_run` in a process. Raises BusError with its last message if it fails."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", _CHILD, json.dumps(options)],
        env={**package_environment(), **environment}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    found: Figures = result_of(done.returncode, done.stderr, done.stdout, "live")
    return found


def measured_run() -> None:
    """Run a session in the child process with the options of the first argument (JSON); print the figures as JSON."""
    options = json.loads(sys.argv[1])
    record = None if options["record"] is None else Path(options["record"])
    over = threading.Event()
    source = _source(options["audio"], options["face"], options["duration_s"], over)
    rate_hz = max(bus.rate_hz for bus in load_head(HEAD).buses.values())
    stamps = Stamps(lambda: source.latency_s, rate_hz)
    memory = ResidentMemory(options["duration_s"] / _MEMORY_LOOKS)
    how = {"listener": LISTENER, "duration_s": options["duration_s"], "record": record}
    try:
        with TemporaryDirectory() as folder, launch(emulated(load_head(HEAD))["main"], timing="wire") as chain:
            head = str(patient_head(Path(folder), chain.read_deadline_s))
            report = run(
                RunOptions(head=head, port=chain.device, yes=True, **how),
                source=source,
                observers=[stamps, memory],
            )
    finally:
        over.set()
        source.close()
    stamped = stamps.report()
    due = stamped["ticks"] + stamped["missed_ticks"]
    settled = memory.resident_mb[len(memory.resident_mb) // 5 :]  # after a fifth of the time
    measured = {
        **stamped,
        "in_time_share": round((stamped["ticks"] - report["tick"]["late"]) / due, 5) if due else None,
        "jitter_ms": report["tick"]["jitter_ms"],
        "hop": report["hop"],
        "budget_ms": report["budget_ms"],
        "listener_step_ms": report["listener_step_ms"],
        "skipped_frames": report["listener_state"]["skipped_frames"],
        "resident_mb": {"settled": round(settled[0], 2), "growth": round(settled[-1] - settled[0], 2)}
        if settled
        else {},
        "overruns": report["source"].get("overruns"),
        "wait_ms": report["source"].get("wait_ms"),
        "recording": report.get("recording"),
        "exit": report["exit"],
        "load": load(),
    }
    sys.stdout.write(json.dumps(measured) + "\n")


def _source(audio: str, face: str, duration_s: float, over: threading.Event) -> Source:
    if audio != "push":
        return open_source(audio, face, duration_s)
    voice = PushedVoice()

    def push() -> None:
        """Push the recorded voice in pieces of 10 ms, at its pace."""
        samples, began_s, piece = read_audio(shipped_speaker(DEFAULT_SPEAKER).audio), time.monotonic(), 0
        while not over.wait(max(0.0, began_s + (piece + 1) * _PIECE / AUDIO_HZ - time.monotonic())):
            start = piece * _PIECE % (len(samples) - _PIECE)
            voice.hear(np.asarray(samples[start : start + _PIECE], np.float32), AUDIO_HZ)
            piece += 1

    threading.Thread(target=push, daemon=True).start()
    return PairedSource(voice, open_live_link(face.partition(":")[2]), None, duration_s)
