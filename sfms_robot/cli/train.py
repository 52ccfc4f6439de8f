"""`sfms-robot train`: the two phases of a listener."""

from __future__ import annotations

import json as json_module
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import typer

app = typer.Typer(help="Train a listener: first its tokenizer, then its predictor.", no_args_is_help=True)

CONFIG = typer.Option(..., help="A configs/training/*.yaml, or your own.")
DATA = typer.Option(..., help="Folder with train/ and validation/ (see `sfms-robot data compose`).")
OUT = typer.Option(..., help="Folder for config.yaml and weights; `run --listener` takes it.")
JSON = typer.Option(False, "--json", help="Print the figures as one JSON object.")


class Placement(StrEnum):
    exact = "exact"
    static = "static"
    static_paper = "static_paper"
    learned = "learned"


@app.command()
def tokenizer(
    config: Path = CONFIG,
    data: Path = DATA,
    out: Path = OUT,
    placement: Placement | None = typer.Option(None, help="Another keyframe placement than the file's, to compare."),
    steps: int | None = typer.Option(None, min=1, help="Another number of steps than the file's."),
    json: bool = JSON,
) -> None:
    """Phase 1: keyframes, codes and inpainting (reconstruction of listener motion)."""
    from sfms_robot.app.learn import train_tokenizer

    _print(train_tokenizer(config, data, out, placement.value if placement else None, steps), json)


@app.command()
def listener(config: Path = CONFIG, data: Path = DATA, out: Path = OUT, json: bool = JSON) -> None:
    """Phase 2: the next-token predictor, on the tokenizer found in --out."""
    from sfms_robot.app.learn import train_listener

    _print(train_listener(config, data, out), json)


def _print(figures: Mapping[str, Any], json: bool) -> None:
    if json:
        print(json_module.dumps(figures))
    else:
        for key, value in figures.items():
            print(f"{key}: {value}")
