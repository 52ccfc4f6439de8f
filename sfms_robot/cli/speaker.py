"""`sfms-robot speaker`: the recorded people at hand."""

from __future__ import annotations

import typer

app = typer.Typer(help="Recorded people: list.", no_args_is_help=True)


@app.callback()
def _group() -> None: ...


@app.command("list")
def list_speakers(json: bool = typer.Option(False, "--json", help="Print as one JSON object.")) -> None:
    """Shipped speakers: seconds, whether there is a face, what it is."""
    from sfms_robot.app.catalogue import shipped_speakers
    from sfms_robot.cli.show import print_list

    print_list("speakers", shipped_speakers(), json)
