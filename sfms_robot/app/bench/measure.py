"""How a bench measures: durations, and a row with the ratio to a peer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError

HEAD = "face28"
LISTENER = "sfms-small"
Row = dict[str, Any]
# -P: what the folder of the caller holds is not what is measured.
MAIN: Final = ("-P", "-c", "from sfms_robot.cli.main import main; main()")


def row(ours: list[float], peers: list[float], unit: str, peer: str) -> Row:
    median, peer_median = float(np.median(ours)), float(np.median(peers))
    return {
        "median": median,
        "p99": float(np.percentile(ours, 99)),
        "unit": unit,
        "peer": peer,
        "peer_median": peer_median,
        "ratio": median / peer_median,
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
    """That finds the package of another checkout or installation first."""
    return {**os.environ, "PYTHONPATH": str(folder)}


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
                found.setdefault(key, []).append(each["median"])
                units[key] = each["unit"]
    return {key: row(ours[key], theirs[key], units[key], str(against)) for key in ours if key in theirs}


def _rows(name: str, env: Mapping[str, str] | None) -> dict[str, Row]:
    done = subprocess.run(
        [sys.executable, *MAIN, "bench", name, "--json"],
        capture_output=True, text=True, check=False, env=env,
        cwd=tempfile.gettempdir(),  # processes that it starts look in their own folder first
    )  # fmt: skip
    if done.returncode:
        raise ConfigError(f"bench {name}: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
    rows: dict[str, Row] = json.loads(done.stdout.splitlines()[-1])
    return rows
