"""What `data check` shows a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from sfms_robot.cli.show import screen

_SHOWN = 3  # names of a problem; --json has them all


def print_check(report: Mapping[str, Any], channels: bool) -> None:
    """Splits, what is wrong with them, and on request the range of every channel."""
    console = screen()
    order = f", {report['order']}" if report["order"] else ""
    first = report["splits"][0]
    table = Table(title=f"{report['layout']}{order}: {first['space']} at {first['fps']:g} fps")
    for name in ("split", "clips", "minutes", "frames", "listening", "sound", "features"):
        table.add_column(name, overflow="fold")
    for split in report["splits"]:
        table.add_row(
            split["split"], str(split["clips"]), f"{split['minutes']:.1f}", _span(split["frames"]),
            "-" if split["listening_share"] is None else f"{split['listening_share']:.0%}",
            _counts(split["sound"]), _counts(split["features"]),
        )  # fmt: skip
    console.print(report["folder"], soft_wrap=True)
    console.print(table)
    if channels:
        for split in report["splits"]:
            _print_channels(console, split)
    _print_problems(console, report)


def _print_channels(console: Console, split: Mapping[str, Any]) -> None:
    table = Table("channel", "min", "max", "mean", "std", title=f"{split['split']}: the listeners' motion")
    for row in split["channels"]:
        table.add_row(row["name"], *(f"{row[key]:.3f}" for key in ("min", "max", "mean", "std")))
    console.print(table)


def _print_problems(console: Console, report: Mapping[str, Any]) -> None:
    table = Table("split", "problem", "count", "where", "first", title="left out, or wrong")
    for split in report["splits"]:
        for problem in split["problems"]:
            more = "" if problem["count"] <= _SHOWN else f" and {problem['count'] - _SHOWN} more"
            names = "\n".join(problem["names"][:_SHOWN]) + more
            table.add_row(split["split"], problem["kind"], str(problem["count"]), names, problem["first"])
    if table.row_count:
        console.print(table)
    for note in dict.fromkeys(note for split in report["splits"] for note in split["notes"]):
        console.print(note, style="dim")
    for split in report["splits"]:
        if split["speaker_unknown_frames"]:
            console.print(
                f"{split['split']}: the speaker's face is unknown in {split['speaker_unknown_frames']} frames",
                style="dim",
            )
    console.print("usable" if report["usable"] else "not usable as it is")


def _span(frames: Mapping[str, float] | None) -> str:
    if frames is None:
        return "-"
    return f"{frames['min']:g}" if frames["min"] == frames["max"] else f"{frames['min']:g}-{frames['max']:g}"


def _counts(counts: Mapping[str, int]) -> str:
    return "\n".join(f"{name} {count}" for name, count in counts.items()) or "-"
