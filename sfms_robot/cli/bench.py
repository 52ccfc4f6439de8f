"""`sfms-robot bench`: speed as a ratio to a peer measured in the same run."""

from __future__ import annotations

import json as json_module
from enum import StrEnum

import typer


class Bench(StrEnum):
    all = "all"
    startup = "startup"
    bus = "bus"
    retarget = "retarget"
    listener = "listener"


def bench(
    name: Bench = typer.Argument(Bench.all, help="What to measure."),
    json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Measure: start of the command line, one bus tick, one retarget tick, one listener plan."""
    from sfms_robot.app.bench import run_bench

    result = run_bench(name.value)
    if json:
        print(json_module.dumps(result))
    else:
        from sfms_robot.cli.tables import print_bench

        print_bench(result)
