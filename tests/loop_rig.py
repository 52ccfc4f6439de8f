"""A run of the loop on emulated servos in virtual time, under a listener with a known face."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from sfms_robot.app.open_head import build_bus, build_motion, run_log
from sfms_robot.config import Head
from sfms_robot.emulator.launch import Chain
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, Plan, SpeakerFrame
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.clock import InlineFeed, VirtualClock
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.loop import Parts, drive


class Posed:
    """A listener whose channels are functions of time [s]; it may plan NaN from a frame on."""

    hop, horizon = 4, 8

    def __init__(self, nan_from: float = np.inf, **channels: Callable[[np.ndarray], Any]) -> None:
        self._channels, self._nan_from = channels, nan_from

    def start(self, seed: int) -> int:
        return 0

    def step(self, speaker: SpeakerFrame, memory: int) -> tuple[Plan | None, int]:
        if memory % self.hop:
            return None, memory + 1
        times_s = speaker.time_s + FRAME_S * np.arange(1.0, self.horizon + 1)
        frames = np.zeros((self.horizon, MOTION_DIM), dtype=np.float32)
        for channel, face in self._channels.items():
            frames[:, CHANNEL_INDEX[channel]] = face(times_s) if memory < self._nan_from else np.nan
        return Plan(speaker.time_s, times_s, frames), memory + 1


def driven(
    head: Head, bus: Any, clock: VirtualClock, *, rate_hz: float, duration_s: float, observer: Any,
    interrupted: Callable[[], bool] = lambda: False, log: RunLog | None = None, **parts: Any,
) -> tuple[str, RunLog]:  # fmt: skip
    """Drive a head to the end; `parts` replace those of `build_motion`."""
    motion = build_motion(head, rate_hz)
    log = log or run_log(head, rate_hz)
    whole = {**vars(motion), "holds": None, "heat": None, "bus": bus, "observers": [observer]}
    outcome = drive(Parts(**whole | parts), clock, log, rate_hz=rate_hz, duration_s=duration_s, interrupted=interrupted)
    return outcome, log


class Watcher(Observer):
    """Keeps every tick and counts what came; does before a tick, by its number, what the test asks for."""

    def __init__(self, does: Mapping[int, Callable[[], Any]] | None = None) -> None:
        self.does = dict(does or {})
        self.ticks: list[Tick] = []
        self.frames = self.plans = 0

    def tick(self, seen: Tick) -> None:
        if act := self.does.get(len(self.ticks)):
            act()
        self.ticks.append(seen)

    def heard(self, frame: SpeakerFrame) -> None:
        self.frames += 1

    def planned(self, plan: Plan) -> None:
        self.plans += 1

    def goals(self) -> np.ndarray:
        """Goals of all ticks, (ticks, joints), rad."""
        return np.array([tick.goals_rad for tick in self.ticks])


@dataclass(frozen=True)
class Ran:
    """How a run ended, what was seen of it, and what its bus counted."""

    outcome: str
    log: RunLog
    watcher: Watcher
    statistics: Mapping[str, Any]

    @property
    def ticks(self) -> list[Tick]:
        return self.watcher.ticks

    @property
    def states(self) -> list[str]:
        """States in the order in which they came, each once until the next."""
        return [name for name, _ in groupby(tick.state for tick in self.ticks)]


def run_listener(
    head: Head, chain: Chain, listener: Posed, watcher: Watcher, *, clock: VirtualClock | None = None,
    without: Iterable[str] = (), opened: Callable[[Any], object] = lambda bus: None, **how: Any,
) -> Ran:  # fmt: skip
    """Run a listener on emulated servos; `opened` is called with the bus before it is connected."""
    clock = clock or VirtualClock()
    bus = build_bus(head, {"main": chain}, clock, without=tuple(without))
    opened(bus)
    bus.connect()
    try:
        outcome, log = driven(head, bus, clock, observer=watcher, feed=InlineFeed(listener, 0), **how)
        return Ran(outcome, log, watcher, bus.statistics())
    finally:
        bus.close()
