"""`bench startup`: start and end of commands, observed from outside, so that any installation can be measured.

    help, wrong_port, wrong_head    time until the process ends
    first_goal                      time from typing `run` until its servos have torque, in the tick of the first goal
    exit                            time from its last byte on the wire until the process ends
    resident                        peak memory of the servo process, without the listener's process

`run` drives emulated servos, whose state is read every few milliseconds.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import launch
from sfms_robot.lab.bench.measure import HEAD, MAIN, Rows, environment, memory_mb, row
from sfms_robot.sources.registry import DEFAULT_SPEAKER

_REPEATS: Final = 5
_RUN_S: Final = 1.0
_LOOK_S: Final = 0.004


def startup(against: Path | None = None) -> Rows:
    """Return all rows; their peer is the installation in folder `against`, else a bare Python."""
    peer = "python -c pass" if against is None else str(against)
    other = None if against is None else environment(against)
    ended = {
        "help": ["--help"],
        "wrong_port": ["run", "--port", "/dev/ttyNOBODY", "--duration", "1"],
        "wrong_head": ["run", "--head", "nobody", "--duration", "1"],
    }
    rows: Rows = {}
    for name, words in ended.items():
        ours, theirs = [], []
        for _ in range(_REPEATS):
            ours.append(_duration_s([*MAIN, *words], None))
            theirs.append(_duration_s(["-c", "pass"] if other is None else [*MAIN, *words], other))
        rows[f"startup.{name}"] = row(ours, theirs, "s", peer)
    runs = [(start_and_end(None), {} if other is None else start_and_end(other)) for _ in range(_REPEATS)]
    bare = {"s": _duration_s(["-c", "pass"], None), "MB": _bare_mb()}
    for key, unit in {"first_goal": "s", "exit": "s", "resident": "MB"}.items():
        theirs = [its.get(key, bare[unit]) for _, its in runs]
        rows[f"startup.{key}"] = row([mine[key] for mine, _ in runs], theirs, unit, peer)
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


def start_and_end(
    env: Mapping[str, str] | None, more: Sequence[str] = ("--audio", DEFAULT_SPEAKER)
) -> dict[str, float]:
    """Listen for one second on emulated servos, in real time; return `first_goal`, `exit` and `resident`.

    `more`: Further arguments of `run`. `first_goal` is NaN if there was no goal.
    """
    head = load_head(HEAD)
    with launch(emulated(head)["main"]) as chain:
        words = ["run", "--head", HEAD, "--port", chain.device, "--duration", str(_RUN_S), "--seed", "1", "--json"]
        servo, count, resident_mb, goal_s = chain.servos[-1].id, 0, 0.0, np.nan
        began_s = byte_s = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, *MAIN, *words, *more], env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while process.poll() is None:
            resident_mb = max(resident_mb, memory_mb("VmHWM", process.pid))  # a NaN changes nothing
            if np.isnan(goal_s) and chain.state(servo)["torque"]:
                goal_s = time.monotonic()
            if (received := chain.statistics()["bytes_in"]) != count:
                count, byte_s = received, time.monotonic()
            time.sleep(_LOOK_S)
        return {"first_goal": goal_s - began_s, "exit": time.monotonic() - byte_s, "resident": resident_mb}
