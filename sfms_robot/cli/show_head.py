"""What people see after `sfms-robot head ...`. Imported only when something is printed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table

from sfms_robot.app.head.calibrate import Outcome
from sfms_robot.app.head.fit import HeadFit
from sfms_robot.app.head.head_check import HeadCheck
from sfms_robot.cli.show import screen

_OVER = "bold red"


def print_heads(heads: Sequence[Mapping[str, Any]]) -> None:
    """Two lines per shipped head."""
    console = screen(highlight=False)
    for head in heads:
        neck, families = head["neck"] or "no", ", ".join(head["buses"].values())
        console.print(f"[bold]{head['name']}[/]  {head['joints']} joints, {neck} neck, {families}")
        console.print(f"    {head['description']}", style="dim", soft_wrap=True)


def print_check(checked: HeadCheck) -> None:
    """The table of `head check`, or the problems, one line each."""
    console = screen()
    if checked.problems:
        for problem in checked.problems:
            console.print(problem, style="red", markup=False, highlight=False, soft_wrap=True)
        return
    table = Table(
        title=f"{checked.name} on {checked.seconds:.0f} s of recorded faces", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    for heading in ("joint", "servo", "bus id"):
        table.add_column(heading, no_wrap=True)
    for heading in ("range deg", "used", "clipped", "speed", "jerk"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in checked.joints:
        table.add_row(
            row.joint,
            row.servo,
            f"{row.bus} {row.id}",
            f"{row.min_deg:.3g}..{row.max_deg:.3g}",
            f"{row.used:.0%}",
            f"{row.clipped:.1%}",
            _share(row.speed),
            _share(row.jerk),
        )
    console.print(table)
    console.print(
        "used: share of the range. clipped: of the time, at an end that is not rest. speed, jerk: of the limit, the"
        " 99th percentile of what the faces ask.",
        style="dim",
    )
    for row in checked.joints:
        console.print(f"{row.joint}: {', '.join(row.channels) or 'nothing moves it'}", highlight=False)
    if checked.neck is not None:
        units = {axis: "deg" if axis in ("roll", "pitch", "yaw") else "mm" for axis in checked.neck.reach}
        reach = ", ".join(f"{a} {lo:g}..{hi:g} {units[a]}" for a, (lo, hi) in checked.neck.reach.items())
        share = (
            "no recorded face moves its head"
            if checked.neck.reached is None
            else f"{checked.neck.reached:.1%} of the recorded poses in reach"
        )
        console.print(f"neck, one axis at a time: {reach}; {share}")
    console.print("cannot show: " + (", ".join(checked.blind_channels) or "nothing is left out"))
    if checked.limitation is not None:
        console.print(f"the listener: {checked.limitation}")
    console.print("not driven: " + (", ".join(checked.dead_joints) or "none"))
    if checked.calibrate_first:
        console.print("calibrate first: on real servos it moves 20 % of its travel at 0.3 of its speed until then")


def print_provenance(
    name: str, joints: Mapping[str, Mapping[str, tuple[Any, str]]], refused: Sequence[str] = ()
) -> None:
    """Every value of every joint with its origin, and what is known of this build but does not hold any more."""
    console = screen()
    for joint, values in joints.items():
        table = Table("key", "value", "from", title=f"{name}: {joint}", title_justify="left")
        for key, (value, origin) in values.items():
            table.add_row(key, f"{value:g}" if isinstance(value, float) else str(value), origin)
        console.print(table)
    for line in refused:
        console.print(line, style=_OVER, markup=False, highlight=False, soft_wrap=True)


def print_scene(told: Mapping[str, Any]) -> None:
    """The URDF of a head, and which of its joints follow which of ours."""
    renamed = {ours: theirs for ours, theirs in told["follows"].items() if ours != theirs}
    print(f"{told['name']}: {told['urdf']}, drawn as {told['picture']}")
    print(f"follow the joint of their own name: {', '.join(n for n in told['follows'] if n not in renamed) or 'none'}")
    for ours, theirs in renamed.items():
        print(f"{theirs} follows {ours}")
    if told["by_kinematics"]:
        print(f"by forward kinematics: {', '.join(told['by_kinematics'])}")
    if told["undriven"]:
        print(f"nothing in the picture follows: {', '.join(told['undriven'])}")
    for line in told["left_out"]:
        print(f"left out: {line}")


class Terminal:
    """The person in front of it, line by line."""

    def say(self, text: str) -> None:
        print(text, flush=True)

    def ask(self, prompt: str) -> str:
        return input(prompt)


def print_calibration(outcome: Outcome) -> None:
    """What is measured, what is missing, and what the check found."""
    print(f"\n{outcome.head}: {len(outcome.measured)} joints measured now, {len(outcome.before)} before")
    for joint, reason in outcome.skipped.items():
        print(f"left out: {joint}: {reason}")
    for problem in outcome.problems:
        print(f"does not hold: {problem}")
    if outcome.missing:
        print(f"to be calibrated first: {', '.join(outcome.missing)} (until then 20 % of the travel, 0.3 of the speed)")
    if outcome.measured or outcome.before:
        print(f"read back and checked: {outcome.file}" if not outcome.problems else f"in {outcome.file}")


def print_pose(told: Mapping[str, Any]) -> None:
    """The joints that moved: how far they were sent, and how far their servos say that they went."""
    table = Table(box=box.SIMPLE_HEAD, title=f"{told['head']}: {' '.join(told['face'])}", padding=(0, 1, 0, 0))
    table.add_column("joint", no_wrap=True)
    for heading in ("sent deg", "reached deg"):
        table.add_column(heading, justify="right")
    for joint, row in told["joints"].items():
        reached = "" if row["reached_deg"] is None else f"{row['reached_deg']:+.1f}"
        table.add_row(joint, f"{row['sent_deg']:+.1f}", reached)
    console = screen()
    console.print(table)
    if told["blind"]:
        console.print("cannot show: " + ", ".join(told["blind"]))


def print_fit(result: HeadFit) -> None:
    """Error per joint before and after, on held-out frames."""
    console = screen(highlight=False)
    table = Table(title=f"{result.head}: {result.frames} frames, tracker {1e3 * result.delay_s:.0f} ms late")
    table.box = box.SIMPLE_HEAD
    for heading in ("joint", "moved", "before", "after"):
        table.add_column(heading, justify="left" if heading == "joint" else "right", no_wrap=True)
    for row in result.rows:
        if row.moved is None or row.before is None or row.after is None:
            table.add_row(row.joint, "-", "-", "-", style="dim")
        else:
            table.add_row(row.joint, f"{row.moved[0]:.2f}..{row.moved[1]:.2f}", f"{row.before:.3f}", f"{row.after:.3f}")
    console.print(table)
    console.print(
        f"rms in joint units (1 = half the range), held-out frames: {result.before:.3f} -> {result.after:.3f}"
    )
    console.print(f"written to {result.file}", soft_wrap=True)


def _share(share: float) -> str:
    text = f"{share:.0%}"
    return f"[{_OVER}]{text}[/]" if share > 1 else text
