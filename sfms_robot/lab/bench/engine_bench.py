"""The engines of one listener side by side: how long a frame takes on each, in the same run, beside eager fp32 torch.

A frame is all that a listener does with it: features of sound, events, networks, draws. Every engine has one thread.
They take turns, some frames each, so that whatever else the machine does meets all of them; a plan of several frames
falls due on every `hop`-th, the others only hear.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot import config
from sfms_robot.frames import FRAME_S, SpeakerFrame
from sfms_robot.lab.bench.listener_process import listener_process
from sfms_robot.lab.bench.measure import Row, row
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.engine import FOLDER, EngineName, has_graphs, read_graphs
from sfms_robot.listeners.registry import engine_name, load_listener
from sfms_robot.ports import Listener

EAGER: Final = "eager"
PEER: Final = "eager fp32 torch, one thread"
TURN_HOPS: Final = 4
TURNS: Final = 20
LIMIT_S: Final = 20.0  # for all engines of a listener: a machine busy with other things is told so, not waited for


@dataclass
class Stream:
    """One listener that runs: its memory, and durations of its frames [ms], those with a plan and those without."""

    listener: Listener
    memory: Any
    planning_ms: list[float] = field(default_factory=list)
    hearing_ms: list[float] = field(default_factory=list)
    frame_ms: list[float] = field(default_factory=list)
    heard: int = 0

    def turn(self, speaker: Sequence[SpeakerFrame], frames: int, keep: bool = True) -> None:
        """Take so many frames, whole hops; `frame_ms` gains their mean over each hop."""
        took: list[tuple[float, bool]] = []
        for _ in range(frames):
            self.heard += 1
            frame = replace(speaker[self.heard % len(speaker)], time_s=self.heard * FRAME_S)
            began_s = time.perf_counter()
            plan, self.memory = self.listener.step(frame, self.memory)
            took.append((1e3 * (time.perf_counter() - began_s), plan is not None))
        if not keep:
            return
        self.planning_ms += [ms for ms, planned in took if planned]
        self.hearing_ms += [ms for ms, planned in took if not planned]
        hop = self.listener.hop
        self.frame_ms += [sum(ms for ms, _ in took[at : at + hop]) / hop for at in range(0, frames, hop)]

    def figures(self, peer: Stream) -> Row:
        """A row: a frame beside the peer's, and its parts."""
        every_ms = [*chain(self.planning_ms, self.hearing_ms)]
        return row(self.frame_ms, peer.frame_ms, "ms", PEER) | {
            "engine": engine_name(self.listener),
            "fps": 1e3 / float(np.mean(every_ms)),
            "step_ms": spread(every_ms),
            "planning_ms": spread(self.planning_ms),
            "hearing_ms": spread(self.hearing_ms) if self.hearing_ms else None,
            "hop": self.listener.hop,
        }


def take_turns(streams: Mapping[str, Stream], speaker: Sequence[SpeakerFrame], turns: int = TURNS) -> None:
    """Let all of them hear the same person, `TURN_HOPS` plans at a time; ends early after `LIMIT_S`."""
    frames = {name: TURN_HOPS * max(1, stream.listener.hop) for name, stream in streams.items()}
    for name, stream in streams.items():
        stream.turn(speaker, frames[name], keep=False)
    until_s = time.perf_counter() + LIMIT_S
    for turn in range(turns):
        for name, stream in streams.items():
            stream.turn(speaker, frames[name])
        if turn and time.perf_counter() > until_s:
            return


def engines_of(folder: Path, scratch: Path) -> dict[str, tuple[Path, EngineName]]:
    """Ways to run the listener of a folder, by name: a folder and an engine each. The first one is the peer, the last
    one what `--engine auto` takes.

    `scratch`: where folders of other precisions are made.
    """
    settings = checkpoint.load_config(folder)
    exact = _of_precision(folder, settings, "fp32", scratch)
    found: dict[str, tuple[Path, EngineName]] = {EAGER: (exact, "torch"), "torch": (folder, "torch")}
    if has_graphs(folder):
        found["onnx"] = (exact, "onnx")
        if read_graphs(folder, settings, integers=True).in_integers:
            found["onnx int8"] = (_of_precision(folder, settings, "int8", scratch), "onnx")
    return found


def _of_precision(folder: Path, settings: config.Listener, precision: str, scratch: Path) -> Path:
    """The listener of a folder with another precision; itself where that is its own, or it has none."""
    if not isinstance(settings, config.Arig) or settings.precision == precision:
        return folder
    other = scratch / precision
    checkpoint.save_config(other, settings.model_copy(update={"precision": precision}))
    for name in (checkpoint.WEIGHTS, FOLDER):
        if (folder / name).exists():
            (other / name).symlink_to((folder / name).resolve())
    return other


def load(folder: Path, engine: EngineName, eager: bool) -> Listener:
    """On one thread; `eager`: as torch runs modules, without graphs."""
    return load_listener(folder, graphs=not eager, engine=engine, threads=1)


def process_row(folder: Path, engine: EngineName) -> Row:
    """What a process of its own takes to its first plan, and in memory."""
    told = listener_process(folder, engine)
    return {"first_plan_s": told.first_plan_s, "resident_mb": told.resident_mb, "peak_mb": told.peak_mb}


def spread(steps_ms: Sequence[float]) -> dict[str, float]:
    return {"p50": float(np.percentile(steps_ms, 50)), "p99": float(np.percentile(steps_ms, 99))}
