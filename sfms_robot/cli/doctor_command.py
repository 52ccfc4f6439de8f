"""`sfms-robot doctor`: what is wrong with port, adapter and servos, and what to type against it."""

from __future__ import annotations

import sys

import typer

from sfms_robot.cli.servo_wiring import Family, confirmation
from sfms_robot.cli.show import print_json


def doctor(
    port: str | None = typer.Option(
        None, help="Serial device, NAME=DEVICE per bus, or 'sim'. Default: the only one there is."
    ),
    head: str | None = typer.Option(None, help="Compare with this head: shipped name, or a folder with a head.yaml."),
    baud: int | None = typer.Option(None, min=1, help="Without a head: look at this rate only. Default: at all."),
    family: Family | None = typer.Option(None, help="Without a head: how the servos speak. Default: dynamixel2."),
    fix: bool = typer.Option(
        False, "--fix", help="Mend what servos store, or record it in the head's file; asks before each."
    ),
    yes: bool = typer.Option(False, "--yes", "-y", help="With --fix: do not ask."),
    json: bool = typer.Option(False, "--json", help="Print the report as one JSON object, last line of stdout."),
) -> None:
    """Look before you run: port, adapter, every servo, what it has stored, wire budget. Reads only, unless told to fix.

    Exit code 0: fit to run. 3: the port cannot be opened. 4: a finding stops the head from running.
    """
    from sfms_robot.app.servo.doctor import examine
    from sfms_robot.app.servo.serial_line import real_clock
    from sfms_robot.cli.show_servo import bar, print_doctor

    confirm = confirmation(yes) if fix else None
    with bar("looking", hidden=json or fix) as progress:
        report = examine(port, head, family and family.value, baud, real_clock(), progress, confirm)
    if json:
        print_json(report)
    else:
        print_doctor(report)
    if report["exit_code"]:
        sys.exit(report["exit_code"])
