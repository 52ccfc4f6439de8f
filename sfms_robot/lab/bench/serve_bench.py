"""`bench serve`: the number of heads that one server answers in time, and the cost of each.

Heads send frames of a recorded person 25 times a second as bytes, each head from a different place in the recording and
at a different phase. The bench measures the time from the arrival of a frame to the departure of its plan, again as
bytes: the way to the process that steps, parsing, waiting for a batch, the batch, the way back. The network is not
included (`bench live` and a run's report include it). The processes are those of `serve`; the frames are also sent from
this machine.

The peer is the same listener serving one head at a time on one core, as a server without batches would.

`--device cuda`: p99 and frames a second at 64, 256 and 1,024 heads, and the duration of one batch of all these heads
without the messages: in its networks, and in total with Python.
"""

from __future__ import annotations

import queue
import struct
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.app.serve.batch_process import Served
from sfms_robot.app.serve.service import WorkerPool
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, SpeakerFrame
from sfms_robot.lab import Figures
from sfms_robot.lab.bench.listener_bench import NAMES, with_weights
from sfms_robot.lab.bench.measure import BenchResult, Say, machine
from sfms_robot.listeners.engine import Device
from sfms_robot.listeners.registry import engine_name, load_listener
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
from sfms_robot.sources.registry import shipped_speaker

_WARM_S: Final = 1.0
_SECONDS: Final = 4.0
_MOST: Final = 512
GPU_HEADS: Final = (64, 256, 1024)
GPU_NAMES: Final = ("arig-small", "sfms-small")
_BATCH_FRAMES: Final = 8
_NOT_KEPT_UP_MS: Final = 10_000.0  # delay that is reported if the server skipped frames
_ANSWER_S: Final = 30.0


def measure(say: Say, device: Device = "cpu") -> BenchResult:
    """Measure every listener. Blocks for some minutes."""
    if device != "cpu":
        return _on_gpu(say, device)
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
    return BenchResult(figures, table, [f"within {DEADLINE_S * 1e3:.0f} ms, p99, a process for each of {machine()}"])


def _on_gpu(say: Say, device: Device) -> BenchResult:
    """Measure listeners at fixed numbers of heads. Raises ConfigError where there is no GPU."""
    table, messages, where = list[Figures](), _frames(), machine()
    for name in GPU_NAMES:
        listener = load_listener(name, threads=1, device=device)
        where = f"{engine_name(listener)}, {machine()}"
        batches = {count: _batch_ms(listener, count) for count in GPU_HEADS}
        load = _Load()
        served = Served(listener=name, name="bench", all_heads=True, device=device)
        with closing(WorkerPool(served, load.sent)) as pool:
            for count in GPU_HEADS:
                point = {"listener": name, "hop": pool.hop, "processes": len(pool.capacities)}
                point |= _loaded(pool, load, messages, count) | batches[count]
                table.append(point)
                say(
                    f"{name}: {count} heads, p99 {point['p99_ms']:.0f} ms, {point['frames_a_second']:.1f} frames/s each"
                )
    figures = {f"serve.{each['listener']}.{each['heads']}": each | {"machine": where} for each in table}
    return BenchResult(figures, table, [f"within {DEADLINE_S * 1e3:.0f} ms is in time; on {where}"])


def _batch_ms(listener: Any, heads: int) -> dict[str, float]:
    """Return the time [ms] of a batch of one frame of each head, averaged over plans: in its networks, and in total."""
    engine, spent_s = listener.engine, list[float]()
    run = engine.run

    def timed(network: str, *inputs: Any) -> Any:
        began_s = time.perf_counter()
        found = run(network, *inputs)
        spent_s.append(time.perf_counter() - began_s)
        return found

    memories = [listener.start(seed) for seed in range(heads)]
    voices = np.random.default_rng(0).normal(0, 0.1, (heads, FRAME_SAMPLES)).astype(np.float32)
    engine.run = timed
    try:
        for index in range(2 * _BATCH_FRAMES):  # half of them warm up
            if index == _BATCH_FRAMES:
                spent_s.clear()
                began_s = time.perf_counter()
            speakers = [SpeakerFrame((index + 1) * FRAME_S, voice) for voice in voices]
            memories = [memory for _, memory in listener.step_each(speakers, memories)]
        whole_s = time.perf_counter() - began_s
    finally:
        engine.run = run
    batch_ms, networks_ms = (round(taken_s / _BATCH_FRAMES * 1e3, 2) for taken_s in (whole_s, sum(spent_s)))
    return {"batch_ms": batch_ms, "networks_ms": networks_ms}


def _served(name: str, say: Say) -> Figures:
    messages, curve = _frames(), list[Figures]()
    with tempfile.TemporaryDirectory() as scratch:
        folder, weights = with_weights(name, Path(scratch))
        load = _Load()
        with closing(WorkerPool(Served(listener=str(folder), name="bench", all_heads=True), load.sent)) as pool:

            def in_time(heads: int) -> bool:
                curve.append(point := _loaded(pool, load, messages, heads))
                say(f"{name}: {heads} heads, p99 {point['p99_ms']:.0f} ms, batches of {point['batch_size']:.1f}")
                return float(point["p99_ms"]) <= DEADLINE_S * 1e3

            most = _largest(in_time, start=max(1, pool.most))
    best = next((each for each in curve if each["heads"] == most), curve[0])
    capacity = pool.capacities[0]
    # Seconds per head and frame in batches of each size; the cost of a plan is shared among the frames of a hop.
    costs_s = {
        size: (plan_s + (capacity.hop - 1) * other_s) / capacity.hop / size
        for size, plan_s, other_s in zip(capacity.sizes, capacity.plan_s, capacity.other_s, strict=True)
    }
    alone = int(FRAME_S / costs_s[1])
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
        "cost_ms_per_head_and_frame": {str(size): round(cost_s * 1e3, 3) for size, cost_s in costs_s.items()},
        "peer": "one head at a time, one core",
        "peer_median": alone,
        "ratio": round(most / max(alone, 1), 2),
        "repeats": len(curve),
        "machine": machine(),
    }


def _largest(in_time: Callable[[int], bool], start: int) -> int:
    """Return the most heads that are `in_time`, 0 for none: by doubling or halving, then bisection to a twentieth."""
    low, high = 0, 0
    heads = start
    while not high or not low:
        if in_time(heads):
            low = heads
            if high or heads >= _MOST:
                break
            heads = min(2 * heads, _MOST)
        else:
            high = heads
            if low or heads <= 1:
                break
            heads = max(1, heads // 2)
    while high and high - low > max(1, low // 20):
        middle = (low + high) // 2
        low, high = (middle, high) if in_time(middle) else (low, middle)
    return low


def _loaded(pool: WorkerPool, load: _Load, messages: Sequence[bytes], heads: int) -> Figures:
    """Measure one point of the curve: `heads` heads for `_SECONDS`."""
    streams = [_join(pool, index) for index in range(heads)]
    load.begin()
    before = pool.statistics()
    rng = np.random.default_rng(heads)
    phases_s = np.sort(rng.uniform(0, FRAME_S, heads))
    shifts = rng.integers(0, len(messages), heads)
    began_s, frames = time.monotonic(), round((_WARM_S + _SECONDS) / FRAME_S)
    for number in range(frames):
        for index, stream in enumerate(streams):
            ahead_s = began_s + number * FRAME_S + phases_s[index] - time.monotonic()
            if ahead_s > 0:
                time.sleep(ahead_s)
            message = messages[(number + shifts[index]) % len(messages)]  # number and time follow kind, protocol, flags
            pool.receive(stream, message[:4] + struct.pack("<Id", number, (number + 1) * FRAME_S) + message[16:])
    sent_s = time.monotonic() - began_s
    now = pool.statistics()
    spent = {name: now[name] - before[name] for name in ("steps", "batches", "cpu_s")}
    for stream in streams:
        pool.receive(stream, words_message(Notice("leave")))
    delays_ms = load.delays_ms(after=round(_WARM_S / FRAME_S))
    if load.skipped or not delays_ms:
        delays_ms = [_NOT_KEPT_UP_MS]
    p50, p99 = np.percentile(delays_ms, [50, 99])
    return {
        "heads": heads,
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
        "frames_a_second": round(frames / sent_s, 2),
        "batch_size": round(spent["steps"] / max(spent["batches"], 1), 1),
        "cpu_ms_per_head_and_second": round(spent["cpu_s"] / heads / (_WARM_S + _SECONDS) * 1e3, 2),
    }


class _Load:
    """A receiver of the server's messages that stores the arrival time of each plan."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget everything received."""
        self._plans: list[tuple[bytes, float]] = []
        self.skipped = 0

    def sent(self, stream: str, message: bytes) -> None:
        """Receive a message; called from the pool's threads."""
        if message[:1] != b"{":
            self._plans.append((message, time.monotonic()))
        else:
            said = parse_words(message)
            self.skipped += said.frames if isinstance(said, Notice) else 0

    def delays_ms(self, after: int) -> list[float]:
        """Return the delays of plans for frames from number `after` on."""
        sent = [(parse_plan(message), went_s) for message, went_s in self._plans]
        return [(went_s - each.came_s) * 1e3 for each, went_s in sent if each.number >= after]


def _join(pool: WorkerPool, index: int) -> str:
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    pool.join(words_message(Join(f"bench-{time.monotonic_ns()}-{index}", index)), answers.put)
    said = parse_words(answers.get(timeout=_ANSWER_S))
    assert isinstance(said, Welcome)  # this server admits every head
    return said.stream


def _frames() -> list[bytes]:
    """Return every frame of the recording as a message with number 0."""
    audio = read_audio(shipped_speaker("katie").audio)
    chunks = audio[: len(audio) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
    return [frame_message(SentFrame(0, SpeakerFrame(FRAME_S, chunk), 0.0)) for chunk in chunks]
