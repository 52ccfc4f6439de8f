"""`sfms-robot train`: the two phases of a listener, and when it does what."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import typer

from sfms_robot.cli.data_command import Order
from sfms_robot.errors import ConfigError

INTERRUPTED = 130

app = typer.Typer(help="Train a listener: its tokenizer, its predictor; and when it does what.", no_args_is_help=True)


class Placement(StrEnum):
    exact = "exact"
    static = "static"
    static_paper = "static_paper"
    learned = "learned"


class Device(StrEnum):
    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


CONFIG = typer.Option(..., help="A configs/training/*.yaml, or your own.")
DATA = typer.Option(None, help="Folder with train/ and validation/ (see `sfms-robot data compose`).")
OUT = typer.Option(None, help="Folder for config.yaml, weights and checkpoints; `run --listener` takes it.")
RESUME = typer.Option(False, "--resume", help="Go on from the checkpoint in --out, with the same settings and data.")
OVERWRITE = typer.Option(False, "--overwrite", help="Train anew although --out holds an earlier training.")
DEVICE = typer.Option(Device.auto, help="auto: the GPU if there is one.")
STEPS = typer.Option(None, min=1, help="Another number of steps than the file's.")
TENSORBOARD = typer.Option(None, help="Curves into OUT/tensorboard; without the flag, where tensorboard is installed.")
ORDER = typer.Option(None, help="Order of the channels in the files, if not their layout's own.")
ACCUMULATE = typer.Option(
    None, min=1, help="Pieces of a step's batch that each process takes one after the other; saves memory."
)
SCRATCH = typer.Option(None, help="Folder for frames that are read from disk as they are drawn, not held in memory.")
DRY_RUN = typer.Option(
    False, "--dry-run", help="One step of every stage on made-up frames, and what all of it would take; no data needed."
)
JSON = typer.Option(False, "--json", help="Print the figures as one JSON object.")


@app.command()
def tokenizer(
    config: Path = CONFIG,
    data: Path | None = DATA,
    out: Path | None = OUT,
    resume: bool = RESUME,
    overwrite: bool = OVERWRITE,
    device: Device = DEVICE,
    steps: int | None = STEPS,
    placement: Placement | None = typer.Option(None, help="Another keyframe placement than the file's, to compare."),
    tensorboard: bool | None = TENSORBOARD,
    order: Order | None = ORDER,
    accumulate: int | None = ACCUMULATE,
    scratch: Path | None = SCRATCH,
    dry_run: bool = DRY_RUN,
    json: bool = JSON,
) -> None:
    """Phase 1: keyframes, codes and inpainting (reconstruction of listener motion)."""
    if dry_run:
        _show_dry_run(config, json)
        return
    from sfms_robot.lab.learning.train_runs import TrainOptions, train_tokenizer

    data, out = _both(data, out)
    placed = placement.value if placement else None
    options = TrainOptions(
        config, data, out, resume, device.value, steps, placed, tensorboard, order.value if order else None, overwrite,
        accumulate, scratch,
    )  # fmt: skip
    _show(interruptible(lambda: train_tokenizer(options)), json)


@app.command()
def listener(
    config: Path = CONFIG,
    data: Path | None = DATA,
    out: Path | None = OUT,
    resume: bool = RESUME,
    overwrite: bool = OVERWRITE,
    device: Device = DEVICE,
    steps: int | None = STEPS,
    tensorboard: bool | None = TENSORBOARD,
    order: Order | None = ORDER,
    accumulate: int | None = ACCUMULATE,
    scratch: Path | None = SCRATCH,
    dry_run: bool = DRY_RUN,
    json: bool = JSON,
) -> None:
    """Phase 2: the next-token predictor, on the tokenizer found in --out."""
    if dry_run:
        _show_dry_run(config, json)
        return
    from sfms_robot.lab.learning.train_runs import TrainOptions, train_listener

    data, out = _both(data, out)
    options = TrainOptions(
        config, data, out, resume, device.value, steps, None, tensorboard, order.value if order else None, overwrite,
        accumulate, scratch,
    )  # fmt: skip
    _show(interruptible(lambda: train_listener(options)), json)


@app.command()
def events(
    data: Path = typer.Option(..., help="Folder of AMI tables (words, head_gestures, ...; CSV or CSV.gz)."),
    out: Path | None = typer.Option(None, metavar="FILE", help="Where the hazards go, as YAML."),
    all_series: bool = typer.Option(
        False, "--all-series", help="Learn from everybody, to compare; what comes out was taught on test."
    ),
    seed: int = typer.Option(1, min=0, help="Of the steps that are kept, and of the roll-outs."),
    json: bool = JSON,
) -> None:
    """When to nod, smile, laugh, look away: hazards of listening people, a minute's work."""
    from sfms_robot.cli.show_learning import print_figures, show
    from sfms_robot.lab.learning.events.event_training import train_events

    show(interruptible(lambda: train_events(data, out, all_series, seed)), json, print_figures)


@app.command()
def idle(
    listener: str = typer.Option(..., metavar="NAME|DIR", help="One that is told of events, trained."),
    data: Path = typer.Option(..., help="Folder with train/ and validation/ (see `sfms-robot data compose`)."),
    clips: int = typer.Option(12, min=1, help="Dyads of training that it listens to."),
    seed: int = typer.Option(1, min=0, help="Of what it draws."),
    json: bool = JSON,
) -> None:
    """The small motion of a resting face that a listener leaves out, into its folder: a minute's work."""
    from sfms_robot.cli.show_learning import show
    from sfms_robot.lab.learning.idle_fit import train_idle

    show(interruptible(lambda: train_idle(listener, data, clips, seed)), json)


def _both(data: Path | None, out: Path | None) -> tuple[Path, Path]:
    """Where from and where to, which everything but a dry run needs. Raises ConfigError."""
    if data is None or out is None:
        raise ConfigError(f"{'--data' if data is None else '--out'} is missing; only --dry-run goes without")
    return data, out


def _show_dry_run(config: Path, json: bool) -> None:
    from sfms_robot.cli.show_learning import print_dry_run, show
    from sfms_robot.config import load_training
    from sfms_robot.lab.learning.dry_run import dry_run

    show(dry_run(load_training(config)), json, print_dry_run)


def interruptible(train: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Ctrl-C says how to go on, where there is something to go on from."""
    try:
        return train()
    except KeyboardInterrupt as stopped:
        print(f"sfms-robot: {stopped if stopped.args else 'interrupted'}", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _show(figures: Mapping[str, Any], json: bool) -> None:
    from sfms_robot.cli.show_learning import show

    if not figures:  # of a process that is not the first of its group
        return
    if figures["resumed_at"] == figures["steps"]:
        print(f"sfms-robot: had already finished at step {figures['steps']}", file=sys.stderr)
    show(figures, json)
