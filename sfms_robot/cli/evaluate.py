"""`sfms-robot evaluate`: what a listener's parts are worth on held-out dyads, and a head's joints on faces."""

from __future__ import annotations

import json as json_module
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

app = typer.Typer(help="Evaluate listeners on held-out dyads, and heads on recorded faces.", no_args_is_help=True)

LISTENER = typer.Option("sfms-small", help="Shipped listener, or a folder with config.yaml and weights.")
DATA = typer.Option(..., help="Folder with validation/ (see `sfms-robot data compose`).")
JSON = typer.Option(False, "--json", help="Print one JSON object.")


@app.command()
def tokenizer(listener: str = LISTENER, data: Path = DATA, json: bool = JSON) -> None:
    """Reconstruction error (standardised units) by keyframe placement."""
    from sfms_robot.app.learn import evaluate_tokenizer

    _print(evaluate_tokenizer(listener, data), json)


@app.command("listener")
def listener_(
    listener: str = LISTENER,
    data: Path = DATA,
    seed: int = typer.Option(1, min=0, help="Of the sampling."),
    json: bool = JSON,
) -> None:
    """Nods, blinks, smiles and smoothness of the listener, beside those of the dyads' own listeners."""
    from sfms_robot.app.learn import evaluate_listener

    _print(evaluate_listener(listener, data, seed), json)


@app.command()
def fidelity(
    head: list[str] = typer.Option([], "--head", metavar="NAME|DIR", help="May be given often; all shipped heads."),
    data: Path | None = typer.Option(None, "--data", metavar="DIR", help="Face tracks (CSV) in place of the bundled."),
    json: bool = JSON,
) -> None:
    """The share of each recorded face's motion that a head can show, on the skin of the virtual head."""
    from sfms_robot.app.fidelity import fidelity as measure

    _print(measure(head, data), json)


def _print(result: Mapping[str, Any], json: bool) -> None:
    if json:
        print(json_module.dumps(result))
    else:
        from sfms_robot.cli.tables import print_rows

        print_rows(result["rows"])
