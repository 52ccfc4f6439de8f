"""`sfms-robot train`: the two phases of a listener, and when it does what."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import typer

from sfms_robot.cli.data_command import Order

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
DATA = typer.Option(..., help="Folder with train/ and validation/ (see `sfms-robot data compose`).")
OUT = typer.Option(..., help="Folder for config.yaml, weights and checkpoints; `run --listener` takes it.")
RESUME = typer.Option(False, "--resume", help="Go on from the checkpoint in --out, with the same settings and data.")
OVERWRITE = typer.Option(False, "--overwrite", help="Train anew although --out holds an earlier training.")
DEVICE = typer.Option(Device.auto, help="auto: the GPU if there is one.")
STEPS = typer.Option(None, min=1, help="Another number of steps than the file's.")
TENSORBOARD = typer.Option(None, help="Curves into OUT/tensorboard; without the flag, where tensorboard is installed.")
ORDER = typer.Option(None, help="Order of the channels in the files, if not their layout's own.")
JSON = typer.Option(False, "--json", help="Print the figures as one JSON object.")


@app.command()
def tokenizer(
    config: Path = CONFIG,
    data: Path = DATA,
    out: Path = OUT,
    resume: bool = RESUME,
    overwrite: bool = OVERWRITE,
    device: Device = DEVICE,
    steps: int | None = STEPS,
    placement: Placement | None = typer.Option(None, help="Another keyframe placement than the file's, to compare."),
    tensorboard: bool | None = TENSORBOARD,
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Phase 1: keyframes, codes and inpainting (reconstruction of listener motion)."""
    from sfms_robot.app.train.train_runs import TrainOptions, train_tokenizer

    placed = placement.value if placement else None
    options = TrainOptions(
        config, data, out, resume, device.value, steps, placed, tensorboard, order.value if order else None, overwrite
    )
    _show(interruptible(lambda: train_tokenizer(options)), json)


@app.command()
def listener(
    config: Path = CONFIG,
    data: Path = DATA,
    out: Path = OUT,
    resume: bool = RESUME,
    overwrite: bool = OVERWRITE,
    device: Device = DEVICE,
    steps: int | None = STEPS,
    tensorboard: bool | None = TENSORBOARD,
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Phase 2: the next-token predictor, on the tokenizer found in --out."""
    from sfms_robot.app.train.train_runs import TrainOptions, train_listener

    options = TrainOptions(
        config, data, out, resume, device.value, steps, None, tensorboard, order.value if order else None, overwrite
    )
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
    from sfms_robot.app.train.event_training import train_events
    from sfms_robot.cli.show_learning import print_figures, show

    show(interruptible(lambda: train_events(data, out, all_series, seed)), json, print_figures)


def interruptible(train: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Ctrl-C says how to go on, where there is something to go on from."""
    try:
        return train()
    except KeyboardInterrupt as stopped:
        print(f"sfms-robot: {stopped if stopped.args else 'interrupted'}", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _show(figures: Mapping[str, Any], json: bool) -> None:
    from sfms_robot.cli.show_learning import show

    if figures["resumed_at"] == figures["steps"]:
        print(f"sfms-robot: had already finished at step {figures['steps']}", file=sys.stderr)
    show(figures, json)
