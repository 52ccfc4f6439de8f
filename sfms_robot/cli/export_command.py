"""`sfms-robot export`: a listener's networks for a machine without torch."""

from __future__ import annotations

from pathlib import Path

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.data import listener_names


def export(
    listener: str = typer.Argument(
        ..., autocompletion=listener_names, help="Shipped listener, or a folder with config.yaml."
    ),
    out: Path | None = typer.Option(None, metavar="DIR", help="Write below this folder. Default: the listener's own."),
    int8: bool = typer.Option(False, "--int8", help="Also with large layers in 8 bits (kind: arig), for large models."),
    weight_bits: int | None = typer.Option(
        None, "--weight-bits", metavar="8|16|32", help="Also write the weights, in so many bits. Default: leave them."
    ),
    json: bool = typer.Option(False, "--json", help="Print the files as one JSON object."),
) -> None:
    """Write a listener's networks as ONNX graphs, which run without torch. Takes a minute.

    They hold no weights: trained anew for the same configuration, a listener needs no new ones. In 8 bits weights take
    a quarter of the room; every engine computes with them as real numbers.
    """
    from sfms_robot.app.graph_export import export_listener

    files = export_listener(listener, out, int8, weight_bits)
    if json:
        print_json({"listener": listener, "int8": int8, "files": [str(file) for file in files]})
    else:
        for file in files:
            print(f"{file.stat().st_size / 1000:8.1f} kB  {file}")
