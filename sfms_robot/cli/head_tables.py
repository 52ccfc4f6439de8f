"""What people see after `sfms-robot head ...`. Imported only when something is printed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from sfms_robot.app.head_check import HeadCheck

_OVER = "bold red"


def print_heads(heads: Sequence[Mapping[str, Any]]) -> None:
    """Two lines per shipped head."""
    console = Console(highlight=False)
    for head in heads:
        neck, families = head["neck"] or "no", ", ".join(head["buses"].values())
        console.print(f"[bold]{head['name']}[/]  {head['joints']} joints, {neck} neck, {families}")
        console.print(f"    {head['description']}", style="dim", soft_wrap=True)


def print_check(checked: HeadCheck) -> None:
    """The table of `head check`, or the problems, one line each."""
    console = Console()
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
    console.print("not driven: " + (", ".join(checked.dead_joints) or "none"))
    if checked.calibrate_first:
        console.print("calibrate first: on real servos it moves 20 % of its travel at 0.3 of its speed until then")


def print_origins(name: str, joints: Mapping[str, Mapping[str, tuple[Any, str]]]) -> None:
    """Every value of every joint; those that its own line does not give carry their origin."""
    for joint, values in joints.items():
        table = Table("key", "value", "from", title=f"{name}: {joint}", title_justify="left")
        for key, (value, origin) in values.items():
            table.add_row(key, f"{value:g}" if isinstance(value, float) else str(value), origin)
        Console().print(table)


def _share(share: float) -> str:
    text = f"{share:.0%}"
    return f"[{_OVER}]{text}[/]" if share > 1 else text
