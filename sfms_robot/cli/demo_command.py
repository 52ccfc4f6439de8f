"""`sfms-robot demo`: what `make run` does."""

from __future__ import annotations

import sys
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.data import head_names, listener_names

# A lively one of the ten that `--seeds 10` tries: it nods 7 times, they 4.4 times in the mean.
DEFAULT_SEED = 1


def demo(
    head: str = typer.Option("face28", autocompletion=head_names, help="Shipped head, or a folder with a head.yaml."),
    listener: str = typer.Option("sfms-small", autocompletion=listener_names, help="Shipped listener, or a folder."),
    seed: int = typer.Option(DEFAULT_SEED, min=0, max=2**32 - 1, help="Two seeds listen differently."),
    duration: float | None = typer.Option(None, min=1.0, help="Seconds; default: all that the person says, 47.7."),
    fast: bool = typer.Option(False, "--fast", help="Virtual time: as fast as it goes."),
    out: Path | None = typer.Option(
        None, metavar="DIR", help="Where recording and pictures go; default: sfms-demo, sfms-demo-2, ..."
    ),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace the recording that --out holds."),
    seeds: int | None = typer.Option(
        None, min=1, metavar="N", help="In virtual time: what seeds 0 to N - 1 show, without pictures."
    ),
    view: str | None = typer.Option(
        None,
        metavar="[[HOST:]PORT]",
        help="Where the page is that shows it (default: 127.0.0.1:8780, or the next free).",
    ),
    no_view: bool = typer.Option(
        False, "--no-view", help="No page. None is served with --fast, --seeds, --json either."
    ),
    json: bool = typer.Option(False, "--json", help="Print what was seen as one JSON object, last line of stdout."),
) -> None:
    """A recorded person talks, an emulated head listens; a page shows it, or two pictures where nobody looks."""
    from sfms_robot.app.listen.preflight import begin_page, check_names

    check_names(head=head, listener=listener)
    shown = not (no_view or fast or json or seeds is not None)
    with ExitStack() as stack:
        page = begin_page(view or ("auto" if shown else None), fast=fast or seeds is not None)
        if page is not None:
            stack.enter_context(closing(page))
        from sfms_robot.app.listen import demo as app
        from sfms_robot.app.listen.panel import live_panel

        options = app.DemoOptions(head, listener, seed, duration, fast or seeds is not None, out, overwrite)
        if seeds is not None:
            told = app.compare_seeds(options, seeds, lambda row: print(_line(row), file=sys.stderr))
        else:
            told = app.demo(options, None if json else live_panel, page)
    if json:
        print_json(told)
    elif seeds is not None:
        nods = told["nods"]
        scatter = "-" if nods["variance_over_mean"] is None else nods["variance_over_mean"]
        print(
            f"nods: {nods['mean']:g} in the mean, variance over mean {scatter}, {nods['seeds_without']} seeds without"
        )
    else:
        print(_line(told))
        print(f"look at {' and '.join(told['pictures'])}" if told["pictures"] else f"recorded in {told['folder']}")
        if told["missing"]:
            print(told["missing"], file=sys.stderr)
    if told.get("error"):
        print(f"sfms-robot: {told['error']}", file=sys.stderr)
    raise typer.Exit(told["exit_code"])


def _line(seen: dict[str, Any]) -> str:
    return (
        f"{seen['head']} listened for {seen['duration_s']:.1f} s (seed {seen['seed']}): {seen['nods']} nods, "
        f"{seen['blinks']} blinks, {seen['smiles']} smiles, {seen['neck_travel_deg']:.0f} degrees of neck travel"
    )
