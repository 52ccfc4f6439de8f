"""Process start and end of the command line, seen from outside, so that any installation can be measured.

    help, wrong_port, wrong_head    until the process is over
    first_goal                      `run` is typed -> its first goal position on the wire
    exit                            its last byte on the wire -> the process is over
    resident                        peak of the servo process; the listener's own process is not counted

`run` drives emulated servos behind a pseudo terminal of ours, which passes bytes on and looks at the clock.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import launch
from sfms_robot.lab.bench.measure import HEAD, MAIN, Row, environment, row
from sfms_robot.lab.bench.procfs import memory_mb
from sfms_robot.sources.registry import DEFAULT_SPEAKER

REPEATS: Final = 5
RUN_S: Final = 1.0
_GOAL: Final = b"\x83\x74\x00"  # Protocol 2.0: SYNC WRITE (0x83) at address 116, goal position
_LOOK_S: Final = 0.01
_CHUNK: Final = 4096


@dataclass
class WireTimes:
    """What a run did on the wire, in seconds of the monotonic clock, and its peak resident memory."""

    began_s: float
    first_goal_s: float | None = None
    last_byte_s: float = 0.0
    ended_s: float = 0.0
    resident_mb: float = 0.0
    tail: bytes = field(default=b"", repr=False)

    def host(self, data: bytes) -> None:
        """Bytes from the host."""
        self.last_byte_s = time.monotonic()
        if self.first_goal_s is None:
            if _GOAL in self.tail + data:
                self.first_goal_s = self.last_byte_s
            self.tail = data[-len(_GOAL) :]


def startup(against: Path | None = None) -> dict[str, Row]:
    """Rows of `sfms-robot bench startup`; their peer is the installation in folder `against`, else a bare Python."""
    peer = "python -c pass" if against is None else str(against)
    other = None if against is None else environment(against)
    ended = {
        "help": ["--help"],
        "wrong_port": ["run", "--port", "/dev/ttyNOBODY", "--duration", "1"],
        "wrong_head": ["run", "--head", "nobody", "--duration", "1"],
    }
    rows: dict[str, Row] = {}
    for name, words in ended.items():
        ours, theirs = [], []
        for _ in range(REPEATS):
            ours.append(_duration_s([*MAIN, *words], None))
            theirs.append(_duration_s(["-c", "pass"] if other is None else [*MAIN, *words], other))
        rows[f"startup.{name}"] = row(ours, theirs, "s", peer)
    mine, its = [], []
    for _ in range(REPEATS):
        mine.append(_run(None))
        if other is not None:
            its.append(_run(other))
    for key in ("first_goal", "exit", "resident"):
        unit = "MB" if key == "resident" else "s"
        ours = [_figure(seen, key) for seen in mine]
        theirs = [_figure(seen, key) for seen in its]
        bare = [_duration_s(["-c", "pass"], None)] if unit == "s" else [_bare_mb()]
        rows[f"startup.{key}"] = row(ours, theirs or bare, unit, peer)
    return rows


def _figure(seen: WireTimes, key: str) -> float:
    if key == "resident":
        return seen.resident_mb
    if seen.first_goal_s is None:
        return float("nan")
    return seen.first_goal_s - seen.began_s if key == "first_goal" else seen.ended_s - seen.last_byte_s


def _duration_s(words: Sequence[str], env: Mapping[str, str] | None) -> float:
    began_s = time.perf_counter()
    subprocess.run([sys.executable, *words], capture_output=True, check=False, env=env)
    return time.perf_counter() - began_s


def _bare_mb() -> float:
    code = "print([l for l in open('/proc/self/status') if l.startswith('VmHWM')][0].split()[1])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return int(done.stdout) / 1024


def first_goal_s(words: Sequence[str], env: Mapping[str, str] | None = None) -> float | None:
    """`run` with these words is typed -> its first goal position on the wire; None when none came. Blocks."""
    seen = _run(env, words)
    return None if seen.first_goal_s is None else seen.first_goal_s - seen.began_s


def _run(env: Mapping[str, str] | None, more: Sequence[str] = ("--audio", DEFAULT_SPEAKER)) -> WireTimes:
    """One second of listening on emulated servos, in real time."""
    head = load_head(HEAD)
    with launch(emulated(head)["main"]) as chain, _relay(chain.device, head.buses["main"].baud) as (port, hosts):
        words = ["run", "--head", HEAD, "--port", port, "--duration", str(RUN_S), "--seed", "1", "--json", *more]
        seen = WireTimes(time.monotonic())
        hosts.append(seen)
        process = subprocess.Popen(
            [sys.executable, *MAIN, *words], env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while process.poll() is None:
            seen.resident_mb = max(seen.resident_mb, _peak_mb(process.pid))
            time.sleep(_LOOK_S)
        seen.ended_s = time.monotonic()
    return seen


def _peak_mb(pid: int) -> float:
    try:
        return memory_mb("VmHWM", pid) or 0.0
    except OSError:
        return 0.0  # just over


@contextmanager
def _relay(device: str, baud: int) -> Iterator[tuple[str, list[WireTimes]]]:
    """A pseudo terminal in front of another one: its name, and who is told of the host's bytes."""
    import termios
    import tty

    import serial

    near, far = os.openpty()
    tty.setraw(far, termios.TCSANOW)
    line = serial.Serial(device, baud)  # an emulated servo hears its own baud rate only
    servos = line.fileno()
    told: list[WireTimes] = []
    over = threading.Event()

    def carry() -> None:
        while not over.is_set():
            ready, _, _ = select.select([near, servos], [], [], 0.05)
            for source in ready:
                data = os.read(source, _CHUNK)
                if source == near:
                    for seen in told:
                        seen.host(data)
                os.write(servos if source == near else near, data)

    thread = threading.Thread(target=carry, daemon=True)
    thread.start()
    try:
        yield os.ttyname(far), told
    finally:
        over.set()
        thread.join()
        line.close()
        os.close(near)
        os.close(far)
