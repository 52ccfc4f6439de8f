"""`bench listener --budget`: what a frame of each listener costs, counted, and what small computers need for it.

Operations, bytes and calls of plain fp32 torch are counted as a stream runs (`app.operation_count`); what numpy does
beside the networks is in the time measured here, not in the counts. A board's time is then

    max(operations / (clock x operations a cycle x share reached), bytes / bandwidth) + calls x cost of one

on one core. None of it was run on such a board: the assumptions are told with the figures.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot import config
from sfms_robot.data import data_dir
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, FaceFrame, SpeakerFrame
from sfms_robot.lab.bench.measure import Told, machine
from sfms_robot.lab.bench.operation_count import OperationCount
from sfms_robot.listeners.registry import load_listener
from sfms_robot.ports import Listener

LISTENERS: Final = ("sfms-small", "arig-small")
FRAMES: Final = 32  # that are counted: whole hops
WARM_UP: Final = 16
REACHED: Final = 0.25  # of a core's peak, in products as small as these
FRAME_MS: Final = FRAME_S * 1e3


@dataclass(frozen=True)
class Board:
    """One core of a small computer: clock [GHz], fp32 operations a cycle, memory [GB/s], cost of a call [us]."""

    clock_ghz: float
    per_cycle: int
    memory_gb_s: float
    call_us: float

    def ms(self, operations: float, moved_bytes: float, calls: float) -> float:
        """Time of work on this core."""
        computed_s = operations / (self.clock_ghz * 1e9 * self.per_cycle * REACHED)
        return 1e3 * max(computed_s, moved_bytes / (self.memory_gb_s * 1e9)) + calls * self.call_us * 1e-3


BOARDS: Final = {
    "Raspberry Pi 4 (Cortex-A72)": Board(1.8, 8, 3.0, 12.0),
    "Raspberry Pi 5 (Cortex-A76)": Board(2.4, 16, 8.0, 5.0),
    "Jetson Orin Nano (Cortex-A78AE)": Board(1.5, 16, 15.0, 7.0),
}
ASSUMED: Final = (
    f"computed for one core, {REACHED:.0%} of its peak reached, nothing kept in a cache between two calls; "
    + "; ".join(
        f"{name}: {one.clock_ghz:g} GHz, {one.per_cycle} fp32 operations a cycle, {one.memory_gb_s:g} GB/s, "
        f"{one.call_us:g} us a call"
        for name, one in BOARDS.items()
    )
)


def budget() -> Told:
    """Counts, measured times and computed times of every shipped listener. Blocks for some seconds."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        figures: dict[str, Any] = {name: _counted(name) for name in LISTENERS}
    finally:
        torch.set_num_threads(threads)
    lines = [ASSUMED, f"a frame lasts {FRAME_MS:g} ms; measured on {machine()}; none was run on such a board"]
    return Told(
        {**figures, "assumed": ASSUMED, "machine": machine()}, [_row(name, figures[name]) for name in figures], lines
    )


def _counted(name: str) -> dict[str, Any]:
    folder = data_dir("configs") / "listeners" / name
    listener = load_listener(folder, graphs=False, engine="torch")
    settings = config.load_listener(folder / "config.yaml")
    memory: Any = listener.start(0)
    frames = _talk(WARM_UP + 2 * FRAMES)
    for frame in frames[:WARM_UP]:
        _, memory = listener.step(frame, memory)
    costs = []
    for frame in frames[WARM_UP : WARM_UP + FRAMES]:
        with OperationCount() as count:
            _, memory = listener.step(frame, memory)
        costs.append((count.operations, count.bytes, count.calls))
    operations, moved, calls = np.mean(costs, axis=0)
    most = max(costs)
    return {
        "precision": getattr(settings, "precision", "fp32"),
        "operations": round(float(operations)),
        "bytes": round(float(moved)),
        "calls": round(float(calls)),
        "largest_frame_operations": most[0],
        "here_ms": _measured_ms(listener, frames[-FRAMES:], memory),
        "boards": {
            board: {
                "ms": round(float(one.ms(operations, moved, calls)), 2),
                "largest_frame_ms": round(float(one.ms(*most)), 2),
                "share_of_a_core": round(float(one.ms(operations, moved, calls)) / FRAME_MS, 3),
            }
            for board, one in BOARDS.items()
        },
    }


def _measured_ms(listener: Listener, frames: list[SpeakerFrame], memory: Any) -> float:
    took_ms = []
    for frame in frames:
        began_s = time.perf_counter()
        _, memory = listener.step(frame, memory)
        took_ms.append(1e3 * (time.perf_counter() - began_s))
    return round(float(np.mean(took_ms)), 3)


def _talk(count: int) -> list[SpeakerFrame]:
    rng = np.random.default_rng(0)
    found = []
    for index in range(count):
        voice, own = (rng.normal(0, size, FRAME_SAMPLES).astype(np.float32) for size in (0.1, 1e-3))
        time_s = (index + 1) * FRAME_S
        found.append(SpeakerFrame(time_s, voice, FaceFrame.of(time_s, rng.uniform(0, 0.2, 58)), own))
    return found


def _row(name: str, counted: dict[str, Any]) -> dict[str, Any]:
    return {
        "listener": name,
        "M operations": round(counted["operations"] / 1e6, 2),
        "MB": round(counted["bytes"] / 1e6, 2),
        "calls": counted["calls"],
        "here ms": counted["here_ms"],
        **{f"{board.split(' (')[0]} ms": counted["boards"][board]["ms"] for board in BOARDS},
    }
