"""`sfms-robot replay`: look at a recorded run, or let a head do it again."""

from __future__ import annotations

import sys
from pathlib import Path

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.data import head_names
from sfms_robot.errors import ConfigError


def replay(
    folder: Path = typer.Argument(..., metavar="DIR", help="Folder that `sfms-robot run --record` wrote."),
    plot: Path | None = typer.Option(
        None, help="PNG: states and events, voice, head pose, six face channels, joint angles over time."
    ),
    sheet: Path | None = typer.Option(None, help="PNG: the virtual head and the robot at twelve instants of the run."),
    port: str | None = typer.Option(
        None, help="Drive a head with the recorded face: 'sim', 'auto', a device, or NAME=DEVICE per bus."
    ),
    head: str | None = typer.Option(
        None, autocompletion=head_names, help="With --port: another head than the recorded one."
    ),
    fast: bool = typer.Option(False, "--fast", help="With --port sim: virtual time."),
    yes: bool = typer.Option(False, "--yes", help="With --port: hobby servos may jump when they come on."),
    view: str | None = typer.Option(
        None, metavar="[[HOST:]PORT]", help="Put it on a page, to be played there (alone: 127.0.0.1:8780)."
    ),
    json: bool = typer.Option(False, "--json", help="Print what was found as one JSON object."),
) -> None:
    """Draw a recorded run, drive a head with it, or say what is in it."""
    if view is not None and port is not None:
        raise ConfigError("--view shows a recording, --port drives a head with it: one at a time")
    if port is None and (head is not None or fast or yes):
        raise ConfigError("--head, --fast and --yes are of a head that is driven: add --port (sim, or a device)")
    from sfms_robot.app.replay import replay_run

    told = replay_run(folder, plot, sheet)
    if port is not None:
        from sfms_robot.app.listen.panel import live_panel
        from sfms_robot.app.replay.run_playback import PlaybackOptions, play_back

        played = play_back(folder, PlaybackOptions(head, port, fast, yes), None if json else live_panel)
        told = {**played, "recording": told}
    if view is not None:
        _view(folder, view)
    if json:
        print_json(told)
    else:
        for key, value in told.items():
            if not isinstance(value, dict):
                print(f"{key}: {value}")
    if told.get("error"):
        print(f"sfms-robot: {told['error']}", file=sys.stderr)
    raise typer.Exit(told.get("exit_code", 0))


def _view(folder: Path, view: str) -> None:
    """Until nobody looks any more, or Ctrl-C."""
    from contextlib import closing, suppress

    from sfms_robot.app.listen.preflight import begin_page, open_browser
    from sfms_robot.app.replay.page_replay import show_recording, wait_for_visitors

    page = begin_page(view)
    assert page is not None
    with closing(page):
        page.wait()
        show_recording(folder, page)
        print(f"page: {page} (Ctrl-C ends it)", file=sys.stderr)
        open_browser(page.url)
        with suppress(KeyboardInterrupt):
            wait_for_visitors(page)
