"""`sfms-robot run`: drive a head."""

from __future__ import annotations

import json as json_module
import sys
from pathlib import Path

import typer

INTERRUPTED = 130
MAX_SEED = 2**32 - 1  # leaves room in torch's 64 bits for one seed per listener


def run(
    head: str = typer.Option("face28", help="Shipped head, or a folder with a head.yaml."),
    port: str = typer.Option("sim", help="'sim' for emulated servos, a serial device, or NAME=DEVICE per bus."),
    listener: str = typer.Option("sfms-small", help="Shipped listener, or a folder with config.yaml and weights."),
    audio: str = typer.Option(
        "default",
        help="FILE.wav (any rate, mono or stereo), a shipped speaker, 'none', or 'default': a shipped speaker.",
    ),
    face: str = typer.Option(
        "auto", help="The speaker's face: FILE.csv[.gz], 'none', or 'auto': the shipped speaker's own, else none."
    ),
    agent_audio: str = typer.Option(
        "none",
        help="What the robot itself says: FILE.wav, a shipped speaker or 'none'. An ARIG listener's lips follow it.",
    ),
    duration: float | None = typer.Option(None, min=0.04, help="Seconds; default: as long as the recording."),
    fast: bool = typer.Option(False, help="Virtual time: as fast as it goes, bit-identical for one --seed."),
    seed: int = typer.Option(
        0, min=0, max=MAX_SEED, help="Two seeds listen differently, one seed repeats (with --fast)."
    ),
    record: Path | None = typer.Option(None, help="Folder to write the run to, for `sfms-robot replay`."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace the recording that --record's folder holds."),
    dry_run: bool = typer.Option(False, "--dry-run", help="Open and read the servos, never switch torque on."),
    yes: bool = typer.Option(
        False, "--yes", help="Hobby servos may jump when they come on: they report no position to begin from."
    ),
    intensity: list[str] = typer.Option([], metavar="REGION=V", help="How far a region goes, 0 to 2; may be repeated."),
    style: list[str] = typer.Option([], metavar="REGION=V", help="How much of its small motions shows, 0 to 2."),
    without: list[str] = typer.Option(
        [], metavar="JOINT", help="Leave a joint's servo alone (broken, or not there); may be repeated."
    ),
    json: bool = typer.Option(False, "--json", help="Print the report as one JSON object, last line of stdout."),
) -> None:
    """Let a head listen: a voice (and a face, where there is one) goes in, servo goals go out."""
    from sfms_robot.app import session
    from sfms_robot.app.listen.progress import RunProgress
    from sfms_robot.cli.tables import print_dry_run, print_run

    options = session.RunOptions(
        head, port, listener, audio, face, agent_audio, duration, fast, seed, record, overwrite, dry_run, yes,
        tuple(intensity), tuple(style), tuple(without),
    )  # fmt: skip
    try:
        report = session.run(options, RunProgress)
    except (
        KeyboardInterrupt
    ):  # before torque came on; after that an interruption is a request, and the head rests first
        sys.exit(INTERRUPTED)
    if json:
        print(json_module.dumps(report))
    elif dry_run:
        print_dry_run(report)
    else:
        print_run(report, record)
    if report.get("error"):
        print(f"sfms-robot: {report['error']}", file=sys.stderr)
    sys.exit(report.get("exit_code", 0))
