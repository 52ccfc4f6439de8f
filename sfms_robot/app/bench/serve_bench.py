"""`bench serve`: how many heads one server process answers in time, and what each costs.

Heads send frames of a recorded person 25 times a second, each from its own place in the recording and at its own phase,
as bytes; what is measured lies between a frame's coming and its plan's going, as bytes again: parsing, waiting for a
batch, the batch. The network is not in it (`bench live` and a run's report have that). Nothing is left out of what a
server does, and the threads that step are those of `serve`.

The peer is the same listener asked for one head at a time, which is what a server without batches would do.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from sfms_robot.app.bench.measure import Told, machine
from sfms_robot.app.serve.service import BatchWorkers, ServeOptions, served_listener
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, SpeakerFrame
from sfms_robot.listeners.remote_messages import (
    Join,
    SentFrame,
    Welcome,
    frame_message,
    parse_plan,
    parse_words,
    words_message,
)
from sfms_robot.listeners.serving.capacity import Capacity
from sfms_robot.listeners.serving.stream_server import DEADLINE_S, StreamServer
from sfms_robot.ports import Listener
from sfms_robot.signals.audio import read_audio
from sfms_robot.sources.speakers import voice_file

NAMES: Final = ("sfms-small", "arig-small")
SPEAKER: Final = "katie"
WORKERS: Final = 2
WARM_S: Final = 1.0
SECONDS: Final = 4.0
MOST: Final = 512
NOT_KEPT_UP_MS: Final = 10_000.0  # stands for a server that left frames out
_PERCENT: Final = 99.0


def measure(say: Callable[[str], None]) -> Told:
    """Blocks for a minute or two."""
    import torch

    threads = torch.get_num_threads()
    try:
        figures = {name: _served(name, say) for name in NAMES}
    finally:
        torch.set_num_threads(threads)
    table = [
        {
            "listener": name, "heads in time": each["median"], "p99 ms": each["p99_ms"], "hop": each["hop"],
            "one at a time": each["peer_median"], "ratio": each["ratio"], "batch": each["batch_size_p50"],
            **{f"ms a frame, batch of {size}": each["cost_ms_per_head_and_frame"][size] for size in ("1", "8", "32")},
        }
        for name, each in figures.items()
    ]  # fmt: skip
    figures = {f"serve.{name}": each for name, each in figures.items()}
    return Told(figures, table, [f"within {DEADLINE_S * 1e3:.0f} ms, p99, {WORKERS} threads on {machine()}"])


def _served(name: str, say: Callable[[str], None]) -> dict[str, Any]:
    listener, capacity = served_listener(ServeOptions(name))
    messages = _frames()
    curve: list[dict[str, Any]] = []

    def in_time(heads: int) -> bool:
        curve.append(_loaded(listener, messages, heads))
        say(f"{name}: {heads} heads, p99 {curve[-1]['p99_ms']:.0f} ms, batches of {curve[-1]['batch_size_p50']:.0f}")
        return float(curve[-1]["p99_ms"]) <= DEADLINE_S * 1e3

    most = _largest(in_time, start=max(1, capacity.most(DEADLINE_S)))
    best = next((each for each in curve if each["heads"] == most), curve[0])
    alone = _alone(capacity)
    return {
        "median": most,
        "unit": "heads",
        "p99_ms": best["p99_ms"],
        "p50_ms": best["p50_ms"],
        "deadline_ms": DEADLINE_S * 1e3,
        "hop": listener.hop,
        "workers": WORKERS,
        "batch_size_p50": best["batch_size_p50"],
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


def _loaded(listener: Listener, messages: Sequence[bytes], heads: int) -> dict[str, Any]:
    """One point of the curve: so many heads for `SECONDS`."""
    server = StreamServer(listener, "bench")
    load = _Load()
    workers = BatchWorkers(server, load.sent, WORKERS)
    try:
        streams = [_join(server, index) for index in range(heads)]
        rng = np.random.default_rng(heads)
        phases_s = np.sort(rng.uniform(0, FRAME_S, heads))
        shifts = rng.integers(0, len(messages), heads)
        began_s, frames = time.monotonic(), round((WARM_S + SECONDS) / FRAME_S)
        used_s = time.process_time()
        for number in range(frames):
            for index, stream in enumerate(streams):
                due_s = began_s + number * FRAME_S + phases_s[index]
                ahead_s = due_s - time.monotonic()
                if ahead_s > 0:
                    time.sleep(ahead_s)
                workers.receive(stream, _numbered(messages[(number + shifts[index]) % len(messages)], number))
        used_s = time.process_time() - used_s
        told = workers.statistics()
    finally:
        workers.close()
    delays_ms = load.delays_ms(after=round(WARM_S / FRAME_S))
    if told["skipped_frames"] or not delays_ms:
        delays_ms = [NOT_KEPT_UP_MS]
    p50, p99 = np.percentile(delays_ms, [50, _PERCENT])
    return {
        "heads": heads,
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
        "batch_size_p50": told["batch_size"]["p50"],
        "cpu_ms_per_head_and_second": round(used_s / heads / (WARM_S + SECONDS) * 1e3, 2),
    }


class _Load:
    """Takes the plans, and asks each how late it was."""

    def __init__(self) -> None:
        self.plans: list[bytes] = []

    def sent(self, stream: str, message: bytes) -> None:
        """From the server's threads."""
        if message[:1] != b"{":
            self.plans.append(message)

    def delays_ms(self, after: int) -> list[float]:
        """Of plans for frames from number `after` on: from the frame's coming to the plan's going."""
        sent = [parse_plan(message) for message in self.plans]
        return [(each.sent_s - each.came_s) * 1e3 for each in sent if each.number >= after]


def _join(server: StreamServer, index: int) -> str:
    said = parse_words(server.join(words_message(Join(f"bench-{index}", index)), time.monotonic()))
    assert isinstance(said, Welcome)  # without a capacity everybody is admitted
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
