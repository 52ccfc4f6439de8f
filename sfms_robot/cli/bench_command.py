"""`sfms-robot bench`: speed as a ratio to a peer measured in the same run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

from typer import Argument, Exit, Option

from sfms_robot.cli.show import JSON, Result, aside, print_rows, show
from sfms_robot.lab.bench import ALL, BENCHES

EPILOG = "\n\n".join(
    f"[bold]{name}[/bold]{'' if bench.in_all else ' (not part of all)'}: {bench.about}"
    for name, bench in BENCHES.items()
)


def bench(
    name: str = Argument(ALL, autocompletion=lambda: [ALL, *BENCHES], help="The bench; all: see below."),
    head: str | None = Option(None, help="For 'lead' and 'memory': this head."),
    minutes: float | None = Option(None, min=0.0, help="For 'live': so long; else 10 min, 30 with --torture."),
    audio: Literal["mic", "push"] | None = Option(
        None, help="For 'live': an emulated microphone (the default), or calls."
    ),
    torture: bool = Option(False, "--torture", help="For 'live': kill, stop, cut and unplug at random meanwhile."),
    against: Path | None = Option(
        None, help="A folder with another installation: it becomes the peer, and the two run in turn."
    ),
    hours: float | None = Option(None, min=0.1, help="For 'memory': virtual hours (4)."),
    data: Path | None = Option(None, help="For 'own-voice': a folder of calls, NAME_caller and NAME_agent each."),
    device: Literal["cpu", "cuda"] | None = Option(None, help="For 'serve': cuda: 64, 256, 1,024 heads on a GPU."),
    write: Path | None = Option(
        None, metavar="FILE", help="Write the rows as a page too (docs/science/performance.md)."
    ),
    json: bool = JSON,
) -> None:
    """Measure, each figure beside that of a peer in the same run. Exit code 1: a figure misses its limit."""
    from sfms_robot.app.output_paths import checked_file
    from sfms_robot.lab.bench import run_bench

    if write is not None:
        checked_file(write, "--write")
    options = {
        "head": head,
        "minutes": minutes,
        "audio": audio,
        "torture": torture or None,
        "against": against,
        "hours": hours,
        "data": data,
        "device": device,
    }
    began_s = time.monotonic()
    found = run_bench(
        name,
        {key: value for key, value in options.items() if value is not None},
        aside,
    )
    if write is not None:
        from sfms_robot.lab.bench.measure import write_page

        write_page(write, found.figures, (time.monotonic() - began_s) / 60)

    def printed(_: Result) -> None:
        print_rows(found.table)
        for line in found.lines:
            print(line)

    show(found.figures, json, printed)
    if not found.passed:
        raise Exit(1)
