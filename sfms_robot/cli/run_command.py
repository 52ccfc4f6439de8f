"""`sfms-robot run`: drive a head."""

from __future__ import annotations

import sys
from contextlib import ExitStack, closing
from pathlib import Path

import typer

from sfms_robot.cli.head_command import PACKAGES
from sfms_robot.cli.json_line import print_json
from sfms_robot.data import head_names, listener_names, speaker_names

MAX_SEED = 2**32 - 1  # leaves room in torch's 64 bits for one seed per listener
HEAD, PERSON, LISTENER, OUTPUT, SAFETY = "Head and servos", "Person", "Listener", "Output", "Safety"
OPTIONAL = {
    "--play": "default",
    "--status": "auto",
    "--view": "auto",
}  # options that may stand alone, and what they mean then


def run(
    head: str = typer.Option(
        "face28", autocompletion=head_names, rich_help_panel=HEAD, help="Shipped head, or a folder with a head.yaml."
    ),
    port: str = typer.Option(
        "sim",
        rich_help_panel=HEAD,
        help="'sim' for emulated servos, 'auto' for the adapter that is plugged in, a device, or NAME=DEVICE per bus.",
    ),
    packages: list[str] = PACKAGES,
    intensity: list[str] = typer.Option(
        [], metavar="REGION=V", rich_help_panel=HEAD, help="How far a region goes, 0 to 2; may be repeated."
    ),
    style: list[str] = typer.Option(
        [], metavar="REGION=V", rich_help_panel=HEAD, help="How much of its small motions shows, 0 to 2."
    ),
    audio: str = typer.Option(
        "default",
        autocompletion=speaker_names,
        rich_help_panel=PERSON,
        metavar="mic[:DEVICE]|FILE.wav|NAME|push[:[HOST:]PORT]|browser|none",
        help="A microphone (by number, name or part of it: `port list`), a sound file, a shipped speaker, a program of "
        "yours, who is in front of the page, 'none'. Default: the microphone, with emulated servos a shipped speaker.",
    ),
    face: str = typer.Option(
        "auto",
        rich_help_panel=PERSON,
        metavar="webcam[:DEVICE]|live-link|vmc|push[:[HOST:]PORT]|browser|FILE.csv|none|auto",
        help="The speaker's face: a camera, a phone (Live Link Face), avatar software (VMC), a program of yours, who "
        "is in front of the page, a recording (.csv, .csv.gz), 'none'; 'auto': the shipped speaker's own, else none.",
    ),
    agent_audio: str = typer.Option(
        "none",
        autocompletion=speaker_names,
        rich_help_panel=PERSON,
        metavar="FILE.wav|device:DEVICE|NAME|tcp[:[HOST:]PORT]|none",
        help="What the robot itself says: a sound file, a device that records the loudspeaker, a shipped speaker, a "
        "program of yours, 'none'. An ARIG listener's lips follow it, and a microphone is rid of it.",
    ),
    play: str | None = typer.Option(
        None,
        metavar="[DEVICE]",
        rich_help_panel=PERSON,
        help="Play what the robot says, on a device (by number, name or part of it: `port list`; alone: the default).",
    ),
    duration: float | None = typer.Option(
        None, min=0.04, rich_help_panel=PERSON, help="Seconds; default: as long as the recording."
    ),
    listener: str = typer.Option(
        "sfms-small",
        autocompletion=listener_names,
        rich_help_panel=LISTENER,
        help="Shipped listener, a folder with config.yaml and weights, or zenoh/NAME on a machine that serves it.",
    ),
    calmness: list[str] = typer.Option(
        [],
        metavar="KIND=PER_MINUTE",
        rich_help_panel=LISTENER,
        help="How often it does something, as nod=2.2; may be repeated. Default: as often as people do.",
    ),
    addressed: str = typer.Option(
        "sense",
        metavar="sense|assume|never",
        rich_help_panel=LISTENER,
        help="Is it the head that is spoken to? By the person's look, and yes where no face is seen; always; never.",
    ),
    engine: str = typer.Option(
        "auto",
        metavar="auto|onnx|torch",
        rich_help_panel=LISTENER,
        help="What computes the listener: onnxruntime, torch; auto: onnxruntime where the listener has graphs for it.",
    ),
    seed: int = typer.Option(
        0,
        min=0,
        max=MAX_SEED,
        rich_help_panel=LISTENER,
        help="Two seeds listen differently, one seed repeats (with --fast).",
    ),
    fast: bool = typer.Option(
        False, "--fast", rich_help_panel=LISTENER, help="Virtual time: as fast as it goes, bit-identical per --seed."
    ),
    record: Path | None = typer.Option(
        None, metavar="DIR", rich_help_panel=OUTPUT, help="Folder to write the run to, for `sfms-robot replay`."
    ),
    overwrite: bool = typer.Option(
        False, "--overwrite", rich_help_panel=OUTPUT, help="Replace the recording that --record's folder holds."
    ),
    json: bool = typer.Option(
        False, "--json", rich_help_panel=OUTPUT, help="Print the report as one JSON object, last line of stdout."
    ),
    check: bool = typer.Option(
        False, "--check", rich_help_panel=PERSON, help="Say how good the sound of --audio is, for 3 s; no servo moves."
    ),
    status: str | None = typer.Option(
        None,
        metavar="[PORT]",
        rich_help_panel=OUTPUT,
        help="Serve how the run is as JSON on http://127.0.0.1:PORT/ (0: any free port; alone: 8775 or the next free).",
    ),
    view: str | None = typer.Option(
        None,
        metavar="[[HOST:]PORT]",
        rich_help_panel=OUTPUT,
        help="Serve a page that shows the run, and works it (alone: 127.0.0.1:8780, or the next port that is free).",
    ),
    view_cert: Path | None = typer.Option(
        None, metavar="FILE", rich_help_panel=OUTPUT, help="Serve it by https, which a phone's microphone needs: PEM."
    ),
    view_key: Path | None = typer.Option(
        None, metavar="FILE", rich_help_panel=OUTPUT, help="The key of that certificate: PEM."
    ),
    fleet: str | None = typer.Option(
        None,
        metavar="NAME",
        rich_help_panel=OUTPUT,
        help="Tell a fleet how the run is, as NAME, and obey it: docs/remote.md.",
    ),
    zenoh: Path | None = typer.Option(
        None,
        metavar="FILE",
        rich_help_panel=OUTPUT,
        help="zenoh's configuration (JSON5), for --fleet and --listener zenoh/NAME. Default: tcp/127.0.0.1:7447.",
    ),
    insecure: bool = typer.Option(
        False, "--insecure", rich_help_panel=OUTPUT, help="Allow endpoints of --zenoh beyond loopback without TLS."
    ),
    fleet_key: Path | None = typer.Option(
        None,
        metavar="FILE",
        rich_help_panel=OUTPUT,
        help="Key that --fleet asks of whoever resumes or ends the run; made where there is none yet.",
    ),
    dry_run: bool = typer.Option(
        False, "--dry-run", rich_help_panel=SAFETY, help="Open and read the servos, never switch torque on."
    ),
    yes: bool = typer.Option(
        False,
        "--yes",
        rich_help_panel=SAFETY,
        help="Hobby servos may jump when they come on: they report no position to begin from.",
    ),
    halt_on: str | None = typer.Option(
        None,
        metavar="FILE|/dev/gpiochipN:LINE",
        rich_help_panel=SAFETY,
        help="Emergency stop when this file appears, or this GPIO line is pulled to ground.",
    ),
    without: list[str] = typer.Option(
        [],
        metavar="JOINT",
        rich_help_panel=SAFETY,
        help="Leave a joint's servo alone (broken, or not there); may be repeated.",
    ),
) -> None:
    """Let a head listen: a voice (and a face, where there is one) goes in, servo goals go out."""
    from sfms_robot.app.listen.preflight import begin_listening, begin_page, check_names, engine_named

    check_names(head, listener, port, audio, face, agent_audio, play, status)
    runs_on = engine_named(engine)
    calm = None
    if calmness or addressed != "sense":
        from sfms_robot.app.listen.knobs import calmed

        calm = calmed(calmness, addressed)
    if check:
        _check(audio, duration, json)
        return
    with ExitStack() as stack:
        # The listener loads from here on, in a process of its own, while this one imports what drives a head.
        page = begin_page(view, view_cert, view_key, audio=audio, face=face, fast=fast, dry_run=dry_run)
        if page is not None:
            stack.enter_context(closing(page))
        feed = (
            None
            if fast or dry_run
            else stack.enter_context(closing(begin_listening(listener, seed, calm, zenoh, runs_on, insecure)))
        )
        from sfms_robot.app import session
        from sfms_robot.app.listen.panel import live_panel
        from sfms_robot.cli import show  # before the run: afterwards there may be no descriptor to import it with

        options = session.RunOptions(
            head, port, listener, audio, face, agent_audio, duration, fast, seed, record, overwrite, dry_run, yes,
            tuple(intensity), tuple(style), tuple(without), halt_on, status, calm, play, fleet, zenoh, runs_on,
            packages=tuple(packages), insecure=insecure, fleet_key=fleet_key,
        )  # fmt: skip
        panel = None if json else live_panel
        if page is None:
            report = session.run(options, panel, feed=feed)
        else:
            from sfms_robot.app.listen.page_session import page_session

            report = stack.enter_context(page_session(page, options)).run(panel, feed)
    if json:
        print_json(report)
    elif dry_run:
        show.print_dry_run(report)
    else:
        show.print_run(report, record)
    if report.get("error"):
        print(f"sfms-robot: {report['error']}", file=sys.stderr)
    raise typer.Exit(report.get("exit_code", 0))


def _check(audio: str, duration_s: float | None, json: bool) -> None:
    from sfms_robot.app.listen.sound_check import CHECK_S, check_sound
    from sfms_robot.cli.show import LevelMeter, print_sound_check

    with LevelMeter() as meter:
        told = check_sound("mic" if audio == "default" else audio, duration_s or CHECK_S, None if json else meter)
    if json:
        print_json(told)
        return
    print_sound_check(told)
