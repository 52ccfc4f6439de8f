"""Every shipped listener, frame by frame: how fast, how evenly, how soon, and what the fast path costs in accuracy.

A listener without weights (the size of ARIG's paper) is measured with seeded ones: what a step costs does not depend
on them. Its context is filled by hand, as it is after the first two minutes of running. `in_run` is what it does
beside a servo loop, where it has to share the machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sfms_robot import config
from sfms_robot.app.bench.in_run import in_run
from sfms_robot.app.bench.measure import Row, Told, row
from sfms_robot.app.bench.samplers import samplers
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, POSE_CHANNELS, FaceFrame, SpeakerFrame
from sfms_robot.ports import Listener

if TYPE_CHECKING:
    from sfms_robot.listeners.arig.stream import ArigListener, Memory

NAMES: Final = ("arig-paper", "arig-small", "sfms-small")
PAPER: Final = "sfms-paper"  # ships as a training only
STEPS: Final = 300
WARM_UP: Final = 10
LIMIT_S: Final = 6.0  # for one measurement: a machine busy with other things is told so, not waited for
MINUTE: Final = 60 * FRAME_HZ
START: Final = """
import sys
from pathlib import Path
import numpy as np
from sfms_robot.frames import SpeakerFrame
from sfms_robot.listeners.registry import load_listener
listener = load_listener(Path(sys.argv[1]))
listener.step(SpeakerFrame(0.04, np.zeros(640, np.float32)), listener.start(0))
"""


def listener(budget: bool = False) -> dict[str, Row] | Told:
    """One row per listener; the threads that torch uses are as before when it returns.

    `budget`: what a frame costs, counted, and what small computers need for it (`compute_budget`), instead.
    """
    import torch

    if budget:
        from sfms_robot.app.bench.compute_budget import budget as counted

        return counted()

    threads = torch.get_num_threads()
    try:
        rows = {name: _measured(data_dir("configs") / "listeners" / name) for name in NAMES}
        return rows | {PAPER: _sfms_paper()}
    finally:
        torch.set_num_threads(threads)


def _measured(folder: Path) -> Row:
    settings = config.load_listener(folder / "config.yaml")
    return _arig(folder, settings) if isinstance(settings, config.Arig) else _sfms(folder)


def _sfms(folder: Path) -> Row:
    from sfms_robot.listeners.registry import load_listener

    return _plans(load_listener(folder)) | {"cold_start_s": _cold_start_s(folder), "weights": "trained"}


def _sfms_paper() -> Row:
    """The size of the paper, with seeded weights: what a plan costs does not depend on them."""
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
    params = sum(each.numel() for each in model.parameters())
    return _plans(SfmsListener(training.listener, torch_engine(training.listener, model)).build_graphs()) | {
        "params": params,
        "weights": "seeded, not trained",
    }


def _plans(listener: Listener) -> Row:
    """Durations of plans beside the time there is for one, on one thread and on two; the faster counts."""
    steps_ms = _on_one_and_two(listener, listener.start(0), _speaker())
    plans_ms = {n: sorted(each)[-(len(each) // listener.hop) :] for n, each in steps_ms.items()}  # the others listen
    fastest = min(plans_ms, key=lambda n: float(np.median(plans_ms[n])))
    period_ms = listener.hop * FRAME_S * 1e3
    return row(plans_ms[fastest], [period_ms], "ms", f"hop of {listener.hop} frames") | {
        "fps": _fps(steps_ms[fastest]),
        "threads": fastest,
        "step_ms": _spread(steps_ms[fastest]),
        "one_thread_plan_ms": float(np.median(plans_ms[1])),
        "all_threads_plan_ms": float(np.median(plans_ms[max(plans_ms)])),
        "one_thread_fps": _fps(steps_ms[1]),
    }


def _arig(folder: Path, settings: config.Arig) -> Row:
    import torch

    from sfms_robot.listeners import checkpoint
    from sfms_robot.listeners.arig import torch_engine
    from sfms_robot.listeners.arig.model import ArigModel
    from sfms_robot.listeners.arig.stream import ArigListener

    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = ArigModel(settings)
    trained = (folder / checkpoint.WEIGHTS).is_file()
    if trained:
        checkpoint.load_weights(folder / checkpoint.WEIGHTS, model)
    else:  # motion inside 0..1, where nothing is clipped
        model.motion_mean.copy_(torch.tensor([0.5 * (name not in POSE_CHANNELS) for name in settings.channels]))
        model.motion_std.fill_(0.02)
    plain = settings.model_copy(update={"precision": "fp32"})
    quick = ArigListener(settings, torch_engine(settings, model)).build_graphs()
    exact = ArigListener(plain, torch_engine(plain, model))
    speaker = _speaker()
    full = _after_minutes(quick, 60)
    eager_ms = _times_of(exact, full, speaker, threads=1, steps=STEPS // 2)
    both_ms = _on_one_and_two(quick, full, speaker)
    fastest = min(both_ms, key=lambda n: float(np.median(both_ms[n])))
    early_ms = _times_of(quick, _after_minutes(quick, 1), speaker, threads=fastest, steps=STEPS // 2)
    with tempfile.TemporaryDirectory() as scratch:
        checkpoint.save_config(Path(scratch), settings)
        checkpoint.save_weights(Path(scratch) / checkpoint.WEIGHTS, model)
        cold_s = _cold_start_s(Path(scratch))
        driving = in_run(Path(scratch))
    return row(both_ms[fastest], eager_ms, "ms", "plain fp32 on one thread") | {
        "fps": _fps(both_ms[fastest]),
        "threads": fastest,
        "step_ms": _spread(both_ms[fastest]),
        "eager_fp32_fps": _fps(eager_ms),
        "one_thread_fps": _fps(both_ms[1]),
        "all_threads_fps": _fps(both_ms[max(both_ms)]),
        "minute_1_ms": float(np.median(early_ms)),
        "minute_60_ms": float(np.median(both_ms[fastest])),
        "fast_distance": _distance(quick, exact, speaker),
        "cold_start_s": cold_s,
        "in_run": driving,
        "params": sum(each.numel() for each in model.parameters()),
        "samplers": samplers(exact, speaker) if trained else None,
        "weights": "trained" if trained else "seeded, not trained",
    }


def _on_one_and_two(listener: Listener, memory: Any, speaker: list[SpeakerFrame]) -> dict[int, list[float]]:
    """`_times_of` by number of threads; one alone on a single core."""
    counts = {1, min(2, os.cpu_count() or 1)}
    return {n: _times_of(listener, memory, speaker, threads=n, steps=STEPS) for n in counts}


def _times_of(listener: Listener, memory: Any, speaker: list[SpeakerFrame], threads: int, steps: int) -> list[float]:
    """Durations of steps [ms] with so many threads."""
    import torch

    torch.set_num_threads(threads)
    return _steps(listener, memory, speaker, steps)


def _steps(listener: Listener, memory: Any, speaker: list[SpeakerFrame], steps: int) -> list[float]:
    """Durations [ms] of as many steps, or of those that fit into `LIMIT_S`, after some to warm up."""
    out: list[float] = []
    until_s = time.perf_counter() + LIMIT_S
    for index in range(WARM_UP + steps):
        began_s = time.perf_counter()
        _, memory = listener.step(speaker[index % len(speaker)], memory)
        ended_s = time.perf_counter()
        out.append((ended_s - began_s) * 1e3)
        if ended_s > until_s and index > 2 * WARM_UP:
            break
    return out[WARM_UP:]


def _after_minutes(listener: ArigListener, minutes: int) -> Memory:
    """A memory as it is after so many minutes, its whole chunks made up."""
    memory = listener.start(0)
    _, memory = listener.step(_speaker()[0], memory)
    made_up = np.random.default_rng(0).standard_normal(memory.context.shape, np.float32)
    return replace(memory, frames=minutes * MINUTE, context=made_up)


def _distance(quick: ArigListener, exact: ArigListener, speaker: list[SpeakerFrame]) -> float:
    """RMS difference of motion over its deviation: every frame made by both, from the memory of the exact one."""
    memory, frames = exact.start(0), []
    for frame in speaker:
        other, _ = quick.step(frame, memory)
        plan, memory = exact.step(frame, memory)
        frames.append((plan.frames[0], other.frames[0]))
    made, other_made = np.array(frames).swapaxes(0, 1)
    moving = made.std(0) > 1e-6
    share = np.sqrt(np.square(other_made - made).mean(0))[moving] / made.std(0)[moving]
    return float(np.sqrt(np.mean(share**2)))


def _cold_start_s(folder: Path) -> float:
    """From the start of a process to its first frame."""
    began_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", START, str(folder)], check=True)
    return time.perf_counter() - began_s


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


def _fps(steps_ms: list[float]) -> float:
    return 1e3 / float(np.mean(steps_ms))


def _spread(steps_ms: list[float]) -> dict[str, float]:
    return {"p50": float(np.percentile(steps_ms, 50)), "p99": float(np.percentile(steps_ms, 99))}
