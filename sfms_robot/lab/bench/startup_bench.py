"""`bench startup`: start and end of commands, seen from outside, so that any installation can be measured.

    help, wrong_port, wrong_head    until the process is over
    first_goal                      from typing `run` to its first goal position on the wire
    exit                            from its last byte on the wire until the process is over
    resident                        peak memory of the servo process, without the listener's process

`run` drives emulated servos through a pseudo terminal that passes bytes on and takes their times.
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
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import launch
from sfms_robot.lab.bench.measure import HEAD, MAIN, Row, environment, memory_mb, row
from sfms_robot.sources.registry import DEFAULT_SPEAKER

_REPEATS: Final = 5
_RUN_S: Final = 1.0
_GOAL: Final = b"\x83\x74\x00"  # Protocol 2.0: SYNC WRITE (0x83) at address 116, goal position
_LOOK_S: Final = 0.01
_CHUNK: Final = 4096


@dataclass
class WireTimes:
    """Times of a run on the monotonic clock [s], and its peak resident memory."""

    began_s: float
    _: KW_ONLY
    first_goal_s: float = float("nan")
    last_byte_s: float = 0.0
    ended_s: float = 0.0
    resident_mb: float = 0.0
    tail: bytes = field(default=b"", repr=False)

    def host(self, data: bytes) -> None:
        """Note bytes from the host."""
        self.last_byte_s = time.monotonic()
        if np.isnan(self.first_goal_s):
            if _GOAL in self.tail + data:
                self.first_goal_s = self.last_byte_s
            self.tail = data[-len(_GOAL) :]

    def figures(self) -> dict[str, float]:
        return {
            "first_goal": self.first_goal_s - self.began_s,
            "exit": self.ended_s - self.last_byte_s,
            "resident": self.resident_mb,
        }


def startup(against: Path | None = None) -> dict[str, Row]:
    """Return all rows; their peer is the installation in folder `against`, else a bare Python."""
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
        for _ in range(_REPEATS):
            ours.append(_duration_s([*MAIN, *words], None))
            theirs.append(_duration_s(["-c", "pass"] if other is None else [*MAIN, *words], other))
        rows[f"startup.{name}"] = row(ours, theirs, "s", peer)
    mine, its = [], []
    for _ in range(_REPEATS):
        mine.append(_run(None).figures())
        if other is not None:
            its.append(_run(other).figures())
    for key in mine[0]:
        unit = "MB" if key == "resident" else "s"
        if its:
            theirs = [seen[key] for seen in its]
        else:
            theirs = [_duration_s(["-c", "pass"], None) if unit == "s" else _bare_mb()]
        rows[f"startup.{key}"] = row([seen[key] for seen in mine], theirs, unit, peer)
    return rows


def _duration_s(words: Sequence[str], env: Mapping[str, str] | None) -> float:
    began_s = time.perf_counter()
    subprocess.run([sys.executable, *words], capture_output=True, check=False, env=env)
    return time.perf_counter() - began_s


def _bare_mb() -> float:
    """Return the peak memory of a bare Python."""
    code = "print([l for l in open('/proc/self/status') if l.startswith('VmHWM')][0].split()[1])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return int(done.stdout) / 1024


def first_goal_s(words: Sequence[str], env: Mapping[str, str] | None = None) -> float | None:
    """Return the time from typing `run` with these words to its first goal on the wire; None without one. Blocks."""
    seen_s = _run(env, words).figures()["first_goal"]
    return None if np.isnan(seen_s) else seen_s


def _run(env: Mapping[str, str] | None, more: Sequence[str] = ("--audio", DEFAULT_SPEAKER)) -> WireTimes:
    """Listen for one second on emulated servos, in real time."""
    head = load_head(HEAD)
    with launch(emulated(head)["main"]) as chain, _relay(chain.device, head.buses["main"].baud) as (port, hosts):
        words = ["run", "--head", HEAD, "--port", port, "--duration", str(_RUN_S), "--seed", "1", "--json", *more]
        seen = WireTimes(time.monotonic())
        hosts.append(seen)
        process = subprocess.Popen(
            [sys.executable, *MAIN, *words], env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while process.poll() is None:
            seen.resident_mb = max(seen.resident_mb, memory_mb("VmHWM", process.pid))  # a NaN changes nothing
            time.sleep(_LOOK_S)
        seen.ended_s = time.monotonic()
    return seen


@contextmanager
def _relay(device: str, baud: int) -> Iterator[tuple[str, list[WireTimes]]]:
    """Put a pseudo terminal in front of another one; yield its name, and a list of receivers of the host's bytes."""
    import termios
    import tty

    import serial

    near, far = os.openpty()
    tty.setraw(far, termios.TCSANOW)
    line = serial.Serial(device, baud)  # an emulated servo receives at its baud rate only
    servos = line.fileno()
    receivers: list[WireTimes] = []
    over = threading.Event()

    def carry() -> None:
        while not over.is_set():
            ready, _, _ = select.select([near, servos], [], [], 0.05)
            for source in ready:
                data = os.read(source, _CHUNK)
                if source == near:
                    for seen in receivers:
                        seen.host(data)
                os.write(servos if source == near else near, data)

    thread = threading.Thread(target=carry, daemon=True)
    thread.start()
    try:
        yield os.ttyname(far), receivers
    finally:
        over.set()
        thread.join()
        line.close()
        os.close(near)
        os.close(far)
