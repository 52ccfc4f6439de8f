"""`sfms-robot servo maps`: the servo models at hand, and whether their files are sound."""

from __future__ import annotations

import json as json_module
from pathlib import Path

import typer

_SHOWN = ("model", "family", "protocol", "number", "firmware", "watchdog")  # the rest is in --json


def maps(
    files: list[Path] = typer.Argument(None, help="Firmware maps of your own, or folders of them, beside the shipped."),
    check: bool = typer.Option(False, "--check", help="Look for mistakes in the maps; exit code 2 when there are any."),
    json: bool = typer.Option(False, "--json", help="Print as one JSON object."),
) -> None:
    """The servo models and boards that have a firmware map."""
    from sfms_robot.app.servo.maps import check_maps, list_maps

    if not check:
        rows = list_maps(files or [])
        if json:
            print(json_module.dumps({"maps": rows}))
        else:
            from sfms_robot.cli.show import print_rows

            print_rows([{key: row[key] for key in _SHOWN} for row in rows])
        return
    findings = check_maps(files or [])
    if json:
        print(json_module.dumps({"sound": not findings, "findings": [each._asdict() for each in findings]}))
    else:
        for each in findings:
            print(f"{each.file}: {each.problem}")
        print("the firmware maps are sound" if not findings else f"{len(findings)} problem(s)")
    if findings:
        raise typer.Exit(2)
