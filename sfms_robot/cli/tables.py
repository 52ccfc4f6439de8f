"""What people see after a command: tables by rich. Imported only when something is printed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from sfms_robot.cli.screen import screen


def print_run(report: Mapping[str, Any], record: Path | None) -> None:
    """The report of `run`, on one screen."""
    table = Table(
        title=f"{report['head']} listened for {report['duration_s']:g} s ({report['exit']})", show_header=False
    )
    motion, tick, limits, bus = report["motion"], report["tick"], report["limits"], report["bus"]
    rows = [
        ("face", f"{motion['nods']} nods, {motion['blinks']} blinks, {motion['smiles']} smiles"),
        ("ticks", _ticks(report["ticks"], tick)),
        ("latency", f"frame to wire p50 {_or(report['latency_ms']['frame_to_wire']['p50'], '-')} ms, "
                    f"speech to wire p50 {_or(report['latency_ms']['speech_to_wire']['p50'], '-')} ms"),
        ("listener", f"{report['listener']}, a plan in p50 {_or(report['listener_step_ms']['p50'], '-')} ms, "
                     f"p99 {_or(report['listener_step_ms']['p99'], '-')} ms"),
        ("limits", f"{limits['violations']} violations, {limits['clamped']} samples held back"),
        ("bus", f"{bus['writes']} writes, {bus['reads']} reads, {bus['errors']} errors, "
                f"silent: {bus['silent'] or 'none'}"),
    ]  # fmt: skip
    for name, text in rows:
        table.add_row(name, text)
    console = screen()
    console.print(table)
    if report.get("priority", "").startswith("refused"):
        console.print(f"real-time priority {report['priority']}", style="dim")
    if record is None:
        console.print(
            "To see it: add --record DIR, then `sfms-robot replay DIR --plot run.png --sheet head.png`.", style="dim"
        )


def _ticks(count: int, tick: Mapping[str, Any]) -> str:
    if tick["achieved_hz"] is None:
        return f"{count} in virtual time, {tick['target_hz']:g} a second"
    return (
        f"{count} at {tick['achieved_hz']:.4g} Hz of {tick['target_hz']:g}, "
        f"{tick['late']} late, jitter p99 {_or(tick['jitter_ms']['p99'], '-')} ms"
    )


def print_dry_run(report: Mapping[str, Any]) -> None:
    """Where every joint stands; torque was not touched."""
    table = Table("joint", "rad", "fault", title=f"{report['head']} on {report['port']}: torque untouched")
    for name, reading in report["readings"].items():
        table.add_row(name, _or(reading["position_rad"], "no answer"), reading["fault"] or "")
    screen().print(table)


def print_bench(result: Mapping[str, Mapping[str, Any]]) -> None:
    """One row per thing measured."""
    table = Table("measured", "median", "p99", "ratio", "to")
    for name, row in result.items():
        table.add_row(
            name, f"{row['median']:.4g} {row['unit']}", _or(row.get("p99"), "-"), f"{row['ratio']:.3g}", row["peer"]
        )
    screen().print(table)


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """A table of rows, with the keys of the first as its columns."""
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(_or(row.get(key), "-") for key in rows[0]))
    screen().print(table)


def _or(value: object, otherwise: str) -> str:
    if value is None:
        return otherwise
    return f"{value:.4g}" if isinstance(value, float) else str(value)
