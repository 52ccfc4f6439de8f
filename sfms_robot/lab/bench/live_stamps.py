"""Observers of a measured run: where the time goes between a sound and the servos, and memory.

The stages come from the stamps that travel with samples, frames and plans:

    hop      from a sample to the end of the frame that the listener plans with
    block    until the source had that frame (the latency that it states)
    grid     until a tick gave it to the listener
    plan     until a tick had the listener's plan
    write    until the goals of that tick were written

Their sum is the time from a sample at the microphone to the first goal of a plan that uses it. It is taken for four
samples of each frame, ten milliseconds apart. A face counts from the arrival of its packet.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from sfms_robot.errors import BusError
from sfms_robot.frames import FRAME_HZ, FRAME_S, Plan, SpeakerFrame
from sfms_robot.lab.bench.measure import children_of, memory_mb
from sfms_robot.ports import Observer, Source, Tick
from sfms_robot.signals.quantiles import Quantiles

SETTLED_S: Final = 5.0  # until then the listener catches up with speech from before it was ready
STAGES: Final = ("hop", "block", "grid", "plan", "write")
_SAMPLES: Final = 4  # of a frame
_REMEMBERED: Final = 100  # frames


class StampedSource(Source):
    """A source that knows the loop's origin on `time.monotonic`."""

    def __init__(self, inner: Source) -> None:
        self._inner, self._origin_s = inner, 0.0
        self.duration_s = inner.duration_s
        self.latency_s, self.missing, self.outlets = inner.latency_s, inner.missing, inner.outlets

    def loop_s(self) -> float:
        """Return the loop time."""
        return time.monotonic() - self._origin_s

    def start(self, origin_s: float) -> None:
        self._origin_s = origin_s
        self._inner.start(origin_s)

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        frames = self._inner.read(now_s)
        self.latency_s, self.missing = self._inner.latency_s, self._inner.missing
        return frames

    def moves(self, speed_rad_s: float) -> None:
        self._inner.moves(speed_rad_s)

    def statistics(self) -> Mapping[str, Any]:
        return self._inner.statistics()

    def close(self) -> None:
        self._inner.close()


class Stamps(Observer):
    """An observer that adds up the stages. Its memory does not grow with the run.

    Args:
        loop_s: Returns the loop time.
        latency_s: Returns the latency that the source states.
        rate_hz: Ticks a second that are due.
    """

    def __init__(self, loop_s: Callable[[], float], latency_s: Callable[[], float], rate_hz: float) -> None:
        self._loop_s, self._latency_s, self._rate_hz = loop_s, latency_s, rate_hz
        self._heard: dict[int, tuple[float, float]] = {}  # frame -> tick that gave it, latency of the source
        self._waiting: deque[SpeakerFrame] = deque(maxlen=_REMEMBERED)
        self._plans: list[tuple[float, float]] = []  # of this tick: made at, taken at
        self._stages = {name: Quantiles() for name in STAGES}
        self._sound, self._face = Quantiles(), Quantiles()
        self._last_face_s = -1.0
        self._first_s: float | None = None
        self._last_s = 0.0
        self._ticks = 0

    def heard(self, frame: SpeakerFrame) -> None:
        index = round(frame.time_s * FRAME_HZ)
        self._heard[index] = self._loop_s(), self._latency_s()
        self._heard.pop(index - _REMEMBERED, None)
        self._waiting.append(frame)

    def planned(self, plan: Plan) -> None:
        self._plans.append((plan.made_at_s, self._loop_s()))

    def tick(self, seen: Tick) -> None:
        self._first_s = seen.time_s if self._first_s is None else self._first_s
        self._last_s, self._ticks = seen.time_s, self._ticks + 1
        if self._plans:
            written_s = self._loop_s() if seen.written_s is None else seen.written_s
            for made_at_s, taken_s in self._plans:
                self._followed(made_at_s, taken_s, written_s)
            self._plans = []

    def _followed(self, made_at_s: float, taken_s: float, written_s: float) -> None:
        """Count every frame up to `made_at_s`: the plan made from them is on the wire."""
        heard_s, latency_s = self._heard.get(round(made_at_s * FRAME_HZ), (made_at_s, 0.0))
        late_s = max(0.0, heard_s - made_at_s)
        block_s = min(latency_s, late_s)
        while self._waiting and self._waiting[0].time_s <= made_at_s + FRAME_S / 2:
            frame = self._waiting.popleft()
            if frame.time_s < SETTLED_S:
                continue
            if frame.face is not None and frame.face.time_s > self._last_face_s:
                self._last_face_s = frame.face.time_s
                self._face.add(max(0.0, written_s - frame.face.time_s) * 1e3)
            if not len(frame.audio):
                continue
            for k in range(_SAMPLES):
                sample_s = frame.time_s - FRAME_S * (1 - k / _SAMPLES)
                parts_s = (made_at_s - sample_s, block_s, late_s - block_s, taken_s - heard_s, written_s - taken_s)
                for name, part_s in zip(STAGES, parts_s, strict=True):
                    self._stages[name].add(max(0.0, part_s) * 1e3)
                self._sound.add(max(0.0, written_s - sample_s) * 1e3)

    def report(self) -> dict[str, Any]:
        """Return `ticks`, `missed_ticks`, `sound_to_goal_ms`, `stages_ms` and `face_to_goal_ms`."""
        due = 0 if self._first_s is None else round((self._last_s - self._first_s) * self._rate_hz) + 1
        return {
            "ticks": self._ticks,
            "missed_ticks": due - self._ticks,
            "sound_to_goal_ms": self._sound.report(p50=50, p95=95),
            "stages_ms": {name: each.report(p50=50, p95=95) for name, each in self._stages.items()},
            "face_to_goal_ms": self._face.report(p50=50, p95=95),
        }


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


def listener_of(pid: int) -> int:
    """Return the id of the listener's process of a run. Raises BusError if there is none."""
    for child in children_of(pid):
        with suppress(OSError):
            if "listeners.process" in Path(f"/proc/{child}/cmdline").read_text(encoding="utf-8"):
                return child
    raise BusError("bench live: the run has no listener's process")
