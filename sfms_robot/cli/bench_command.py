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
    name: str = Argument(
        ALL, autocompletion=lambda: [ALL, *BENCHES], help="Name of the bench; all runs every one (listed below)."
    ),
    head: str | None = Option(None, help="Head, for 'lead' and 'memory'."),
    minutes: float | None = Option(None, min=0.0, help="Duration of 'live'. Default: 10 min, 30 with --torture."),
    audio: Literal["mic", "push"] | None = Option(
        None, help="Input of 'live': an emulated microphone (the default), or calls."
    ),
    torture: bool = Option(False, "--torture", help="For 'live': kill, stop, cut and unplug parts at random."),
    against: Path | None = Option(None, help="Folder with another installation to compare with; the two run in turn."),
    hours: float | None = Option(None, min=0.1, help="Virtual hours, for 'memory'. Default: 4."),
    data: Path | None = Option(None, help="Folder of calls for 'own-voice': NAME_caller and NAME_agent."),
    device: Literal["cpu", "cuda"] | None = Option(
        None, help="Device of 'serve'; cuda: 64, 256 and 1,024 heads on a GPU."
    ),
    write: Path | None = Option(
        None, metavar="FILE", help="Also write the rows as a page (docs/science/performance.md)."
    ),
    json: bool = JSON,
) -> None:
    """Measure speeds, each compared with a peer in the same run. Exit code 1: a figure misses its limit."""
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
