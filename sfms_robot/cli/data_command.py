"""`sfms-robot data`: make training data, look at what somebody else made, and take it into our space."""

from __future__ import annotations

from enum import StrEnum
from functools import partial
from pathlib import Path

import typer

app = typer.Typer(help="Training data: compose dyads, check and convert data sets.", no_args_is_help=True)


_LAYOUTS = (
    "composed, l2l, lm_listener, react, react2025, dualtalk, dualtalk_arkit, dim, vico, seamless; "
    "found by itself if not said."
)


class Order(StrEnum):
    exp_first = "exp-first"
    pose_first = "pose-first"


@app.command()
def compose(
    data: Path = typer.Option(..., help="Folder with ami_listener_annotations/ and, if at hand, more voices."),
    out: Path = typer.Option(..., help="Folder to write train/, validation/ and test/ into."),
    minutes: float = typer.Option(
        240.0, min=1.0, help="Minutes of training dyads; all that the tables give if they give less."
    ),
    seed: int = typer.Option(1, min=0, help="One seed composes the same dyads."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace the dyads that --out holds."),
    json: bool = typer.Option(False, "--json", help="Print the figures as one JSON object."),
) -> None:
    """Compose dyads: real listening events (AMI), real motion, real voices, put together."""
    from sfms_robot.cli.show_learning import show
    from sfms_robot.lab.corpora.data_commands import compose_dyads

    show(compose_dyads(data, out, minutes, seed, overwrite), json)


@app.command()
def check(
    folder: Path = typer.Argument(..., metavar="DIR", help="A data set, as its authors lay it out."),
    layout: str = typer.Option("auto", help=_LAYOUTS),
    order: Order | None = typer.Option(None, help="Order of the channels in the files, if not the layout's own."),
    window: int = typer.Option(0, min=0, help="Frames that a clip must have."),
    channels: bool = typer.Option(False, "--channels", help="Show the range of every channel."),
    json: bool = typer.Option(False, "--json", help="Print everything found as one JSON object."),
) -> None:
    """Read a whole data set once: what is there, and everything that is wrong with it."""
    from sfms_robot.cli.show_learning import print_check, show
    from sfms_robot.lab.corpora.data_commands import check_data

    report = check_data(folder, layout, order.value if order else None, window)
    show(report, json, partial(print_check, channels=channels))
    if not report["usable"]:
        raise typer.Exit(2)


@app.command()
def convert(
    folder: Path = typer.Argument(..., metavar="IN", help="A data set, as its authors lay it out."),
    out: Path = typer.Argument(..., metavar="OUT", help="Folder to write dyads into; must be empty or not there."),
    layout: str = typer.Option("auto", help=_LAYOUTS),
    order: Order | None = typer.Option(None, help="Order of the channels in the files, if not the layout's own."),
    flame_matrix: Path | None = typer.Option(
        None, help="FLAME coefficients of every ARKit blendshape (.npy, .csv): shows the expression of deca56 data."
    ),
    flame_order: str = typer.Option("alphabetical", help="Order of the matrix's rows: alphabetical, apple, ..."),
    json: bool = typer.Option(False, "--json", help="Print the figures as one JSON object."),
) -> None:
    """Convert a data set into dyads at 25 fps in our own space, and tell what is lost."""
    from sfms_robot.cli.show_learning import print_conversion, show
    from sfms_robot.lab.corpora.data_commands import convert_data

    show(convert_data(folder, out, layout, order.value if order else None, flame_matrix, flame_order), json,
         print_conversion)  # fmt: skip
