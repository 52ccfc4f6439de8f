"""How a bench measures: durations, and a row with the ratio to a peer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

HEAD = "face28"
LISTENER = "sfms-small"
Row = dict[str, Any]


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
