"""Every shipped listener on every engine: how fast, how soon, how much memory, and what a fast way costs in accuracy.

Rows "NAME ENGINE" lay the engines side by side (`engine_bench`); the row NAME is the one that `--engine auto` takes,
with what else is known of the listener. One without weights (the sizes of the papers) is measured with seeded ones:
what a frame costs does not depend on them. ARIG's context is filled by hand, as it is after an hour. `in_run` is what
a listener does beside a servo loop, where it has to share the machine.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sfms_robot import config
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, POSE_CHANNELS, FaceFrame, SpeakerFrame
from sfms_robot.lab.bench.engine_bench import EAGER, Stream, engines_of, load, process_row, take_turns
from sfms_robot.lab.bench.in_run import in_run
from sfms_robot.lab.bench.measure import Row, Told
from sfms_robot.lab.bench.samplers import samplers
from sfms_robot.ports import Listener

if TYPE_CHECKING:
    from sfms_robot.listeners.arig.model import ArigModel

NAMES: Final = ("sfms-small", "arig-small", "arig-paper")
PAPER: Final = "sfms-paper"  # ships as a training only
TRAINED: Final = "trained"
BF16: Final = "torch bf16"
SEEDED: Final = "seeded, not trained"
MINUTES: Final = 60
MINUTE: Final = 60 * FRAME_HZ
COLUMNS: Final = {
    "median": "frame ms", "p99": "p99", "ratio": "of eager", "hearing_ms": "hearing ms", "planning_ms": "planning ms",
    "first_plan_s": "first plan s", "resident_mb": "MB", "distance": "distance",
}  # fmt: skip


def listener(budget: bool = False) -> Told:
    """Rows of `sfms-robot bench listener`; the threads that torch uses are as before when it returns.

    `budget`: what a frame costs, counted, and what small computers need for it (`compute_budget`), instead.
    """
    import torch

    if budget:
        from sfms_robot.lab.bench.compute_budget import budget as counted

        return counted()

    threads = torch.get_num_threads()
    rows: dict[str, Row] = {}
    torch.set_num_threads(1)
    try:
        for name in NAMES:
            with tempfile.TemporaryDirectory() as scratch:
                rows |= _measured(name, Path(scratch))
        rows |= _sfms_paper()
    finally:
        torch.set_num_threads(threads)
    return Told(Told.of_rows(rows).figures, _table(rows), ["a frame is all of a step, on average over a hop"])


def _table(rows: Mapping[str, Row]) -> list[dict[str, Any]]:
    """A line per engine."""
    found = []
    for name, each in rows.items():
        if name in NAMES:
            continue  # one of the others again
        line: dict[str, Any] = {"measured": name}
        for key, title in COLUMNS.items():
            value = each.get(key)
            line[title] = value["p50"] if isinstance(value, dict) else value
        found.append(line)
    return found


def _measured(name: str, scratch: Path) -> dict[str, Row]:
    """Rows of one shipped listener, with trained weights where it has them."""
    folder, weights = with_weights(name, scratch)
    settings = config.load_listener(folder / "config.yaml")
    ways = engines_of(folder, scratch)
    speaker = _speaker()
    streams: dict[str, Stream] = {}
    for way, (where, engine) in ways.items():
        found = load(where, engine, eager=way == EAGER)
        streams[way] = Stream(found, _later(found, found.start(0), speaker))
    if isinstance(settings, config.Arig):
        found = _in_bf16(ways[EAGER][0], settings)
        streams[BF16] = Stream(found, _later(found, found.start(0), speaker))
    take_turns(streams, speaker)
    rows = {f"{name} {way}": stream.figures(streams[EAGER]) for way, stream in streams.items()}
    for way, stream in streams.items():
        if way != EAGER:
            rows[f"{name} {way}"]["distance"] = _distance(stream.listener, streams[EAGER].listener, speaker)
        if way in ways and way != EAGER:
            rows[f"{name} {way}"] |= process_row(*ways[way])
    chosen = streams[[*ways][-1]]
    rows[name] = rows[f"{name} {[*ways][-1]}"] | {
        "eager_fp32_fps": rows[f"{name} {EAGER}"]["fps"],
        "params": _parameters(streams[EAGER].listener),
        "weights": weights,
    }
    if isinstance(settings, config.Arig):
        early = Stream(chosen.listener, _later(chosen.listener, chosen.listener.start(0), speaker, minutes=1))
        take_turns({name: early}, speaker)
        rows[name] |= {
            "minute_1_ms": float(np.median(early.frame_ms)),
            f"minute_{MINUTES}_ms": float(np.median(chosen.frame_ms)),
            "in_run": in_run(folder),
            "samplers": samplers(_how(streams[EAGER].listener), speaker) if weights == TRAINED else None,
        }
    return rows


def _in_bf16(where: Path, settings: config.Arig) -> Listener:
    """An ARIG on torch with its large layers in bf16, which no configuration asks for: its row says why."""
    from sfms_robot.listeners.arig import networks, torch_engine

    found = load(where, "torch", eager=True)
    how = _how(found)
    how.engine = torch_engine(
        settings.model_copy(update={"precision": "fp32"}), networks.with_layers(how.model, networks.Bf16Linear)
    )
    how.build_graphs()
    return found


def _how(listener: Listener) -> Any:
    """The model of motion, without the events that it may be told of."""
    return getattr(listener, "how", listener)


def _parameters(listener: Listener) -> int:
    return sum(each.numel() for each in _how(listener).model.parameters())


def with_weights(name: str, scratch: Path) -> tuple[Path, str]:
    """The folder of a shipped listener, and what weights it has in words; where none ship, seeded ones in `scratch`."""
    shipped = data_dir("configs") / "listeners" / name
    settings = config.load_listener(shipped / "config.yaml")
    if (shipped / "model.safetensors").is_file() or not isinstance(settings, config.Arig):
        return shipped, TRAINED
    return _seeded(shipped, settings, scratch / "seeded"), SEEDED


def _seeded(shipped: Path, settings: config.Arig, folder: Path) -> Path:
    """A listener's folder with seeded weights; its graphs are those that ship."""
    import torch

    from sfms_robot.listeners import checkpoint
    from sfms_robot.listeners.arig.model import ArigModel
    from sfms_robot.listeners.engine import FOLDER, has_graphs

    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = ArigModel(settings)
    _inside(model, settings)
    checkpoint.save_config(folder, settings)
    checkpoint.save_weights(folder / checkpoint.WEIGHTS, model)
    if has_graphs(shipped):
        shutil.copytree(shipped / FOLDER, folder / FOLDER)
    return folder


def _inside(model: ArigModel, settings: config.Arig) -> None:
    """Motion inside 0..1, where nothing is clipped."""
    import torch

    model.motion_mean.copy_(torch.tensor([0.5 * (name not in POSE_CHANNELS) for name in settings.channels]))
    model.motion_std.fill_(0.02)


def _sfms_paper() -> dict[str, Row]:
    """The size of the paper, with seeded weights, on torch."""
    import torch

    from sfms_robot.listeners.sfms import torch_engine
    from sfms_robot.listeners.sfms.model import SfmsModel
    from sfms_robot.listeners.sfms.stream import SfmsListener

    training = config.load_training(data_dir("configs") / "training" / f"{PAPER}.yaml")
    if not isinstance(training, config.Training):
        raise ConfigError(f"{PAPER}.yaml is not the training of an SFMS listener")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = SfmsModel(training.listener)
    streams: dict[str, Stream] = {}
    for way in (EAGER, "torch"):
        found = SfmsListener(training.listener, torch_engine(training.listener, model))
        streams[way] = Stream(found if way == EAGER else found.build_graphs(), found.start(0))
    take_turns(streams, _speaker())
    rows = {f"{PAPER} {way}": stream.figures(streams[EAGER]) for way, stream in streams.items()}
    params = sum(each.numel() for each in model.parameters())
    return {way: each | {"params": params, "weights": SEEDED} for way, each in rows.items()}


def _later(listener: Listener, memory: Any, speaker: list[SpeakerFrame], minutes: int = MINUTES) -> Any:
    """A memory as it is after so many minutes, its whole chunks made up; one without chunks as it is."""
    _, memory = listener.step(speaker[0], memory)
    how = getattr(memory, "how", memory)
    context = getattr(how, "context", None)
    if context is None:
        return listener.start(0)
    made_up = np.random.default_rng(0).standard_normal(context.shape, np.float32)
    older = replace(how, frames=minutes * MINUTE, context=made_up)
    return older if how is memory else replace(memory, how=older)


def _distance(quick: Listener, exact: Listener, speaker: list[SpeakerFrame]) -> float:
    """RMS difference of motion over its deviation: every plan made by both, from the memory of the exact one."""
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


def _speaker(frames: int = 100) -> list[SpeakerFrame]:
    """Both people talk in turns; noise serves, since nothing is judged but time."""
    rng = np.random.default_rng(0)
    out = []
    for index in range(frames):
        level = (0.1, 1e-3) if index // 25 % 2 else (1e-3, 0.1)
        theirs, ours = (rng.normal(0, each, FRAME_SAMPLES).astype(np.float32) for each in level)
        time_s = (index + 1) * FRAME_S
        out.append(SpeakerFrame(time_s, theirs, FaceFrame.of(time_s, rng.uniform(0, 0.2, 58)), ours))
    return out
