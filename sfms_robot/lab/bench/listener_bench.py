"""`bench listener`: every shipped listener on every engine: speed, start, memory, and loss of accuracy.

Rows "NAME ENGINE" compare the duration of a frame on each engine with eager fp32 torch, in the same run. A frame
includes all work of the listener: features of sound, events, networks, draws. Every engine has one thread. The engines
take turns of some frames each, so that other load of the machine affects all of them. A plan of several frames is due
on every `hop`-th frame; on the other frames the listener only listens.

The row NAME is the engine that `--engine auto` chooses, with further figures of the listener; `in_run` is measured
while a servo loop runs. A listener without weights (the sizes of the papers) gets seeded weights, since the cost of a
frame is the same. ARIG's context is filled with random numbers, as full as after an hour.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot import config
from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.data import data_dir
from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, POSE_CHANNELS, FaceFrame, SpeakerFrame
from sfms_robot.lab import Figures
from sfms_robot.lab.bench.measure import HEAD, BenchResult, Row, Rows, listener_process, percentiles, row
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.engine import FOLDER, EngineName, has_graphs, read_graphs
from sfms_robot.listeners.process import threads
from sfms_robot.listeners.registry import engine_name, load_listener, one_thread
from sfms_robot.ports import Listener
from sfms_robot.sources.registry import DEFAULT_SPEAKER

NAMES: Final = ("sfms-small", "arig-small", "arig-paper")
PAPER: Final = "sfms-large"  # only its training file ships
TRAINED, SEEDED = "trained", "seeded, not trained"
EAGER: Final = "eager"
TURN_HOPS: Final = 4
_LIMIT_S: Final = 20.0  # for all engines of a listener; on a busy machine they have fewer turns
_COLUMNS: Final = {
    "median": "frame ms", "p99": "p99", "ratio": "of eager", "hearing_ms": "hearing ms", "planning_ms": "planning ms",
    "first_plan_s": "first plan s", "resident_mb": "MB", "distance": "distance",
}  # fmt: skip


def listener() -> BenchResult:
    """Measure all listeners, on one thread each."""
    one_thread()
    rows: Rows = {}
    for name in NAMES:
        with tempfile.TemporaryDirectory() as scratch:
            rows |= _measured(name, Path(scratch))
    rows |= _sfms_paper()
    return BenchResult(
        BenchResult.of_rows(rows).figures, engine_table(rows), ["a frame is all of a step, on average over a hop"]
    )


def engine_table(rows: Mapping[str, Row]) -> list[Figures]:
    """Return one line per engine; the row of a listener repeats one of these."""
    found = []
    for name, each in rows.items():
        if name not in NAMES:
            values = {title: each.get(key) for key, title in _COLUMNS.items()}
            shown = {title: value["p50"] if isinstance(value, dict) else value for title, value in values.items()}
            found.append({"measured": name, **shown})
    return found


def _measured(name: str, scratch: Path) -> Rows:
    """Return the rows of one shipped listener."""
    folder, weights = with_weights(name, scratch)
    settings = config.load_listener(folder / "config.yaml")
    ways, speaker = engines_of(folder, scratch), talk()
    loaded = {way: load_listener(where, engine=engine, threads=1) for way, (where, engine) in ways.items()}
    streams = {way: Stream(one, aged(one, one.start(0), speaker)) for way, one in loaded.items()}
    take_turns(streams, speaker)
    rows = {f"{name} {way}": stream.figures(streams[EAGER]) for way, stream in streams.items()}
    for way in streams.keys() - {EAGER}:
        rows[f"{name} {way}"]["distance"] = distance(loaded[way], loaded[EAGER], speaker)
        rows[f"{name} {way}"] |= listener_process(*ways[way])
    auto = [*ways][-1]
    how: Any = getattr(loaded[EAGER], "how", loaded[EAGER])  # the motion part of a listener that also decides events
    rows[name] = rows[f"{name} {auto}"] | {
        "eager_fp32_fps": rows[f"{name} {EAGER}"]["fps"],
        "params": sum(each.numel() for each in how.model.parameters()),
        "weights": weights,
    }
    if isinstance(settings, config.Arig):
        rows[name]["in_run"] = in_run(folder)
    return rows


def with_weights(name: str, scratch: Path) -> tuple[Path, str]:
    """Return the folder of a shipped listener and its kind of weights; if none ship, make seeded ones in `scratch`."""
    shipped = data_dir("configs") / "listeners" / name
    settings = config.load_listener(shipped / "config.yaml")
    if (shipped / checkpoint.WEIGHTS).is_file() or not isinstance(settings, config.Arig):
        return shipped, TRAINED
    import torch

    from sfms_robot.listeners.arig.model import ArigModel

    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = ArigModel(settings)
    model.motion_mean.copy_(torch.tensor([0.5 * (name not in POSE_CHANNELS) for name in settings.channels]))
    model.motion_std.fill_(0.02)  # motion well inside 0..1, where no value is clipped
    folder = scratch / "seeded"
    checkpoint.save_config(folder, settings)
    checkpoint.save_weights(folder / checkpoint.WEIGHTS, model)
    if has_graphs(shipped):
        shutil.copytree(shipped / FOLDER, folder / FOLDER)
    return folder, SEEDED


def _sfms_paper() -> Rows:
    """Measure the paper's size of SFMS with seeded weights, on torch."""
    import torch

    from sfms_robot.listeners.sfms.model import SfmsModel
    from sfms_robot.listeners.sfms.stream import SfmsListener
    from sfms_robot.listeners.torch_engine import torch_engine

    training = config.load_training(data_dir("configs") / "training" / f"{PAPER}.yaml")
    assert isinstance(training, config.Training)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = SfmsModel(training.listener)
    found = SfmsListener(training.listener, torch_engine(model))
    stream = Stream(found, found.start(0))
    take_turns({EAGER: stream}, talk())
    params = sum(each.numel() for each in model.parameters())
    return {f"{PAPER} {EAGER}": stream.figures(stream) | {"params": params, "weights": SEEDED}}


def aged(listener: Listener, memory: Any, speaker: Sequence[SpeakerFrame], minutes: int = 60) -> Any:
    """Return a memory as after `minutes`, with random whole chunks; a fresh one for a listener without chunks."""
    _, memory = listener.step(speaker[0], memory)
    how = getattr(memory, "how", memory)
    context = getattr(how, "context", None)
    if context is None:
        return listener.start(0)
    made_up = np.random.default_rng(0).standard_normal(context.shape, np.float32)
    older = replace(how, frames=minutes * 60 * FRAME_HZ, context=made_up)
    return older if how is memory else replace(memory, how=older)


def distance(quick: Listener, exact: Listener, speaker: Sequence[SpeakerFrame]) -> float:
    """Return the RMS difference of motion over its deviation; both listeners step from the memory of `exact`."""
    memory, frames = exact.start(0), []
    for frame in speaker:
        other, _ = quick.step(frame, memory)
        plan, memory = exact.step(frame, memory)
        if plan is not None and other is not None:
            frames += [*zip(plan.frames, other.frames, strict=True)]
    made, other_made = np.array(frames).swapaxes(0, 1)
    moving = made.std(0) > 1e-6
    share = np.sqrt(np.square(other_made - made).mean(0))[moving] / made.std(0)[moving]
    return float(np.sqrt(np.mean(share**2)))


def talk(frames: int = 100) -> list[SpeakerFrame]:
    """Return noise in which both people talk in turns; its content does not matter, as only time is measured."""
    rng = np.random.default_rng(0)
    out = []
    for index in range(frames):
        level = (0.1, 1e-3) if index // 25 % 2 else (1e-3, 0.1)
        theirs, ours = (rng.normal(0, each, FRAME_SAMPLES).astype(np.float32) for each in level)
        time_s = (index + 1) * FRAME_S
        out.append(SpeakerFrame(time_s, theirs, FaceFrame.of(time_s, rng.uniform(0, 0.2, 58)), ours))
    return out


def in_run(folder: Path, duration_s: float = 8.0) -> Figures:
    """Drive `HEAD` on emulated servos with the listener in `folder`, which receives both tracks, in real time.

    The loop must not be late because of the listener, and a step must not take longer than the 40 ms of a frame.
    """
    options = RunOptions(
        head=HEAD, listener=str(folder), audio=DEFAULT_SPEAKER, agent_audio="katie", duration_s=duration_s
    )
    report = run(options)
    step_ms = report["listener_step_ms"]
    return {
        "head": HEAD,
        "duration_s": report["duration_s"],
        "frames": report["frames"],
        "unheard_frames": report["listener_state"]["skipped_frames"],
        "frames_per_s": 1e3 / step_ms["p50"] if step_ms["p50"] else None,
        "step_ms": step_ms,
        "ticks": report["ticks"],
        "late_ticks": report["tick"]["late"],
        "achieved_hz": report["tick"]["achieved_hz"],
        "frame_to_wire_ms": report["latency_ms"]["frame_to_wire"],
        "threads": threads(),
    }


# --- engines side by side -------------------------------------------------------------------------------------------


@dataclass
class Stream:
    """A running listener: its memory, and the durations [ms] of its frames with a plan and without."""

    listener: Listener
    memory: Any
    _: KW_ONLY
    planning_ms: list[float] = field(default_factory=list)
    hearing_ms: list[float] = field(default_factory=list)
    frame_ms: list[float] = field(default_factory=list)
    heard: int = 0

    def turn(self, speaker: Sequence[SpeakerFrame], frames: int, keep: bool = True) -> None:
        """Step through `frames` frames, which are whole hops; append their mean over each hop to `frame_ms`."""
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
        self.frame_ms += np.reshape([ms for ms, _ in took], (-1, self.listener.hop)).mean(axis=1).tolist()

    def figures(self, peer: Stream) -> Row:
        """Return a row: the duration of a frame, that of the peer, and its parts."""
        every_ms = [*self.planning_ms, *self.hearing_ms]
        return row(self.frame_ms, peer.frame_ms, "ms", "eager fp32 torch, one thread") | {
            "engine": engine_name(self.listener),
            "fps": 1e3 / float(np.mean(every_ms)),
            "step_ms": percentiles(every_ms),
            "planning_ms": percentiles(self.planning_ms),
            "hearing_ms": percentiles(self.hearing_ms) if self.hearing_ms else None,
            "hop": self.listener.hop,
        }


def take_turns(streams: Mapping[str, Stream], speaker: Sequence[SpeakerFrame], turns: int = 20) -> None:
    """Step all streams in turn with the same person, `TURN_HOPS` plans at a time; end early after `_LIMIT_S`."""
    frames = {name: TURN_HOPS * stream.listener.hop for name, stream in streams.items()}
    for name, stream in streams.items():
        stream.turn(speaker, frames[name], keep=False)
    until_s = time.perf_counter() + _LIMIT_S
    for turn in range(turns):
        for name, stream in streams.items():
            stream.turn(speaker, frames[name])
        if turn and time.perf_counter() > until_s:
            return


def engines_of(folder: Path, scratch: Path) -> dict[str, tuple[Path, EngineName]]:
    """Return the ways to run the listener of a folder, by name: a folder and an engine for each way.

    The first way is the peer, the last one is the choice of `--engine auto`. Folders with other precisions are made in
    `scratch`.
    """
    settings = checkpoint.load_config(folder)
    exact = _of_precision(folder, settings, "fp32", scratch)
    found: dict[str, tuple[Path, EngineName]] = {EAGER: (exact, "torch")}
    if has_graphs(folder):
        found["onnx"] = (exact, "onnx")
        if read_graphs(folder, settings, integers=True).in_integers:
            found["onnx int8"] = (_of_precision(folder, settings, "int8", scratch), "onnx")
    return found


def _of_precision(folder: Path, settings: config.ListenerSettings, precision: str, scratch: Path) -> Path:
    """Return a folder of the listener with `precision`: its own folder if it has that precision, or has none."""
    if not isinstance(settings, config.Arig) or settings.precision == precision:
        return folder
    other = scratch / precision
    checkpoint.save_config(other, settings.model_copy(update={"precision": precision}))
    for name in (checkpoint.WEIGHTS, FOLDER):
        if (folder / name).exists():
            (other / name).symlink_to((folder / name).resolve())
    return other
