"""`sfms-robot data`: make training data."""

from __future__ import annotations

import json as json_module
from pathlib import Path

import typer

app = typer.Typer(help="Training data: compose dyads.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keeps `compose` a subcommand while it is the only one."""


@app.command()
def compose(
    data: Path = typer.Option(..., help="Folder with ami_listener_annotations/ and, if at hand, more voices."),
    out: Path = typer.Option(..., help="Folder to write train/ and validation/ into."),
    minutes: float = typer.Option(75.0, min=1.0, help="Minutes of training dyads."),
    seed: int = typer.Option(1, min=0, help="One seed composes the same dyads."),
    json: bool = typer.Option(False, "--json", help="Print the figures as one JSON object."),
) -> None:
    """Compose dyads: real listening events (AMI), real motion, real voices, put together."""
    from sfms_robot.app.learn import compose_dyads

    figures = compose_dyads(data, out, minutes, seed)
    if json:
        print(json_module.dumps(figures))
