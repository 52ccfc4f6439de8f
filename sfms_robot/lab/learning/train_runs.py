"""Behind `train`: a configuration and a data folder in, weights and figures out, watched while it runs."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress

from sfms_robot import config
from sfms_robot.config import load_training, parse_training
from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.evaluation.sampling_calibration import calibrate, rounds
from sfms_robot.lab.learning.arig.trainer import train_arig
from sfms_robot.lab.learning.job import Run, Watch, progress_bar, tensorboard, together
from sfms_robot.lab.learning.process_group import joined, local_rank
from sfms_robot.lab.learning.resume import checkpoint_file
from sfms_robot.lab.learning.sfms import predictor_trainer as listener
from sfms_robot.lab.learning.sfms import tokenizer_trainer as tokenizer
from sfms_robot.listeners import checkpoint

DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of the command line. `steps` and `placement` replace the file's; `tensorboard` None: if installed.

    `order` is that of the channels in the data, if not its layout's own. `overwrite`: what an earlier training left in
    `out` may be lost. `accumulate` and `scratch`: of `learning.job.Run`.

    Several processes train together where `torchrun` starts them; those but the first return no figures. What torchrun
    starts again after one of them died resumes from the checkpoint.
    """

    file: Path
    data: Path
    out: Path
    resume: bool = False
    device: str = "auto"
    steps: int | None = None
    placement: str | None = None
    tensorboard: bool | None = None
    order: Order | None = None
    overwrite: bool = False
    accumulate: int | None = None
    scratch: Path | None = None


def train_tokenizer(options: TrainOptions) -> dict[str, Any]:
    """Phase 1. Returns its figures and minutes."""
    settings = train_settings(options, "tokenizer")
    if isinstance(settings, config.ArigTraining):
        raise ConfigError(f"{options.file}: listener.kind = 'arig' has no tokenizer; `train listener` is all of it")
    began_s = time.monotonic()
    with run_of(options) as run:
        run = _begun(run, options, tokenizer.WEIGHTS, "tokenizer", checkpoint.WEIGHTS, checkpoint.CONFIG)
        figures = tokenizer.train_tokenizer(settings, options.data, options.out, run, options.order)
    return _timed(figures, began_s) if run.group.first else {}


def train_listener(options: TrainOptions) -> dict[str, Any]:
    """SFMS: phase 2, on the tokenizer in `options.out`. ARIG: all of it. Returns its figures and minutes."""
    settings = train_settings(options, "predictor")
    if isinstance(settings, config.ArigTraining) and options.order is not None:
        raise ConfigError(f"--order {options.order}: an arig listener is trained on files in their layout's own order")
    arig = isinstance(settings, config.ArigTraining)
    began_s = time.monotonic()
    with run_of(options) as run:
        run = _begun(run, options, checkpoint.WEIGHTS, "arig" if arig else "listener")
        if isinstance(settings, config.ArigTraining):
            figures = train_arig(settings, options.data, options.out, run)
        else:
            figures = listener.train_listener(settings, options.data, options.out, run, options.order)
    if not run.group.first:
        return {}
    if isinstance(settings, config.Training):
        _calibrate(settings, options)
    return _timed(figures, began_s)


def _calibrate(settings: config.Training, options: TrainOptions) -> None:
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("calibrating by roll-outs", total=rounds(settings))
        calibrate(settings, options.data, options.out, options.order, partial(progress.advance, task))


def _begun(run: Run, options: TrainOptions, weights: str, job: str, *others: str) -> Run:
    """Return the run, from its checkpoint where it was started again. Raises ConfigError where files of an earlier
    training of this job or of `others` would be replaced.
    """
    if run.group.restarts:
        return replace(run, resume=checkpoint_file(options.out, job).exists())
    if options.resume or options.overwrite:
        return run
    run.group.wait()  # nobody has written anything yet
    for file in (options.out / weights, checkpoint_file(options.out, job), *(options.out / name for name in others)):
        if file.exists():
            raise ConfigError(f"{file} is of an earlier training: --resume continues it, --overwrite starts again")
    run.group.wait()
    return run


def device_of(name: str) -> torch.device:
    """`cpu`, `cuda`, or `auto`: the GPU if there is one. Raises ConfigError."""
    if name not in DEVICES:
        raise ConfigError(f"--device {name!r} is not one of {', '.join(DEVICES)}")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda: torch sees no CUDA device here (auto, cpu)")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def train_settings(options: TrainOptions, phase: str = "training") -> config.Training | config.ArigTraining:
    """The training file with what the command line changes, `phase` being the one whose steps it means."""
    settings = load_training(options.file)
    raw = settings.model_dump(mode="json")
    if isinstance(settings, config.ArigTraining):
        phase = "training"
    if options.placement is not None:
        raw["listener"]["placement"] = options.placement
    if options.steps is not None:
        raw[phase]["steps"] = options.steps
    return parse_training(raw, options.file)


@contextmanager
def run_of(options: TrainOptions) -> Iterator[Run]:
    """Yield the run with the settings of the command line, and a progress bar."""
    device = device_of(options.device)
    with ExitStack() as stack:
        if device.type == "cuda":
            device = torch.device("cuda", local_rank())
        group = stack.enter_context(joined(device))
        watches: list[Watch] = []
        installed = importlib.util.find_spec("tensorboard") is not None
        if group.first and (options.tensorboard or (options.tensorboard is None and installed)):
            watches.append(stack.enter_context(tensorboard(options.out / "tensorboard")))
        if group.first:
            watches.append(stack.enter_context(progress_bar()))
        yield Run(
            resume=options.resume,
            device=device,
            watch=together(watches),
            group=group,
            accumulate=options.accumulate,
            scratch=options.scratch,
        )


def _timed(figures: dict[str, Any], began_s: float) -> dict[str, Any]:
    return {**figures, "minutes": round((time.monotonic() - began_s) / 60, 2)}
