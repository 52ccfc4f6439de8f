"""`sfms-robot bench`: speed as a ratio to a peer measured in the same run."""

from __future__ import annotations

import sys
import time
from enum import StrEnum
from pathlib import Path

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.lab.bench import ALL, BENCHES

EPILOG = "\n\n".join(
    f"[bold]{name}[/bold]{'' if bench.in_all else ' (not part of all)'}: {bench.about}"
    for name, bench in BENCHES.items()
)


class LiveAudio(StrEnum):
    mic = "mic"
    push = "push"


def bench_names() -> list[str]:
    """What can be measured."""
    return [ALL, *BENCHES]


def bench(
    name: str = typer.Argument(ALL, autocompletion=bench_names, help="What to measure; all: see below."),
    head: str | None = typer.Option(None, help="For 'lead', 'memory' and 'retarget --frames': this head."),
    frames: int | None = typer.Option(None, min=1, help="For 'retarget': count violations over so many wild frames."),
    minutes: float | None = typer.Option(
        None, min=0.0, help="For 'fuzz' and 'live': so long; else a million bytes each, 10 min, 30 of torture."
    ),
    audio: LiveAudio | None = typer.Option(None, help="For 'live': an emulated microphone (the default), or calls."),
    torture: bool = typer.Option(
        False, "--torture", help="For 'live': kill, stop, cut and unplug at random meanwhile."
    ),
    against: Path | None = typer.Option(
        None, help="A folder with another installation: it becomes the peer, and the two run in turn."
    ),
    hours: float | None = typer.Option(None, min=0.1, help="For 'memory': virtual hours (4)."),
    data: Path | None = typer.Option(None, help="For 'own-voice': a folder of calls, NAME_caller and NAME_agent each."),
    budget: bool = typer.Option(
        False, "--budget", help="For 'listener': operations and bytes a frame, counted, and what small computers need."
    ),
    write: Path | None = typer.Option(None, metavar="FILE", help="Write the rows as a page too (docs/performance.md)."),
    json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Measure, each figure beside that of a peer in the same run. Exit code 1: something is not as it should be."""
    from sfms_robot.app.out_files import checked_file
    from sfms_robot.lab.bench import run_bench

    if write is not None:
        checked_file(write, "--write")
    options = {
        "head": head, "frames": frames, "minutes": minutes, "audio": audio and audio.value, "torture": torture or None,
        "against": against, "hours": hours, "data": data, "budget": budget or None,
    }  # fmt: skip
    began_s = time.monotonic()
    result = run_bench(name, {key: value for key, value in options.items() if value is not None}, _say)
    if write is not None:
        from sfms_robot.lab.bench.measure import write_page

        write_page(write, result.figures, (time.monotonic() - began_s) / 60)
    if json:
        print_json(result.figures)
    else:
        from sfms_robot.cli.show import print_rows

        print_rows(result.table)
        for line in result.lines:
            print(line)
    if not result.passed:
        raise typer.Exit(1)


def _say(line: str) -> None:
    print(line, file=sys.stderr)
