"""`sfms-robot port`: the serial ports at hand."""

from __future__ import annotations

import typer

app = typer.Typer(help="Serial ports: list.", no_args_is_help=True)


@app.callback()
def _group() -> None: ...


@app.command("list")
def list_serial_ports(json: bool = typer.Option(False, "--json", help="Print as one JSON object.")) -> None:
    """Serial ports that servos may hang on: what the adapter is, who holds it, what speaks against using it."""
    from sfms_robot.app.catalogue import serial_ports
    from sfms_robot.cli.show import print_list

    print_list("ports", serial_ports(), json)
