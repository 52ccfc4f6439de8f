"""Shared tools of the benches: durations, rows with a peer, figures of processes, docs/science/performance.md."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal, cast

import numpy as np

from sfms_robot.errors import BusError, ConfigError, ModelError
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, SpeakerFrame
from sfms_robot.lab import Figures
from sfms_robot.listeners.engine import EngineName
from sfms_robot.ports import Observer, Tick
from sfms_robot.processes import cores

HEAD: Final = "face28"
LISTENER: Final = "sfms-small"
Row = Figures
Rows = dict[str, Row]  # by name
Say = Callable[[str], None]  # prints a line of progress
# -P: the caller's current folder must not shadow the measured installation.
MAIN: Final = ("-P", "-c", "from sfms_robot.cli.main import main; main()")
_PAGE: Final = """# Measured by `sfms-robot bench`

Written by `make bench`, {when}, on {machine}, in {minutes:.1f} minutes.
Speeds hold for that machine. The ratio to a peer, measured in the same run, carries over to other machines.

| measured | median | p99 | ratio | to | repeats |
|---|---|---|---|---|---|
"""


@dataclass(frozen=True)
class BenchResult:
    """The outcome of a bench.

    Attributes:
        figures: All figures, as plain data (`--json`).
        table: The rows that are printed; `lines` are printed below them.
        passed: False makes the exit code 1.
    """

    figures: Figures
    table: Sequence[Mapping[str, Any]]
    lines: Sequence[str] = ()
    passed: bool = True

    @classmethod
    def of_rows(
        cls, rows: Mapping[str, Row], lines: Sequence[str] = (), passed: bool = True, **more: Any
    ) -> BenchResult:
        """Return the result of a bench with the figures `rows` and `more`; each row gets the name of this machine."""
        rows = {name: {**each, "machine": machine()} for name, each in rows.items()}
        shown = ("median", "unit", "p99", "ratio")
        table = [
            {"measured": name, **{key: each.get(key) for key in shown}, "to": each.get("peer")}
            for name, each in rows.items()
        ]
        return cls({**rows, **more}, table, lines, passed)


def machine() -> str:
    """Return one line about this computer: usable cores, processor, system, Python."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model")))
    processor = next(named, "") or platform.processor() or platform.machine()
    system = f"{platform.system()} {platform.release()}"
    return f"{cores()} cores of {processor}, {system}, Python {platform.python_version()}"


def row(ours: Sequence[float], peers: Sequence[float], unit: str, peer: str) -> Row:
    """Return median and p99 of our measurements, the median of the peer's, and the ratio of the medians."""
    median, peer_median = float(np.median(ours)), float(np.median(peers))
    return {
        "median": median,
        "p99": float(np.percentile(ours, 99)),
        "unit": unit,
        "peer": peer,
        "peer_median": peer_median,
        "ratio": median / peer_median,
        "repeats": len(ours),
    }


def percentiles(values: Sequence[float]) -> dict[str, float]:
    return {"p50": float(np.percentile(values, 50)), "p99": float(np.percentile(values, 99))}


def times(call: Callable[[], object], count: int, clock: Callable[[], float] = time.perf_counter) -> list[float]:
    """Return `count` durations of `call` [ms], measured after a tenth as many calls to warm up."""
    for _ in range(max(1, count // 10)):
        call()
    out = []
    for _ in range(count):
        began = clock()
        call()
        out.append((clock() - began) * 1e3)
    return out


# --- another installation -------------------------------------------------------------------------------------------

_COMPARED: Final = 3  # runs of each installation


def environment(folder: Path) -> Mapping[str, str]:
    """Return an environment in which Python finds the package in `folder` first. Raises ConfigError if it has none."""
    if not (folder / "sfms_robot" / "__init__.py").is_file():
        raise ConfigError(f"--against {folder}: no sfms_robot in it; a checkout, or a folder of packages that has one")
    return {**os.environ, "PYTHONPATH": str(folder.resolve())}


def compare_installations(name: str, against: Path) -> Rows:
    """Run `bench NAME` of this installation and of the one in `against` in turn; return the rows that both have.

    Raises ConfigError if the other installation does not run, or the bench has no rows.
    """
    ours: dict[str, list[float]] = {}
    theirs: dict[str, list[float]] = {}
    units: dict[str, str] = {}
    for _ in range(_COMPARED):
        for found, env in ((ours, None), (theirs, environment(against))):
            done = subprocess.run(
                [sys.executable, *MAIN, "bench", name, "--json"],
                capture_output=True, text=True, env=env,
                cwd=tempfile.gettempdir(),  # child processes import from their current folder first
            )  # fmt: skip
            if done.returncode > 1 or not done.stdout:  # 1: a figure misses its limit
                raise ConfigError(f"bench {name}: {last_line(done.stderr)}")
            for key, each in json.loads(last_line(done.stdout)).items():
                if not isinstance(each, dict) or "median" not in each:
                    raise ConfigError(f"--against {against}: 'bench {name}' has no rows to compare")
                found.setdefault(key, []).append(each["median"])
                units[key] = each["unit"]
    return {key: row(ours[key], theirs[key], units[key], str(against)) for key in ours if key in theirs}


# --- processes ------------------------------------------------------------------------------------------------------


def package_environment() -> dict[str, str]:
    """Return an environment in which a child process imports from the same places as this process."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def last_line(text: str) -> str:
    """Return the last line of a child's output, "" if it has none."""
    return text.strip().rpartition("\n")[2]


def result_of(returncode: int | None, said: str, out: str, name: str) -> Any:
    """Return the JSON in the last line of `out`. Raises BusError with the last error line of a child that failed."""
    if returncode or not out:
        raise BusError(f"bench {name}: the run failed with exit code {returncode}: {last_line(said)}")
    return json.loads(last_line(out))


def processor_time_s(pid: int, thread: int | None = None) -> float:
    """Return user and kernel time since a process, or one of its threads, began (proc(5)).

    Raises OSError if the process has ended or there is no /proc.
    """
    place = f"/proc/{pid}/stat" if thread is None else f"/proc/{pid}/task/{thread}/stat"
    fields = Path(place).read_text(encoding="utf-8").rpartition(")")[2].split()
    ticks: float = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return ticks


def memory_mb(key: Literal["VmRSS", "VmHWM"], pid: int | Literal["self"] = "self") -> float:
    """Return resident memory now (VmRSS) or its peak (VmHWM) in MB; NaN for a process that ended, or without /proc."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return np.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{key}:")), np.nan)


def children_of(pid: int) -> list[int]:
    """Return the ids of the running processes that `pid` started. Raises OSError like `processor_time_s`."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            found += map(int, (task / "children").read_text(encoding="utf-8").split())
        except OSError:  # the thread has ended
            continue
    return found


class ResidentMemory(Observer):
    """An observer of the resident memory of this process, sampled every `every_s` of loop time."""

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self.times_s: list[float] = []
        self.resident_mb: list[float] = []

    def tick(self, seen: Tick) -> None:
        if seen.time_s >= len(self.times_s) * self._every_s:
            self.times_s.append(seen.time_s)
            self.resident_mb.append(memory_mb("VmRSS"))


# --- a listener in a process ----------------------------------------------------------------------------------------

_HEARD_FRAMES: Final = 50
_LISTENER_CHILD: Final = f"from {__name__} import listen_to_silence; listen_to_silence()"


def listener_process(folder: Path, engine: EngineName, repeats: int = 3) -> dict[str, float]:
    """Start a process with one listener `repeats` times. Blocks for a second or two each.

    Returns medians: time to the first plan, resident memory while listening, and its peak. Raises ModelError if the
    process ends early.
    """
    found = []
    for _ in range(repeats):
        began_s = time.perf_counter()
        words = [sys.executable, "-P", "-c", _LISTENER_CHILD, str(folder), engine]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            planned = process.stdout.readline() == "plan\n"
            first_plan_s = time.perf_counter() - began_s
            last = process.stdout.readline()
        if process.returncode or not planned:
            raise ModelError(f"{folder}: a listener process on {engine} ended with exit code {process.returncode}")
        found.append((first_plan_s, *json.loads(last)))
    return dict(zip(("first_plan_s", "resident_mb", "peak_mb"), np.median(found, axis=0).tolist(), strict=True))


def listen_to_silence() -> None:
    """Feed silence to the listener of a folder on one thread, in the child process.

    Prints "plan" at the first plan, then a JSON list of resident and peak memory [MB] after `_HEARD_FRAMES` more.
    """
    from sfms_robot.listeners.registry import load_listener

    folder, engine = sys.argv[1:]
    listener = load_listener(Path(folder), engine=cast(EngineName, engine), threads=1)
    memory: Any = listener.start(0)
    silence = np.zeros(FRAME_SAMPLES, np.float32)
    index, left = 0, None
    while left != 0:
        index += 1
        plan, memory = listener.step(SpeakerFrame(index * FRAME_S, silence), memory)
        if left is not None:
            left -= 1
        elif plan is not None:
            left = _HEARD_FRAMES
            sys.stdout.write("plan\n")
            sys.stdout.flush()
    sys.stdout.write(json.dumps([memory_mb("VmRSS"), memory_mb("VmHWM")]) + "\n")


# --- docs/science/performance.md --------------------------------------------------------------------------------------

_ON_A_GPU: Final = "\n## On a GPU\n"  # measured on other machines: this part of the page is kept


def write_page(file: Path, rows: Mapping[str, Any], minutes: float) -> None:
    """Write every row, and the conditions of the measurement, as a page; keep the page's part about GPUs.

    Raises ConfigError if the file cannot be written.
    """

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.3g}"

    lines = [
        f"| {name} | {each['median']:.4g} {each['unit']} | {number(each.get('p99'))} | {number(each.get('ratio'))} "
        f"| {each.get('peer', '-')} | {each.get('repeats', '-')} |"
        for name, each in rows.items()
        if isinstance(each, Mapping) and "median" in each
    ]
    head = _PAGE.format(when=datetime.now(UTC).date().isoformat(), machine=machine(), minutes=minutes)
    try:
        kept = file.read_text(encoding="utf-8").partition(_ON_A_GPU)[1:] if file.is_file() else ()
        file.write_text(head + "\n".join(lines) + "\n" + "".join(kept), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--write {file}: cannot be written: {error.strerror}") from error
