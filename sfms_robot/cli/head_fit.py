"""`sfms-robot head fit`: learn from sight how a face really answers."""

from __future__ import annotations

import tempfile
from pathlib import Path

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.errors import ConfigError


def fit(
    name: str = typer.Argument(..., metavar="NAME|DIR", help="A shipped head, or a folder with a head.yaml."),
    recording: Path | None = typer.Option(
        None, "--recording", metavar="DIR", help="run.mcap of the joints, and face.csv: what a tracker saw of them."
    ),
    babble: bool = typer.Option(False, "--babble", help="Move the face within its limits and record it."),
    port: str = typer.Option("sim", help="For --babble: 'sim' (a virtual face), a device, or NAME=DEVICE per bus."),
    record: Path | None = typer.Option(None, "--record", metavar="DIR", help="Where --babble writes to."),
    minutes: float = typer.Option(2.0, "--minutes", min=0.1, max=60.0, help="Length of --babble."),
    seed: int = typer.Option(0, min=0, help="Of the random faces of --babble."),
    yes: bool = typer.Option(False, "--yes", help="Hobby servos may jump to rest when they come on."),
    json: bool = typer.Option(False, "--json", help="Print the outcome as one JSON object, last line of stdout."),
) -> None:
    """From joints and what a face tracker saw of them, learn the drives that make the face look as asked.

    Written as the fit of this build, beside the shipped file. On a real port --babble records the joints alone: track
    the face with a camera of yours, put the track beside it as face.csv, and fit the recording.
    """
    from sfms_robot.app.head.fit import fit_head, see_virtual_face

    if babble == (recording is not None):
        raise ConfigError("head fit: give one of --recording DIR and --babble")
    if recording is not None:
        _tell(fit_head(name, recording), json)
        return
    from sfms_robot.app.head.babble import babble as move

    if port != "sim" and record is None:
        raise ConfigError("head fit --babble on a real port needs --record DIR, where the face track goes too")
    with tempfile.TemporaryDirectory() as spare:
        folder = record if record is not None else Path(spare)
        done = move(name, port, folder, minutes=minutes, seed=seed, yes=yes)
        if port == "sim" and done.exit == "done":
            see_virtual_face(done.head, folder)
            _tell(fit_head(name, folder, practice=True), json)
            return
    told = {"head": done.head.name, "exit": done.exit, "seconds": round(done.seconds, 1), "record": str(record)}
    if json:
        print_json(told)
    else:
        print(f"{done.exit}: {folder}/run.mcap; put the face track beside it")


def _tell(result: object, json: bool) -> None:
    from sfms_robot.app.head.fit import HeadFit
    from sfms_robot.cli.show_head import print_fit

    assert isinstance(result, HeadFit)
    if json:
        print_json(result.as_dict())
    else:
        print_fit(result)
