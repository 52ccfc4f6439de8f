"""What people see after `sfms-robot head fit`. Imported only when something is printed."""

from __future__ import annotations

from rich import box
from rich.table import Table

from sfms_robot.app.head.fit import HeadFit
from sfms_robot.cli.screen import screen


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
