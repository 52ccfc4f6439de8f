"""A process of one listener, alone: when its first plan is there, and what memory it takes.

    stdout    "plan" at the first plan, then one JSON object: resident_mb, peak_mb after `HEARD_FRAMES` more

It loads no more than `listeners.process` does.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, cast

import numpy as np

from sfms_robot.errors import ModelError
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, SpeakerFrame
from sfms_robot.lab.bench.procfs import memory_mb
from sfms_robot.listeners.engine import EngineName

REPEATS: Final = 3
HEARD_FRAMES: Final = 50
CALL: Final = f"from {__name__} import main; main()"


@dataclass(frozen=True)
class ProcessFigures:
    """Medians: from its start to its first plan; resident memory of a process that listens, and the most it ever had
    (NaN where /proc does not tell).
    """

    first_plan_s: float
    resident_mb: float
    peak_mb: float


def listener_process(folder: Path, engine: EngineName, repeats: int = REPEATS) -> ProcessFigures:
    """Start it so many times. Blocks for a second or two each. Raises ModelError where it ends early."""
    found = [_once(folder, engine) for _ in range(repeats)]
    return ProcessFigures(*(float(np.median(each)) for each in zip(*found, strict=True)))


def _once(folder: Path, engine: EngineName) -> tuple[float, float, float]:
    began_s = time.perf_counter()
    words = [sys.executable, "-P", "-c", CALL, str(folder), engine]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        planned = process.stdout.readline() == "plan\n"
        first_plan_s = time.perf_counter() - began_s
        last = process.stdout.readline()
    if process.returncode or not planned:
        raise ModelError(f"{folder}: a listener process on {engine} ended with exit code {process.returncode}")
    told = json.loads(last)
    return first_plan_s, told["resident_mb"], told["peak_mb"]


def main() -> None:
    """In the process: listen to silence with the listener of a folder, on one thread."""
    from sfms_robot.listeners.registry import load_listener

    folder, engine = sys.argv[1:]
    listener = load_listener(Path(folder), engine=cast(EngineName, engine), threads=1)
    memory: Any = listener.start(0)
    planned, frames = False, HEARD_FRAMES
    silence = np.zeros(FRAME_SAMPLES, np.float32)
    index = 0
    while frames:
        index += 1
        plan, memory = listener.step(SpeakerFrame(index * FRAME_S, silence), memory)
        if planned:
            frames -= 1
        elif plan is not None:
            planned = True
            _say("plan")
    _say(json.dumps({"resident_mb": _own_mb("VmRSS"), "peak_mb": _own_mb("VmHWM")}))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _own_mb(key: Literal["VmRSS", "VmHWM"]) -> float:
    """Of this process, Linux only."""
    try:
        return memory_mb(key) or float("nan")
    except OSError:
        return float("nan")
