"""Behind `train`: a configuration and a data folder in, weights and figures out, watched while it runs."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress

from sfms_robot import config
from sfms_robot.config import load_training, parse_training
from sfms_robot.corpora.collection import Order
from sfms_robot.errors import ConfigError
from sfms_robot.evaluation.sampling_calibration import calibrate, rounds
from sfms_robot.learning.arig.trainer import train_arig
from sfms_robot.learning.job import Run
from sfms_robot.learning.resume import checkpoint_file
from sfms_robot.learning.sfms import predictor_trainer as listener
from sfms_robot.learning.sfms import tokenizer_trainer as tokenizer
from sfms_robot.learning.watch import Watch, progress_bar, tensorboard, together
from sfms_robot.listeners import checkpoint

DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True)
class TrainOptions:
    """What the command line says. `steps` and `placement` replace the file's; `tensorboard` None: if installed.

    `order` is that of the channels in the data, if not its layout's own. `overwrite`: what an earlier training left in
    `out` may be lost.
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


def train_tokenizer(options: TrainOptions) -> dict[str, Any]:
    """Phase 1. Returns its figures and minutes."""
    settings = train_settings(options, "tokenizer")
    if isinstance(settings, config.ArigTraining):
        raise ConfigError(f"{options.file}: listener.kind = 'arig' has no tokenizer; `train listener` is all of it")
    _spare(options, tokenizer.WEIGHTS, "tokenizer")
    with run_of(options) as run:
        began_s = time.monotonic()
        return _timed(tokenizer.train_tokenizer(settings, options.data, options.out, run, options.order), began_s)


def train_listener(options: TrainOptions) -> dict[str, Any]:
    """SFMS: phase 2, on the tokenizer in `options.out`. ARIG: all of it. Returns its figures and minutes."""
    settings = train_settings(options, "predictor")
    if isinstance(settings, config.ArigTraining) and options.order is not None:
        raise ConfigError(f"--order {options.order}: an arig listener is trained on files in their layout's own order")
    _spare(options, checkpoint.WEIGHTS, "arig" if isinstance(settings, config.ArigTraining) else "listener")
    began_s = time.monotonic()
    with run_of(options) as run:
        if isinstance(settings, config.ArigTraining):
            return _timed(train_arig(settings, options.data, options.out, run), began_s)
        figures = listener.train_listener(settings, options.data, options.out, run, options.order)
    _calibrate(settings, options)
    return _timed(figures, began_s)


def _calibrate(settings: config.Training, options: TrainOptions) -> None:
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("calibrating by roll-outs", total=rounds(settings))
        calibrate(settings, options.data, options.out, options.order, partial(progress.advance, task))


def _spare(options: TrainOptions, weights: str, job: str) -> None:
    """Raise ConfigError where this training would be the end of an earlier one."""
    if options.resume or options.overwrite:
        return
    for file in (options.out / weights, checkpoint_file(options.out, job)):
        if file.exists():
            raise ConfigError(f"{file} is of an earlier training: --resume goes on with it, --overwrite begins anew")


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
    """How the command line asks for it to be run, with a progress bar."""
    device = device_of(options.device)
    with ExitStack() as stack:
        watches: list[Watch] = []
        installed = importlib.util.find_spec("tensorboard") is not None
        if options.tensorboard or (options.tensorboard is None and installed):
            watches.append(stack.enter_context(tensorboard(options.out / "tensorboard")))
        watches.append(stack.enter_context(progress_bar()))
        yield Run(options.resume, device, together(watches))


def _timed(figures: dict[str, Any], began_s: float) -> dict[str, Any]:
    return {**figures, "minutes": round((time.monotonic() - began_s) / 60, 2)}
