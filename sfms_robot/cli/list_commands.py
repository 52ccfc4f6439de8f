"""`sfms-robot listener|speaker|port list`: what there is to choose from."""

from __future__ import annotations

import typer

from sfms_robot.cli.json_line import print_json

listener = typer.Typer(help="Listeners: list.", no_args_is_help=True)
speaker = typer.Typer(help="Recorded people: list.", no_args_is_help=True)
port = typer.Typer(help="Serial ports and sound devices: list.", no_args_is_help=True)
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
def list_ports(json: bool = JSON) -> None:
    """Serial ports that servos may hang on, with what speaks against using them; devices that record, or play."""
    from sfms_robot.app.catalogue import loudspeakers, microphones, serial_ports
    from sfms_robot.cli.show import print_list, screen
    from sfms_robot.errors import RobotError

    ports, problem = serial_ports(), None
    try:
        record, play = microphones(), loudspeakers()
    except RobotError as error:
        record, play, problem = [], [], str(error)
    if json:
        found = {"ports": ports, "microphones": record, "loudspeakers": play}
        print_json({"version": 1, **found, "microphone_problem": problem})
        return
    print_list("serial ports", ports, json=False)
    if problem:
        screen(highlight=False).print(problem, style="dim")
    else:
        print_list("microphones", record, json=False)
        print_list("loudspeakers", play, json=False)
