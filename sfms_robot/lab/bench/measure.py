"""How a bench measures: durations, and a row with the ratio to a peer."""

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
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.processes import cores

HEAD = "face28"
LISTENER = "sfms-small"
Row = dict[str, Any]
# -P: what the folder of the caller holds is not what is measured.
MAIN: Final = ("-P", "-c", "from sfms_robot.cli.main import main; main()")


@dataclass(frozen=True)
class Told:
    """What a bench found.

    Attributes:
        figures: all of it, as plain data.
        table: a row per line, for people; `lines` says what it leaves out.
        passed: whether everything is as it has to be.
    """

    figures: dict[str, Any]
    table: Sequence[Mapping[str, Any]]
    lines: Sequence[str] = ()
    passed: bool = True

    @classmethod
    def of_rows(cls, rows: Mapping[str, Row]) -> Told:
        """Of a bench whose figures are rows with a ratio to a peer; each says on what machine."""
        rows = {name: {**each, "machine": machine()} for name, each in rows.items()}
        columns = {"median": "median", "unit": "unit", "p99": "p99", "ratio": "ratio", "peer": "to"}
        table = [{"measured": name} | {columns[key]: each.get(key) for key in columns} for name, each in rows.items()]
        return cls(rows, table)


def machine() -> str:
    """The computer that is measured, in a line: cores that this process may use, processor, system, Python."""
    system = f"{platform.system()} {platform.release()}"
    return f"{cores()} cores of {_processor()}, {system}, Python {platform.python_version()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model")))
    return next(named, "") or platform.processor() or platform.machine()


def row(ours: list[float], peers: list[float], unit: str, peer: str) -> Row:
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


def times(call: Callable[[], object], count: int, clock: Callable[[], float] = time.perf_counter) -> list[float]:
    """`count` durations of `call` [ms] after a tenth as many to warm up."""
    for _ in range(max(1, count // 10)):
        call()
    out = []
    for _ in range(count):
        began = clock()
        call()
        out.append((clock() - began) * 1e3)
    return out


def environment(folder: Path) -> Mapping[str, str]:
    """That finds the package of another checkout or installation first. Raises ConfigError where there is none."""
    if not (folder / "sfms_robot" / "__init__.py").is_file():
        raise ConfigError(f"--against {folder}: no sfms_robot in it; a checkout, or a folder of packages that has one")
    return {**os.environ, "PYTHONPATH": str(folder.resolve())}


def beside(name: str, against: Path, repeats: int = 3) -> dict[str, Row]:
    """`bench NAME` of this installation and of the one in folder `against`, in turn: rows that both have.

    Raises ConfigError where the other one does not run.
    """
    ours: dict[str, list[float]] = {}
    theirs: dict[str, list[float]] = {}
    units: dict[str, str] = {}
    for _ in range(repeats):
        for found, env in ((ours, None), (theirs, environment(against))):
            for key, each in _rows(name, env).items():
                if not isinstance(each, dict) or "median" not in each:
                    raise ConfigError(f"--against {against}: 'bench {name}' has no rows to lay beside others")
                found.setdefault(key, []).append(each["median"])
                units[key] = each["unit"]
    return {key: row(ours[key], theirs[key], units[key], str(against)) for key in ours if key in theirs}


def _rows(name: str, env: Mapping[str, str] | None) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, *MAIN, "bench", name, "--json"],
        capture_output=True, text=True, check=False, env=env,
        cwd=tempfile.gettempdir(),  # processes that it starts look in their own folder first
    )  # fmt: skip
    if done.returncode:
        raise ConfigError(f"bench {name}: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
    rows: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return rows
