"""`sfms-robot replay`: look at a recorded run."""

from __future__ import annotations

import json as json_module
from pathlib import Path

import typer


def replay(
    folder: Path = typer.Argument(..., metavar="DIR", help="Folder that `sfms-robot run --record` wrote."),
    plot: Path | None = typer.Option(None, help="PNG: voice, head pose, six face channels, joint angles over time."),
    sheet: Path | None = typer.Option(None, help="PNG: the virtual head at twelve instants of the run."),
    json: bool = typer.Option(False, "--json", help="Print what was found as one JSON object."),
) -> None:
    """Draw a recorded run, or say what is in it."""
    from sfms_robot.app.replay import replay_run

    summary = replay_run(folder, plot, sheet)
    if json:
        print(json_module.dumps(summary))
    else:
        for key, value in summary.items():
            print(f"{key}: {value}")
