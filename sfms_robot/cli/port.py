"""`sfms-robot port`: the serial ports and the microphones at hand."""

from __future__ import annotations

import json as json_module

import typer

app = typer.Typer(help="Serial ports and microphones: list.", no_args_is_help=True)


@app.callback()
def _group() -> None: ...


@app.command("list")
def list_ports(json: bool = typer.Option(False, "--json", help="Print as one JSON object.")) -> None:
    """Serial ports that servos may hang on, and devices that record: what each is, and what speaks against using it."""
    from sfms_robot.app.catalogue import microphones, serial_ports
    from sfms_robot.cli.show import print_list, screen
    from sfms_robot.errors import RobotError

    ports, problem = serial_ports(), None
    try:
        devices = microphones()
    except RobotError as error:
        devices, problem = [], str(error)
    if json:
        told = {"version": 1, "ports": ports, "microphones": devices, "microphone_problem": problem}
        print(json_module.dumps(told))
        return
    print_list("serial ports", ports, json=False)
    if problem:
        screen(highlight=False).print(problem, style="dim")
    else:
        print_list("microphones", devices, json=False)
