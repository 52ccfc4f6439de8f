"""`sfms-robot listener|speaker|port list`: what there is to choose from."""

from __future__ import annotations

import typer

listener = typer.Typer(help="Listeners: list.", no_args_is_help=True)
speaker = typer.Typer(help="Recorded people: list.", no_args_is_help=True)
port = typer.Typer(help="Serial ports: list.", no_args_is_help=True)
JSON = typer.Option(False, "--json", help="Print as one JSON object.")


@listener.callback()
@speaker.callback()
@port.callback()
def _group() -> None: ...


@listener.command("list")
def list_listeners(json: bool = JSON) -> None:
    """Shipped listeners: kind, whether it has weights, what it is."""
    from sfms_robot.app.catalogue import shipped_listeners
    from sfms_robot.cli.show import print_list

    print_list("listeners", shipped_listeners(), json)


@speaker.command("list")
def list_speakers(json: bool = JSON) -> None:
    """Shipped speakers: seconds, whether there is a face, what it is."""
    from sfms_robot.app.catalogue import shipped_speakers
    from sfms_robot.cli.show import print_list

    print_list("speakers", shipped_speakers(), json)


@port.command("list")
def list_serial_ports(json: bool = JSON) -> None:
    """Serial ports that servos may hang on: what the adapter is, who holds it, what speaks against using it."""
    from sfms_robot.app.catalogue import serial_ports
    from sfms_robot.cli.show import print_list

    print_list("ports", serial_ports(), json)
