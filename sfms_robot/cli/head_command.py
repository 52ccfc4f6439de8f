"""`sfms-robot head`: the heads at hand, whether one is sound, what this build of it measures, and how it moves."""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.errors import ConfigError, TorqueError

if TYPE_CHECKING:
    from sfms_robot.app.head.fit import HeadFit

INTERRUPTED = 130
PACKAGES = typer.Option(
    [], "--package", metavar="DIR", help="A folder outside the head's that meshes may lie in; may be repeated."
)
NAME = typer.Argument(..., metavar="NAME|DIR", help="A shipped head, or a folder with a head.yaml.")
JSON = typer.Option(False, "--json", help="Print as one JSON object.")
JSON_OUTCOME = typer.Option(False, "--json", help="Print the outcome as one JSON object, last line of stdout.")
YES = typer.Option(False, "--yes", help="Hobby servos may jump to rest when they come on.")

app = typer.Typer(help="Heads: list, check, show, pose, calibrate, fit, solve.", no_args_is_help=True)


@app.command("fit")
def fit(
    name: str = NAME,
    recording: Path | None = typer.Option(
        None, "--recording", metavar="DIR", help="run.mcap of the joints, and face.csv: what a tracker saw of them."
    ),
    babble: bool = typer.Option(False, "--babble", help="Move the face within its limits and record it."),
    port: str = typer.Option("sim", help="For --babble: 'sim' (a virtual face), a device, or NAME=DEVICE per bus."),
    record: Path | None = typer.Option(None, "--record", metavar="DIR", help="Where --babble writes to."),
    minutes: float = typer.Option(2.0, "--minutes", min=0.1, max=60.0, help="Length of --babble."),
    seed: int = typer.Option(0, min=0, help="Of the random faces of --babble."),
    yes: bool = YES,
    json: bool = JSON_OUTCOME,
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


@app.command("list")
def list_heads(
    urdf: Path | None = typer.Option(None, "--urdf", metavar="FILE.png", help="Draw them all."),
    json: bool = JSON,
) -> None:
    """Shipped heads, with joints and buses."""
    from sfms_robot.app.catalogue import shipped_heads

    if urdf is not None:
        from sfms_robot.app.head.head_scene import draw_shipped_heads
        from sfms_robot.app.out_files import checked_png

        draw_shipped_heads(checked_png(urdf, "--urdf"))
    heads = shipped_heads()
    if json:
        print_json({"heads": heads})
        return
    from sfms_robot.cli.show_head import print_heads

    print_heads(heads)


@app.command("check")
def check(
    name: str = NAME,
    data: Path | None = typer.Option(None, "--data", metavar="DIR", help="Face tracks (CSV) in place of the bundled."),
    plot: Path | None = typer.Option(None, "--plot", metavar="FILE.png", help="Draw ranges and demands."),
    listener: str | None = typer.Option(None, metavar="NAME|DIR", help="Also what this listener cannot show."),
    packages: list[str] = PACKAGES,
    json: bool = JSON,
) -> None:
    """Every problem of a head's file at once, or what recorded faces ask of each of its joints."""
    from sfms_robot.app.head.head_check import check as check_head
    from sfms_robot.app.out_files import checked_png

    if plot is not None:
        checked_png(plot, "--plot")
    checked = check_head(name, data, listener, packages)
    if plot is not None and not checked.problems:
        from sfms_robot.app.head.head_check import plot as draw

        draw(checked, plot)
    if json:
        print_json(checked.as_dict())
    else:
        from sfms_robot.cli.show_head import print_check

        print_check(checked)
    if checked.problems:
        raise typer.Exit(ConfigError.exit_code)


@app.command("show")
def show(
    name: str = NAME,
    joint: str | None = typer.Option(None, "--joint", metavar="JOINT", help="Only this joint."),
    urdf: Path | None = typer.Option(
        None, "--urdf", metavar="FILE.png", help="Draw the robot, and tell what its URDF's joints follow."
    ),
    packages: list[str] = PACKAGES,
    json: bool = JSON,
) -> None:
    """Every value of every joint, and where it comes from: the head's file, or the calibration or fit of this build."""
    if urdf is not None:
        from sfms_robot.app.head.head_scene import draw_scene
        from sfms_robot.app.out_files import checked_png
        from sfms_robot.cli.show_head import print_scene

        told = draw_scene(name, checked_png(urdf, "--urdf"), packages)
        if json:
            print_json(told)
        else:
            print_scene(told)
        return
    from sfms_robot.config.overlay import provenance, refusals

    joints, refused = provenance(name), refusals(name)
    if joint is not None:
        if joint not in joints:
            raise ConfigError.at(name, "--joint", joint, "is not a joint of this head", joints)
        joints = {joint: joints[joint]}
    if json:
        told = {j: {key: {"value": v, "from": o} for key, (v, o) in values.items()} for j, values in joints.items()}
        print_json({"name": name, "joints": told, "refused": refused})
        return
    from sfms_robot.cli.show_head import print_provenance

    print_provenance(name, joints, refused)


@app.command("calibrate")
def calibrate(
    name: str = NAME,
    port: str = typer.Option(..., "--port", help="A serial device, NAME=DEVICE per bus, or 'sim' to practise."),
    joint: list[str] = typer.Option([], "--joint", metavar="JOINT", help="Only this joint; may be given often."),
    again: bool = typer.Option(False, "--again", help="Also joints that are measured already."),
    json: bool = JSON_OUTCOME,
) -> None:
    """Lead through the joints of this build: ends, rest, direction. Saved joint by joint, beside the shipped file."""
    from sfms_robot.app.head.calibrate import calibrate as lead_through
    from sfms_robot.cli.show_head import Terminal, print_calibration

    outcome = lead_through(name, port, Terminal(), joint, again)
    if json:
        print()  # ends the line of the last question
        print_json(outcome.as_dict())
    else:
        print_calibration(outcome)
    if outcome.torque_unconfirmed:
        print(f"sfms-robot: {TorqueError(outcome.torque_unconfirmed)}", file=sys.stderr)
    if outcome.problems:
        raise typer.Exit(ConfigError.exit_code)
    if outcome.torque_unconfirmed:
        raise typer.Exit(TorqueError.exit_code)
    if outcome.exit == "interrupted":
        raise typer.Exit(INTERRUPTED)


@app.command("pose")
def pose(
    name: str = NAME,
    face: list[str] = typer.Argument(..., metavar="EXPRESSION|CHANNEL=VALUE...", help="smile, blink, jawOpen=0.5 ..."),
    port: str = typer.Option("sim", help="'sim' for emulated servos, a serial device, or NAME=DEVICE per bus."),
    hold: float = typer.Option(2.0, "--hold", min=0.0, max=60.0, metavar="S", help="How long the pose is held."),
    fast: bool = typer.Option(False, help="Virtual time, on emulated servos."),
    yes: bool = YES,
    json: bool = typer.Option(False, "--json", help="Print what moved as one JSON object, last line of stdout."),
) -> None:
    """Move one expression or channel under the head's limits, hold it, and go back to rest."""
    from sfms_robot.app.head.pose import PoseOptions, pose_head
    from sfms_robot.cli.show_head import print_pose

    told = pose_head(PoseOptions(name, tuple(face), port, hold, fast, yes))
    if json:
        print_json(told)
    else:
        print_pose(told)
    if told["error"]:
        print(f"sfms-robot: {told['error']}", file=sys.stderr)
    raise typer.Exit(told["exit_code"])


@app.command("solve")
def solve(
    name: str = NAME,
    poses: Path = typer.Option(
        ...,
        "--poses",
        metavar="FILE.csv",
        help="Columns x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad and, if wanted, body_yaw_rad.",
    ),
    residual: bool = typer.Option(False, "--residual", help="Also print what is missing: residual_rad,residual_m."),
    json: bool = typer.Option(False, "--json", help="Print as one JSON object, with what is missing."),
) -> None:
    """The neck's joints for each pose, as CSV in rad, and whether the pose is reached (1) or only approached (0)."""
    from sfms_robot.app.head.head_solve import solve_poses

    table = solve_poses(name, poses)
    if json:
        print_json(table.as_dict())
        return
    solved = table.solved
    rest = [solved.residual_rad, solved.residual_m] if residual else []
    rows = csv.writer(sys.stdout, lineterminator="\n")
    rows.writerow([*table.joints, "reached", *("residual_rad", "residual_m")[: len(rest)]])
    for angles, reached, *missing in zip(solved.angles_rad, solved.reached, *rest, strict=True):
        rows.writerow([*(f"{angle:.12f}" for angle in angles), int(reached), *(f"{value:.3e}" for value in missing)])


def _tell(result: HeadFit, json: bool) -> None:
    from sfms_robot.cli.show_head import print_fit

    if json:
        print_json(result.as_dict())
    else:
        print_fit(result)
