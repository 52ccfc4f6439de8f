"""`bench serve`: how many heads one server answers in time, and what each costs.

Heads send frames of a recorded person 25 times a second, each from its own place in the recording and at its own phase,
as bytes; what is measured lies between a frame's coming and its plan's going, as bytes again: the way to the process
that steps, parsing, waiting for a batch, the batch, the way back. The network is not in it (`bench live` and a run's
report have that). Nothing is left out of what a server does, and the processes are those of `serve`. The frames are
sent from this machine too.

The peer is the same listener asked for one head at a time by one core, which is what a server without batches would do.
"""

from __future__ import annotations

import queue
import struct
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.app.serve.batch_process import Served
from sfms_robot.app.serve.service import WorkerPool
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, SpeakerFrame
from sfms_robot.lab.bench.listener_bench import with_weights
from sfms_robot.lab.bench.measure import Told, machine
from sfms_robot.listeners.capacity import Capacity
from sfms_robot.listeners.remote_messages import (
    Join,
    Notice,
    SentFrame,
    Welcome,
    frame_message,
    parse_plan,
    parse_words,
    words_message,
)
from sfms_robot.listeners.stream_server import DEADLINE_S
from sfms_robot.signals.audio import read_audio
from sfms_robot.sources.registry import voice_file

NAMES: Final = ("sfms-small", "arig-small", "arig-paper")
SPEAKER: Final = "katie"
WARM_S: Final = 1.0
SECONDS: Final = 4.0
MOST: Final = 512
NOT_KEPT_UP_MS: Final = 10_000.0  # stands for a server that left frames out
_PERCENT: Final = 99.0
_ANSWER_S: Final = 30.0


def measure(say: Callable[[str], None]) -> Told:
    """Blocks for some minutes."""
    figures = {name: _served(name, say) for name in NAMES}
    table = [
        {
            "listener": name, "weights": each["weights"], "heads in time": each["median"], "p99 ms": each["p99_ms"],
            "hop": each["hop"], "one at a time": each["peer_median"], "ratio": each["ratio"],
            "batch": each["batch_size"],
            **{f"ms a frame, batch of {size}": each["cost_ms_per_head_and_frame"][size] for size in ("1", "8", "32")},
        }
        for name, each in figures.items()
    ]  # fmt: skip
    figures = {f"serve.{name}": each for name, each in figures.items()}
    return Told(figures, table, [f"within {DEADLINE_S * 1e3:.0f} ms, p99, a process for each of {machine()}"])


def _served(name: str, say: Callable[[str], None]) -> dict[str, Any]:
    messages, curve = _frames(), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as scratch:
        folder, weights = with_weights(name, Path(scratch))
        load = _Load()
        with closing(WorkerPool(Served(listener=str(folder), name="bench", all_heads=True), load.sent)) as pool:

            def in_time(heads: int) -> bool:
                curve.append(_loaded(pool, load, messages, heads))
                say(
                    f"{name}: {heads} heads, p99 {curve[-1]['p99_ms']:.0f} ms, batches of {curve[-1]['batch_size']:.1f}"
                )
                return float(curve[-1]["p99_ms"]) <= DEADLINE_S * 1e3

            most = _largest(in_time, start=max(1, pool.most))
    best = next((each for each in curve if each["heads"] == most), curve[0])
    capacity = pool.capacities[0]
    alone = _alone(capacity)
    return {
        "median": most,
        "unit": "heads",
        "weights": weights,
        "p99_ms": best["p99_ms"],
        "p50_ms": best["p50_ms"],
        "deadline_ms": DEADLINE_S * 1e3,
        "hop": pool.hop,
        "processes": len(pool.capacities),
        "expected": pool.most,
        "batch_size": best["batch_size"],
        "curve": sorted(curve, key=lambda each: int(each["heads"])),
        "cost_ms_per_head_and_frame": {
            str(size): round(_per_frame_s(capacity, size) * 1e3, 3) for size in capacity.sizes
        },
        "peer": "one head at a time, one core",
        "peer_median": alone,
        "ratio": round(most / max(alone, 1), 2),
        "repeats": len(curve),
        "machine": machine(),
    }


def _largest(in_time: Callable[[int], bool], start: int) -> int:
    """The most heads for which `in_time`, 0 for none: doubling or halving first, then bisection to a twentieth."""
    low, high = 0, 0
    heads = start
    while not high or not low:
        if in_time(heads):
            low = heads
            if high or heads >= MOST:
                break
            heads = min(2 * heads, MOST)
        else:
            high = heads
            if low or heads <= 1:
                break
            heads = max(1, heads // 2)
    while high and high - low > max(1, low // 20):
        middle = (low + high) // 2
        low, high = (middle, high) if in_time(middle) else (low, middle)
    return low


def _loaded(pool: WorkerPool, load: _Load, messages: Sequence[bytes], heads: int) -> dict[str, Any]:
    """One point of the curve: so many heads for `SECONDS`."""
    streams = [_join(pool, index) for index in range(heads)]
    load.begin()
    before = pool.statistics()
    rng = np.random.default_rng(heads)
    phases_s = np.sort(rng.uniform(0, FRAME_S, heads))
    shifts = rng.integers(0, len(messages), heads)
    began_s, frames = time.monotonic(), round((WARM_S + SECONDS) / FRAME_S)
    for number in range(frames):
        for index, stream in enumerate(streams):
            ahead_s = began_s + number * FRAME_S + phases_s[index] - time.monotonic()
            if ahead_s > 0:
                time.sleep(ahead_s)
            pool.receive(stream, _numbered(messages[(number + shifts[index]) % len(messages)], number))
    told = _since(before, pool.statistics())
    for stream in streams:
        pool.receive(stream, words_message(Notice("leave")))
    delays_ms = load.delays_ms(after=round(WARM_S / FRAME_S))
    if load.skipped or not delays_ms:
        delays_ms = [NOT_KEPT_UP_MS]
    p50, p99 = np.percentile(delays_ms, [50, _PERCENT])
    return {
        "heads": heads,
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
        "batch_size": round(told["steps"] / max(told["batches"], 1), 1),
        "cpu_ms_per_head_and_second": round(told["cpu_s"] / heads / (WARM_S + SECONDS) * 1e3, 2),
    }


def _since(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, float]:
    return {name: now[name] - before[name] for name in ("steps", "batches", "cpu_s")}


class _Load:
    """Takes what the server sends, and asks each plan how late it was."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget what came."""
        self._plans: list[tuple[bytes, float]] = []
        self.skipped = 0

    def sent(self, stream: str, message: bytes) -> None:
        """From the pool's threads."""
        if message[:1] != b"{":
            self._plans.append((message, time.monotonic()))
        else:
            said = parse_words(message)
            self.skipped += said.frames if isinstance(said, Notice) else 0

    def delays_ms(self, after: int) -> list[float]:
        """Of plans for frames from number `after` on: from the frame's coming to the plan's going."""
        sent = [(parse_plan(message), went_s) for message, went_s in self._plans]
        return [(went_s - each.came_s) * 1e3 for each, went_s in sent if each.number >= after]


def _join(pool: WorkerPool, index: int) -> str:
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    pool.join(words_message(Join(f"bench-{time.monotonic_ns()}-{index}", index)), answers.put)
    said = parse_words(answers.get(timeout=_ANSWER_S))
    assert isinstance(said, Welcome)  # everybody is admitted
    return said.stream


def _frames() -> list[bytes]:
    """Every frame of the recording as a message, of number 0."""
    file = voice_file(SPEAKER)
    if file is None:
        raise ConfigError(f"bench serve: speaker {SPEAKER!r} is not among the shipped ones")
    audio = read_audio(file)
    chunks = audio[: len(audio) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
    return [frame_message(SentFrame(0, SpeakerFrame(FRAME_S, chunk), 0.0)) for chunk in chunks]


def _numbered(message: bytes, number: int) -> bytes:
    """The same sound at another time: number and time stand behind kind, protocol and flags."""
    return message[:4] + struct.pack("<Id", number, (number + 1) * FRAME_S) + message[16:]


def _per_frame_s(capacity: Capacity, size: int) -> float:
    """What a head's frame costs in batches of `size`, plans shared out among the frames of a hop."""
    index = capacity.sizes.index(size)
    return (capacity.plan_s[index] + (capacity.hop - 1) * capacity.other_s[index]) / capacity.hop / size


def _alone(capacity: Capacity) -> int:
    """Heads that one core keeps up with, one at a time."""
    return int(FRAME_S / _per_frame_s(capacity, 1))
