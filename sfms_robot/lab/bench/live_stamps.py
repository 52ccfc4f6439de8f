"""Where the time goes between a sound and the servos, from the stamps that travel: of samples, frames and plans.

    hop      from a sample to the end of the frame that the listener plans with
    block    until the source had that frame (its own stated latency)
    grid     until a tick gave it to the listener
    plan     until a tick had the listener's plan
    write    until that tick's goals were written

The sum is from a sample at the microphone to the first goal of a plan that knows of it. It is taken for four samples of
each frame, ten milliseconds apart. A face counts from its packet's arrival.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from sfms_robot.frames import FRAME_HZ, FRAME_S, Plan, SpeakerFrame
from sfms_robot.ports import Source, Tick
from sfms_robot.signals.quantiles import Quantiles

SETTLED_S: Final = 5.0  # before that the listener catches up with what was said while it started
STAGES: Final = ("hop", "block", "grid", "plan", "write")
_SAMPLES: Final = 4  # of a frame
_REMEMBERED: Final = 100  # frames


class StampedSource(Source):
    """A source, and the loop's origin in seconds of `now`."""

    def __init__(self, inner: Source, now: Callable[[], float] = time.monotonic) -> None:
        self._inner, self._now = inner, now
        self._origin_s = 0.0
        self.duration_s = inner.duration_s
        self.latency_s, self.missing, self.outlets = inner.latency_s, inner.missing, inner.outlets

    def loop_s(self) -> float:
        """Loop time."""
        return self._now() - self._origin_s

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


class Stamps:
    """`ports.Observer`. Fixed memory, whatever the length of the run.

    Args:
        loop_s: loop time, now.
        latency_s: what the source says of itself.
    """

    def __init__(self, loop_s: Callable[[], float], latency_s: Callable[[], float], rate_hz: float) -> None:
        self._loop_s, self._latency_s, self._rate_hz = loop_s, latency_s, rate_hz
        self._heard: dict[int, tuple[float, float]] = {}  # frame -> when a tick gave it, latency of the source
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

    def close(self) -> None:
        """Nothing is open."""

    def _followed(self, made_at_s: float, taken_s: float, written_s: float) -> None:
        """A plan is on the wire: so is all that it knows of."""
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
                parts_s = (
                    made_at_s - sample_s, block_s, late_s - block_s, taken_s - heard_s, written_s - taken_s,
                )  # fmt: skip
                for name, part_s in zip(STAGES, parts_s, strict=True):
                    self._stages[name].add(max(0.0, part_s) * 1e3)
                self._sound.add(max(0.0, written_s - sample_s) * 1e3)

    def report(self) -> dict[str, Any]:
        """`ticks`, `missed_ticks`, `sound_to_goal_ms` by stage and in all, `face_to_goal_ms`."""
        due = 0 if self._first_s is None else round((self._last_s - self._first_s) * self._rate_hz) + 1
        return {
            "ticks": self._ticks,
            "missed_ticks": due - self._ticks,
            "sound_to_goal_ms": self._sound.report(p50=50, p95=95),
            "stages_ms": {name: each.report(p50=50, p95=95) for name, each in self._stages.items()},
            "face_to_goal_ms": self._face.report(p50=50, p95=95),
        }
