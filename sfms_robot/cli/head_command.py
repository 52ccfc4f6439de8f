"""`sfms-robot head`, and `listener|speaker|port list`: lists of what is available, and the tools of a head."""

from __future__ import annotations

import csv
import sys
import tempfile
from functools import partial
from pathlib import Path

from typer import Argument, Exit, Option, Typer

from sfms_robot.app.output_paths import checked_png
from sfms_robot.cli.show import JSON, Result, aside, cell, counted, print_rows, say, show
from sfms_robot.errors import INTERRUPTED, ConfigError, TorqueError

PACKAGES = Option([], "--package", metavar="DIR", help="Folder with meshes outside the head's folder; may be repeated.")
NAME = Argument(..., metavar="NAME|DIR", help="A shipped head, or a folder with a head.yaml.")
YES = Option(False, "--yes", help="Hobby servos may jump to rest when they come on.")

app = Typer(help="Heads: list, check, show, pose, calibrate, fit, solve.", no_args_is_help=True)
listener = Typer(help="Listeners: list.", no_args_is_help=True)
speaker = Typer(help="Recorded people: list.", no_args_is_help=True)
port = Typer(help="Serial ports and sound devices: list.", no_args_is_help=True)
output = Typer(help="Outputs, which show the face or pose elsewhere: list.", no_args_is_help=True)


@listener.callback()
@speaker.callback()
@port.callback()
@output.callback()
def _group() -> None: ...


@listener.command("list")
def list_listeners(json: bool = JSON) -> None:
    """List shipped listeners: kind, weights and description."""
    from sfms_robot.app.catalogue import shipped_listeners

    show({"version": 1, "listeners": shipped_listeners()}, json)


@speaker.command("list")
def list_speakers(json: bool = JSON) -> None:
    """List shipped speakers: seconds, face and description."""
    from sfms_robot.app.catalogue import shipped_speakers

    show({"version": 1, "speakers": shipped_speakers()}, json)


@output.command("list")
def list_outputs(json: bool = JSON) -> None:
    """List kinds of --output with their addresses, also those of installed packages."""
    from sfms_robot.app.catalogue import outputs

    show({"version": 1, "outputs": outputs()}, json)


@port.command("list")
def list_ports(json: bool = JSON) -> None:
    """List serial ports, with problems of each, and devices that record or play sound."""
    from sfms_robot.app.catalogue import ports

    show({"version": 1, **ports()}, json)


@app.command("list")
def list_heads(
    urdf: Path | None = Option(None, metavar="FILE.png", help="Draw all heads."),
    json: bool = JSON,
) -> None:
    """List shipped heads, with joints and buses."""
    from sfms_robot.app.catalogue import shipped_heads

    if urdf is not None:
        from sfms_robot.app.head.head_scene import draw_shipped_heads

        draw_shipped_heads(checked_png(urdf, "--urdf"))
    show({"heads": shipped_heads()}, json)


@app.command("check")
def check(
    name: str = NAME,
    data: Path | None = Option(None, metavar="DIR", help="Face tracks (CSV) instead of the bundled ones."),
    plot: Path | None = Option(None, metavar="FILE.png", help="Draw ranges and demands."),
    listener: str | None = Option(
        None, metavar="NAME|DIR", help="Also list channels of this listener that the head cannot show."
    ),
    packages: list[str] = PACKAGES,
    json: bool = JSON,
) -> None:
    """Report all problems of a head's file, or the demands of recorded faces on its joints."""
    from sfms_robot.app.head.head_check import check as check_head
    from sfms_robot.app.head.head_check import plot as draw

    if plot is not None:
        checked_png(plot, "--plot")
    checked = check_head(name, data, listener, packages)
    if plot is not None and not checked["problems"]:
        draw(checked, plot)
    show(checked, json, _print_check)
    if checked["problems"]:
        raise Exit(ConfigError.exit_code)


def _print_check(checked: Result) -> None:
    """Print the verdict, the problems and remarks, one line each; without problems, the table of the joints."""
    problems, remarks = checked["problems"], checked["remarks"]
    numbers = [counted(len(each), name) for each, name in ((problems, "problem"), (remarks, "remark")) if each]
    verdict = "not fit to run" if problems else "fit to run"
    say(f"{checked['name']}: {', '.join([verdict, *numbers])}", "bold red" if problems else "bold")
    for line in (*problems, *remarks):
        say(line, "red" if problems else "")
    if problems:
        return
    rows = [
        {
            "joint": row["joint"],
            "servo": row["servo"],
            "bus id": f"{row['bus']} {row['id']}",
            "range deg": f"{row['min_deg']:.3g}..{row['max_deg']:.3g}",
            **{name: f"{row[name]:.1%}" for name in ("used", "clipped", "speed", "jerk")},
        }
        for row in checked["joints"]
    ]
    over = [row["joint"] for row in checked["joints"] if max(row["speed"], row["jerk"]) > 1]
    print_rows(rows, f"{checked['name']} on {checked['seconds']:.0f} s of recorded faces")
    say(
        "used: the part of the range that these faces need. clipped: the part of the time at an end of it that is not "
        "rest. speed, jerk: what the fastest hundredth of the motion needs, of the limit; over 100 % is slowed down.",
        "dim",
    )
    if over:
        say(f"too fast for the limits: {cell(over)}", "bold red")
    for row in checked["joints"]:
        say(f"{row['joint']}: {cell(row['channels'], 'not driven by any channel')}")
    if (neck := checked["neck"]) is not None:
        unit = {axis: "deg" if axis in ("roll", "pitch", "yaw") else "mm" for axis in neck["reach"]}
        reach = cell([f"{axis} {low:g}..{high:g} {unit[axis]}" for axis, (low, high) in neck["reach"].items()])
        share = "no" if neck["reached"] is None else f"{neck['reached']:.1%} of the"
        say(f"neck, one axis at a time: {reach}; {share} recorded poses in reach")
    say(f"parts of a face that it cannot show: {cell(checked['blind_channels'], 'none')}")
    if checked["limitation"] is not None:
        say(f"the listener: {checked['limitation']}")
    say(f"joints that no face moves: {cell(checked['dead_joints'], 'none')}")
    if checked["calibrate_first"]:
        say("calibrate first: until then it moves 20 % of its travel at 0.3 of its speed on real servos")


@app.command("show")
def show_head(
    name: str = NAME,
    joint: str | None = Option(None, metavar="JOINT", help="Only this joint."),
    urdf: Path | None = Option(
        None, metavar="FILE.png", help="Draw the robot, and list the joints that its URDF's joints follow."
    ),
    packages: list[str] = PACKAGES,
    json: bool = JSON,
) -> None:
    """Show every value of every joint and its source: the head's file, or the calibration or fit of this build."""
    if urdf is not None:
        from sfms_robot.app.head.head_scene import draw_scene

        show(
            draw_scene(name, checked_png(urdf, "--urdf"), packages),
            json,
            heading="{name}: {urdf}, drawn as {picture}",
            note="follows: joint of the head, joint of the URDF",
        )
        return
    from sfms_robot.config.overlay import provenance

    joints, refused = provenance(name)
    if joint is not None:
        if joint not in joints:
            raise ConfigError.at(name, "--joint", joint, "is not a joint of this head", joints)
        joints = {joint: joints[joint]}

    def printed(_: Result) -> None:
        for joint, values in joints.items():
            rows = [{"key": key, "value": cell(value), "from": origin} for key, (value, origin) in values.items()]
            print_rows(rows, f"{name}: {joint}")
        for line in refused:
            say(line, "bold red")

    found = {j: {key: {"value": v, "from": o} for key, (v, o) in values.items()} for j, values in joints.items()}
    show({"name": name, "joints": found, "refused": refused}, json, printed)


@app.command("calibrate")
def calibrate(
    name: str = NAME,
    port: str = Option(..., help="Serial device, NAME=DEVICE per bus, or 'sim' to practise."),
    joint: list[str] = Option([], metavar="JOINT", help="Only this joint; may be repeated."),
    again: bool = Option(False, "--again", help="Also joints that are measured already."),
    json: bool = JSON,
) -> None:
    """Measure the joints of this build step by step: ends, rest, direction. Each is saved in an overlay of the file."""
    from sfms_robot.app.head.calibrate import calibrate as lead_through

    outcome = lead_through(name, port, partial(print, flush=True), input, joint, again)
    print()  # ends the line of the last question
    show(outcome.model_dump(mode="json"), json, heading="{head}: {exit}, written to {file}")
    if outcome.torque_unconfirmed:
        aside(f"sfms-robot: {TorqueError(outcome.torque_unconfirmed)}")
    if outcome.problems:
        raise Exit(ConfigError.exit_code)
    if outcome.torque_unconfirmed:
        raise Exit(TorqueError.exit_code)
    if outcome.exit == "interrupted":
        raise Exit(INTERRUPTED)


@app.command("pose")
def pose(
    name: str = NAME,
    face: list[str] = Argument(..., metavar="EXPRESSION|CHANNEL=VALUE...", help="smile, blink, jawOpen=0.5 ..."),
    port: str = Option("sim", help="'sim' for emulated servos, a serial device, or NAME=DEVICE per bus."),
    hold: float = Option(2.0, min=0.0, max=60.0, metavar="S", help="Seconds for which the pose is held."),
    fast: bool = Option(False, help="Virtual time, on emulated servos."),
    yes: bool = YES,
    json: bool = JSON,
) -> None:
    """Move one expression or channel under the head's limits, hold it, and go back to rest."""
    from sfms_robot.app.head.pose import pose_head
    from sfms_robot.app.listen.panel import live_panel
    from sfms_robot.app.options import HeadOptions

    options = HeadOptions(head=name, port=port, fast=fast, yes=yes)
    posed = pose_head(options, face, hold, None if json else live_panel)
    show(posed, json, heading="{head} on {port}: {face}, {exit}")


@app.command("fit")
def fit(
    name: str = NAME,
    recording: Path | None = Option(
        None, metavar="DIR", help="run.mcap of the joints, and face.csv: the track of a face tracker."
    ),
    babble: bool = Option(False, "--babble", help="Move the face within its limits and record it."),
    port: str = Option("sim", help="For --babble: 'sim' (a virtual face), a device, or NAME=DEVICE per bus."),
    record: Path | None = Option(None, metavar="DIR", help="Folder for --babble."),
    minutes: float = Option(2.0, min=0.1, max=60.0, help="Length of --babble."),
    seed: int = Option(0, min=0, help="Seed of the random faces of --babble."),
    yes: bool = YES,
    json: bool = JSON,
) -> None:
    """Learn the drives of a face from its joints and from the track of a face tracker in front of it.

    The fit of this build is written to your overlay of the head's file. On a real port --babble records only joints:
    track the face with your camera, put the track into the same folder as face.csv, and fit the recording.
    """
    from sfms_robot.app.head.fit import babble as move
    from sfms_robot.app.head.fit import fit_head, see_virtual_face
    from sfms_robot.app.listen.panel import live_panel
    from sfms_robot.app.options import HeadOptions

    def fitted(learnt: Result) -> None:
        practice = "; practice on emulated servos: no run uses this file" if learnt["practice"] else ""
        show(
            learnt,
            json,
            heading="{head}: {frames} frames, tracker {delay_s} s late; rms {before} -> {after}, written to {file}",
            keys=("joints",),
            note=f"rms in joint units (1 = half the range), on held-out frames{practice}",
        )

    if babble == (recording is not None):
        raise ConfigError("head fit: give one of --recording DIR and --babble")
    if recording is not None:
        fitted(fit_head(name, recording))
        return
    if port != "sim" and record is None:
        raise ConfigError("head fit --babble on a real port needs --record DIR, where the face track goes too")
    with tempfile.TemporaryDirectory() as spare:
        folder = record if record is not None else Path(spare)
        servos = HeadOptions(head=name, port=port, fast=port == "sim", yes=yes)
        report = move(servos, folder, minutes=minutes, seed=seed, panel=None if json else live_panel)
        if port == "sim" and report["exit"] == "done":
            see_virtual_face(name, folder)
            fitted(fit_head(name, folder))
            return
    seconds = round(report["duration_s"], 1)
    moved = {"head": report["head"], "exit": report["exit"], "seconds": seconds, "record": str(record)}
    show(moved, json, lambda _: say(f"{report['exit']}: {folder}/run.mcap; put the face track beside it"))


@app.command("solve")
def solve(
    name: str = NAME,
    poses: Path = Option(
        ...,
        metavar="FILE.csv",
        help="Columns x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad and, if wanted, body_yaw_rad.",
    ),
    residual: bool = Option(False, "--residual", help="Also print the remaining errors: residual_rad,residual_m."),
    json: bool = JSON,
) -> None:
    """Print the neck's joint angles for each pose, as CSV in rad, and whether the pose is reached (1) or not (0)."""
    from sfms_robot.app.head.head_solve import solve_poses

    def printed(table: Result) -> None:
        missing = ("residual_rad", "residual_m") if residual else ()
        rows = csv.writer(sys.stdout, lineterminator="\n")
        rows.writerow([*table["joints"], "reached", *missing])
        for pose in table["poses"]:
            angles = (f"{angle:.12f}" for angle in pose["angles_rad"])
            rows.writerow([*angles, int(pose["reached"]), *(f"{pose[key]:.3e}" for key in missing)])

    show(solve_poses(name, poses), json, printed)


@app.command("import")
def import_file(
    file: Path = Argument(..., help="LeRobot's calibration JSON, Reachy Mini's hardware_config.yaml, or pypot's JSON."),
    to: Path | None = Option(
        None, metavar="DIR", help="New folder. Default: one named after the file, in the current folder."
    ),
    model: str | None = Option(None, help="Model of the servos, if the file does not name it (LeRobot)."),
    json: bool = JSON,
) -> None:
    """Make a head folder from the file of other software, and list values that it cannot hold."""
    from sfms_robot.app.head.head_import import import_head

    def printed(imported: Result) -> None:
        folder = imported["folder"]
        say(f"{folder}/head.yaml: {len(imported['joints'])} joints, from {imported['read_as']}", "bold")
        for remark in imported["remarks"]:
            say(f"  {remark}")
        say(f"next: sfms-robot head check {folder}; sfms-robot doctor --head {folder} --port DEVICE")

    show(import_head(file, to, model), json, printed)
