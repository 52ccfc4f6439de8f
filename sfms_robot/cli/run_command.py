"""`sfms-robot run`, `demo` and `replay`: drive a head, watch one, look at a recorded run."""

from __future__ import annotations

from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path

from typer import Argument, Option

from sfms_robot.cli.head_command import PACKAGES
from sfms_robot.cli.show import JSON, Result, aside, cell, counted, print_report, say, show
from sfms_robot.data import head_names, listener_names, speaker_names
from sfms_robot.errors import ConfigError

MAX_SEED = 2**32 - 1  # leaves room in torch's 64 bits for one seed per listener
DEMO_SEED = 1  # a lively one of the ten that `demo --seeds 10` tries: 7 nods; the mean is 4.4
OF_HEAD = partial(Option, rich_help_panel="Head and servos")
OF_PERSON = partial(Option, rich_help_panel="Person")
OF_LISTENER = partial(Option, rich_help_panel="Listener")
OF_OUTPUT = partial(Option, rich_help_panel="Output")
OF_SAFETY = partial(Option, rich_help_panel="Safety")
OUTPUTS = OF_OUTPUT(
    [],
    metavar="KIND[:ADDRESS]",
    help="Also show the face on an avatar or a robot that accepts a pose: `output list`; may be repeated.",
)
OPTIONAL = {
    "--play": "default",
    "--status": "auto",
    "--view": "auto",
}  # options that may be given without a value, and the value that they have then


def run(
    head: str = OF_HEAD(
        "face28",
        autocompletion=head_names,
        help="Shipped head, or a folder with a head.yaml; 'none': no servos, only --output.",
    ),
    port: str = OF_HEAD(
        "sim",
        help="'sim' for emulated servos, 'auto' for the only adapter, a device, or NAME=DEVICE per bus.",
    ),
    packages: list[str] = PACKAGES,
    intensity: list[str] = OF_HEAD([], metavar="REGION=V", help="Scale of a region's motion, 0 to 2; may be repeated."),
    style: list[str] = OF_HEAD([], metavar="REGION=V", help="Scale of its small motions, 0 to 2; may be repeated."),
    audio: str = OF_PERSON(
        "default",
        autocompletion=speaker_names,
        metavar="mic[:DEVICE]|FILE.wav|NAME|push[:[HOST:]PORT]|browser|ros2:TOPIC|none",
        help="A microphone (number, name or part of it: `port list`), a sound file, a shipped speaker, your program, "
        "a visitor of the page, ROS 2, 'none'. Default: the microphone; with emulated servos a shipped speaker.",
    ),
    face: str = OF_PERSON(
        "auto",
        metavar="webcam[:DEVICE]|live-link|vmc|push[:[HOST:]PORT]|browser|ros2:FACE_ID|FILE.csv|none|auto",
        help="The person's face: a camera, a phone (Live Link Face), avatar software (VMC), your program, a visitor of "
        "the page, ROS 2, a recording (.csv, .csv.gz, .json), 'none'; 'auto': that of the shipped speaker, else none.",
    ),
    agent_audio: str = OF_PERSON(
        "none",
        autocompletion=speaker_names,
        metavar="FILE.wav|device:DEVICE|NAME|tcp[:[HOST:]PORT]|none",
        help="The robot's own speech: a sound file, a device that records the loudspeaker, a shipped speaker, "
        "your program, 'none'. An ARIG listener's lips follow it, and it is removed from a microphone.",
    ),
    play: str | None = OF_PERSON(
        None,
        metavar="[DEVICE]",
        help="Play the robot's speech on a device (number, name or part of it: `port list`; alone: the default).",
    ),
    duration: float | None = OF_PERSON(None, min=0.04, help="Duration in seconds. Default: that of the recording."),
    listener: str = OF_LISTENER(
        "sfms-small",
        autocompletion=listener_names,
        help="Shipped listener, a folder with config.yaml and weights, or zenoh/NAME on a machine that serves it.",
    ),
    calmness: list[str] = OF_LISTENER(
        [],
        metavar="KIND=PER_MINUTE",
        help="Events per minute, as nod=2.2; may be repeated. Default: the rates of people.",
    ),
    addressed: str = OF_LISTENER(
        "sense",
        metavar="sense|assume|never",
        help="Rule for being spoken to: sense (by the person's look; yes without a face), assume (always), never.",
    ),
    engine: str = OF_LISTENER(
        "auto",
        metavar="auto|onnx|torch",
        help="Engine of the listener: onnxruntime or torch; auto: onnxruntime if the listener has graphs for it.",
    ),
    seed: int = OF_LISTENER(
        0,
        min=0,
        max=MAX_SEED,
        help="Seed of the listener; the same seed repeats a run (with --fast).",
    ),
    fast: bool = OF_LISTENER(False, "--fast", help="Virtual time: as fast as possible, bit-identical per --seed."),
    output: list[str] = OUTPUTS,
    record: Path | None = OF_OUTPUT(None, metavar="DIR", help="Folder to record the run in, for `sfms-robot replay`."),
    record_format: str = OF_OUTPUT(
        "json",
        metavar="json|ros2",
        help="Messages of the recording (MCAP): JSON, for Foxglove; ROS 2, also for its tools and PlotJuggler.",
    ),
    overwrite: bool = OF_OUTPUT(False, "--overwrite", help="Replace an earlier recording in the folder of --record."),
    json: bool = JSON,
    check: bool = OF_PERSON(False, "--check", help="Check the sound of --audio for 3 s; no servo moves."),
    status: str | None = OF_OUTPUT(
        None,
        metavar="[PORT]",
        help="Serve the status as JSON on http://127.0.0.1:PORT/ (0: any free port; alone: 8775 or the next free).",
    ),
    view: str | None = OF_OUTPUT(
        None,
        metavar="[[HOST:]PORT]",
        help="Serve a page that shows and controls the run (without a value: 127.0.0.1:8780, or the next free port).",
    ),
    view_cert: Path | None = OF_OUTPUT(
        None, metavar="FILE", help="PEM certificate to serve the page by https, which a phone's microphone needs."
    ),
    view_key: Path | None = OF_OUTPUT(None, metavar="FILE", help="PEM key of this certificate."),
    fleet: str | None = OF_OUTPUT(
        None,
        metavar="NAME",
        help="Join a fleet as NAME; the fleet sees the run and may halt it (docs/guide/remote.md).",
    ),
    zenoh: Path | None = OF_OUTPUT(
        None,
        metavar="FILE",
        help="zenoh's configuration (JSON5), for --fleet, --listener zenoh/NAME and ros2. Default: tcp/127.0.0.1:7447.",
    ),
    insecure: bool = OF_OUTPUT(False, "--insecure", help="Allow endpoints of --zenoh beyond loopback without TLS."),
    fleet_key: Path | None = OF_OUTPUT(
        None,
        metavar="FILE",
        help="Key of the fleet, needed to resume or end the run; created if missing.",
    ),
    dry_run: bool = OF_SAFETY(False, "--dry-run", help="Open and read the servos, but never switch torque on."),
    yes: bool = OF_SAFETY(
        False,
        "--yes",
        help="Allow hobby servos to jump when they come on: they report no position.",
    ),
    halt_on: str | None = OF_SAFETY(
        None,
        metavar="FILE|/dev/gpiochipN:LINE",
        help="Halt when this file appears, or this GPIO line is pulled to ground.",
    ),
    without: list[str] = OF_SAFETY(
        [],
        metavar="JOINT",
        help="Joint whose servo is left out (broken or missing); may be repeated.",
    ),
) -> None:
    """Run a head that listens: reads a person's voice, and face if there is one, and drives the servos."""
    from sfms_robot.app.options import (
        RunOptions,
        begin_listening,
        begin_page,
        calmed,
        check_names,
        engine_named,
        record_format_named,
    )

    options = RunOptions(
        head=head,
        port=port,
        fast=fast,
        yes=yes,
        without=tuple(without),
        listener=listener,
        audio=audio,
        face=face,
        agent_audio=agent_audio,
        play=play,
        duration_s=duration,
        seed=seed,
        engine=engine_named(engine),
        intensity=tuple(intensity),
        style=tuple(style),
        calmness=calmed(calmness, addressed) if calmness or addressed != "sense" else None,
        record=record,
        record_format=record_format_named(record_format),
        overwrite=overwrite,
        dry_run=dry_run,
        halt_on=halt_on,
        status=status,
        fleet=fleet,
        fleet_key=fleet_key,
        zenoh=zenoh,
        insecure=insecure,
        packages=tuple(packages),
        outputs=tuple(output),
    )
    check_names(options)
    if check:
        from sfms_robot.app.listen.sound_check import check_sound, level_meter

        with level_meter() as meter:
            found = check_sound("mic" if audio == "default" else audio, duration, None if json else meter)
        verdict = "not fit to listen to" if found["findings"] else "fit to listen to"
        show(found, json, heading="{audio}, {seconds} s: " + verdict)
        return
    with ExitStack() as stack:
        # The listener loads in its own process while this process imports the parts that drive a head.
        page = begin_page(view, view_cert, view_key, options=options)
        if page is not None:
            stack.enter_context(closing(page))
        feed = None if fast or dry_run else stack.enter_context(closing(begin_listening(options)))
        from sfms_robot.app import session
        from sfms_robot.app.listen.panel import live_panel

        panel = None if json else live_panel
        if page is None:
            report = session.run(options, panel, feed=feed)
        else:
            from sfms_robot.app.listen.page_session import page_session

            report = stack.enter_context(page_session(page, options)).run(panel, feed)
    show(report, json, None if dry_run else _print_run, heading="{head} on {port}: torque stays off")


def _print_run(report: Result) -> None:
    """Print the report of a run on one screen."""
    motion, limits, bus = report["motion"], report["limits"], report["bus"]
    tick, latency, step = report["tick"], report["latency_ms"], report["listener_step_ms"]
    rate = f"{tick['target_hz']:g} a second, in virtual time"
    if tick["achieved_hz"] is not None:
        rate = f"{tick['achieved_hz']:.4g} a second of {tick['target_hz']:g}, {tick['late']} late"
    answer = [
        f"{latency[key]['p50']:.0f} ms after {what}"
        for key, what in (("frame_to_wire", "each picture or sound of the person"), ("speech_to_wire", "speech begins"))
        if latency[key]["p50"] is not None
    ]
    planned = f", a plan takes {step['p50']:.0f} ms, 1 of 100 {step['p99']:.0f} ms or more" if step["p50"] else ""
    facts = {
        "showed": ", ".join(counted(motion[f"{kind}s"], kind) for kind in ("nod", "blink", "smile")),
        "goals to the servos": f"{report['ticks']}, {rate}",
        "moves": f"{cell(answer)} (half of the times sooner)" if answer else "in virtual time, where nothing is late",
        "listener": f"{report['listener']}{planned}",
        "limits": f"exceeded {limits['violations']} times; {limits['clamped']} goals were slowed down to stay within",
    }
    if "writes" in bus:  # missing without servos
        facts["servos"] = (
            f"{bus['writes']} times written, {bus['reads']} times read, {bus['errors']} errors, "
            f"silent: {cell(bus['silent'], 'none')}"
        )
    if "recording" in report:
        kept = report["recording"]
        problem = kept["trouble"] or (f"{kept['dropped']} messages dropped" if kept["dropped"] else "")
        facts["recording"] = f"{kept['bytes'] * 1e-6:.1f} MB" + (f", INCOMPLETE: {problem}" if problem else "")
    for sent in report["outputs"]:
        facts[f"{sent['kind']}:{sent['peer']}"] = f"{sent['frames']} frames, {sent['losses']} losses" + (
            f", away at the end: {sent['problem']}" if sent["state"] == "lost" else ""
        )
    if report["torque_unconfirmed"]:
        facts["torque"] = f"NOT confirmed off: {cell(report['torque_unconfirmed'])}"
    say(f"{report['head']} listened for {report['duration_s']:g} s ({report['exit']})", "bold")
    print_report(facts)
    if report.get("priority", "").startswith("refused"):
        say(f"real-time priority {report['priority']}", "dim")
    if "recording" not in report:
        say("To see it: add --record DIR, then `sfms-robot replay DIR --plot run.png --sheet head.png`.", "dim")


def demo(
    head: str = Option("face28", autocompletion=head_names, help="Shipped head, or a folder with a head.yaml."),
    listener: str = Option("sfms-small", autocompletion=listener_names, help="Shipped listener, or a folder."),
    seed: int = Option(DEMO_SEED, min=0, max=MAX_SEED, help="Seed of the listener."),
    duration: float | None = Option(
        None, min=1.0, help="Duration in seconds. Default: all of the person's speech, 47.7."
    ),
    fast: bool = Option(False, "--fast", help="Virtual time: as fast as possible."),
    out: Path | None = Option(
        None, metavar="DIR", help="Folder for recording and pictures. Default: runs/demo, runs/demo-2, ..."
    ),
    overwrite: bool = Option(False, "--overwrite", help="Replace an earlier recording in --out."),
    seeds: int | None = Option(
        None, min=1, metavar="N", help="Compare seeds 0 to N - 1 in virtual time, without pictures."
    ),
    view: str | None = Option(
        None,
        metavar="[[HOST:]PORT]",
        help="Address of the page (default: 127.0.0.1:8780, or the next free port).",
    ),
    output: list[str] = OUTPUTS,
    no_view: bool = Option(False, "--no-view", help="Serve no page, as with --fast, --seeds and --json."),
    json: bool = JSON,
) -> None:
    """Show an emulated head that listens to a recorded person, on a page, or in two pictures without visitors."""
    from sfms_robot.app.options import RunOptions, begin_page, check_names

    options = RunOptions(
        head=head,
        listener=listener,
        seed=seed,
        duration_s=duration,
        fast=fast or seeds is not None,
        overwrite=overwrite,
        outputs=tuple(output),
    )
    check_names(options)
    served = not (no_view or options.fast or json)
    with ExitStack() as stack:
        page = begin_page(view or ("auto" if served else None), options=options)
        if page is not None:
            stack.enter_context(closing(page))
        from sfms_robot.app.listen import demo as app
        from sfms_robot.app.listen.panel import live_panel

        if seeds is not None:
            found = app.compare_seeds(options, seeds, lambda row: aside(_line(row)))
        else:
            found = app.demo(options, out, None if json else live_panel, page)
    show(found, json, _print_demo)


def _print_demo(found: Result) -> None:
    """Print what a demo showed, or the statistics of several seeds."""
    if "runs" in found:
        nods = found["nods"]
        print(
            f"nods: {nods['mean']:g} in the mean, variance over mean {cell(nods['variance_over_mean'])}, "
            f"{nods['seeds_without']} seeds without"
        )
        return
    print(_line(found))
    print(f"look at {' and '.join(found['pictures'])}" if found["pictures"] else f"recorded in {found['folder']}")
    if found["missing"]:
        aside(found["missing"])


def _line(seen: Result) -> str:
    return (
        f"{seen['head']} listened for {seen['duration_s']:.1f} s (seed {seen['seed']}): "
        f"{', '.join(counted(seen[f'{kind}s'], kind) for kind in ('nod', 'blink', 'smile'))}; "
        f"the neck turned {seen['neck_travel_deg']:.0f} degrees in all"
    )


def replay(
    folder: Path = Argument(..., metavar="DIR", help="Folder that `sfms-robot run --record` wrote."),
    plot: Path | None = Option(
        None, help="PNG: states and events, voice, head pose, six face channels, joint angles over time."
    ),
    sheet: Path | None = Option(None, help="PNG: the virtual head and the robot at twelve instants of the run."),
    port: str | None = Option(
        None, help="Drive a head with the recorded face: 'sim', 'auto', a device, or NAME=DEVICE per bus."
    ),
    head: str | None = Option(None, autocompletion=head_names, help="With --port: another head than the recorded one."),
    fast: bool = Option(False, "--fast", help="With --port sim: virtual time."),
    yes: bool = Option(False, "--yes", help="With --port: hobby servos may jump when they come on."),
    view: str | None = Option(
        None, metavar="[[HOST:]PORT]", help="Serve a page that plays it (without a value: 127.0.0.1:8780)."
    ),
    json: bool = JSON,
) -> None:
    """Draw a recorded run, drive a head with it, or summarise it."""
    if view is not None and port is not None:
        raise ConfigError("--view shows a recording, --port drives a head with it: one at a time")
    if port is None and (head is not None or fast or yes):
        raise ConfigError("--head, --fast and --yes are of a head that is driven: add --port (sim, or a device)")
    from sfms_robot.app.replay.pictures import replay_run

    found = replay_run(folder, plot, sheet)
    heading, keys = "{head} listened for {duration_s} s", list(found)
    if port is not None:
        from sfms_robot.app.listen.panel import live_panel
        from sfms_robot.app.replay.play_back import play_back

        panel = None if json else live_panel
        found = {**play_back(folder, panel, head=head, port=port, fast=fast, yes=yes), "recording": found}
        heading = "{head} on {port} repeated {duration_s} of {recorded_s} s ({exit})"
        keys = ["torque_unconfirmed", "whole", "ticks", "limits", "motion", "joints"]
    if view is not None:
        _view(folder, view)
    show(found, json, heading=heading, keys=keys)


def _view(folder: Path, view: str) -> None:
    """Serve a recording on a page until all visitors have left, or Ctrl-C."""
    from sfms_robot.app.options import begin_page, open_browser
    from sfms_robot.app.replay.play_back import show_recording, wait_for_visitors

    page = begin_page(view)
    assert page is not None
    with closing(page):
        page.wait()
        show_recording(folder, page)
        aside(f"page: {page} (Ctrl-C ends it)")
        open_browser(page.url)
        with suppress(KeyboardInterrupt):
            wait_for_visitors(page)
