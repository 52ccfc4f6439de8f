"""`sfms-robot listener`: the listeners at hand."""

from __future__ import annotations

import typer

app = typer.Typer(help="Listeners: list.", no_args_is_help=True)


@app.callback()
def _group() -> None: ...


@app.command("list")
def list_listeners(json: bool = typer.Option(False, "--json", help="Print as one JSON object.")) -> None:
    """Shipped listeners: kind, whether it has weights, what it is."""
    from sfms_robot.app.catalogue import shipped_listeners
    from sfms_robot.cli.show import print_list

    print_list("listeners", shipped_listeners(), json)
