"""What people see after a command: tables by rich. Imported only when something is printed.

A pipe gets whole rows: tables are as wide as the terminal, and as wide as they are where nobody looks.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from sfms_robot.cli.json_line import print_json

_UNBROKEN = 1_000  # columns: wider than any table


def screen(**options: Any) -> Console:
    """Standard output. What reads a pipe finds no row cut or broken up."""
    console = Console(**options)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _UNBROKEN
    return console


def print_run(report: Mapping[str, Any], record: Path | None) -> None:
    """The report of `run`, on one screen."""
    table = Table(
        title=f"{report['head']} listened for {report['duration_s']:g} s ({report['exit']})", show_header=False
    )
    motion, tick, limits, bus = report["motion"], report["tick"], report["limits"], report["bus"]
    rows = [
        ("face", f"{motion['nods']} nods, {motion['blinks']} blinks, {motion['smiles']} smiles"),
        ("ticks", _ticks(report["ticks"], tick)),
        ("latency", f"frame to wire p50 {cell(report['latency_ms']['frame_to_wire']['p50'])} ms, "
                    f"speech to wire p50 {cell(report['latency_ms']['speech_to_wire']['p50'])} ms"),
        ("listener", f"{report['listener']}, a plan in p50 {cell(report['listener_step_ms']['p50'])} ms, "
                     f"p99 {cell(report['listener_step_ms']['p99'])} ms"),
        ("limits", f"{limits['violations']} violations, {limits['clamped']} samples held back"),
        ("bus", f"{bus['writes']} writes, {bus['reads']} reads, {bus['errors']} errors, "
                f"silent: {bus['silent'] or 'none'}"),
    ]  # fmt: skip
    if "recording" in report:
        rows.append(("recording", f"{report['recording']['bytes'] * 1e-6:.1f} MB"))
    if report["torque_unconfirmed"]:
        rows += [("torque", f"NOT confirmed off: {', '.join(report['torque_unconfirmed'])}")]
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
        f"{tick['late']} late, jitter p99 {cell(tick['jitter_ms']['p99'])} ms"
    )


def print_dry_run(report: Mapping[str, Any]) -> None:
    """Where every joint stands; torque was not touched."""
    table = Table("joint", "rad", "fault", title=f"{report['head']} on {report['port']}: torque untouched")
    for name, reading in report["readings"].items():
        table.add_row(name, cell(reading["position_rad"], "no answer"), reading["fault"] or "")
    screen().print(table)


def print_sound_check(told: Mapping[str, Any]) -> None:
    """Levels of what was heard, and what is not as it should be."""
    voice = told["source"].get("voice", {})
    table = Table(title=f"{voice.get('device') or told['audio']}, {told['seconds']:g} s", show_header=False)
    table.add_row("loudest", f"{told['level_dbfs']:g} dBFS (peak {told['peak']:.2f})")
    table.add_row("noise floor", f"{told['noise_floor_dbfs']:g} dBFS")
    table.add_row("clipped", f"{told['clipped']:.2%}")
    table.add_row("missing", f"{told['missing_frames']} frames")
    table.add_row("latency", f"{cell(voice.get('latency_ms'))} ms")
    console = screen(highlight=False)
    console.print(table)
    for line in told["findings"] or ["fit to be listened to"]:
        console.print(line)


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """A table of rows, with the keys of the first as its columns."""
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(cell(row.get(key)) for key in rows[0]))
    screen().print(table)


def cell(value: object, otherwise: str = "-") -> str:
    """A figure in a few digits; `otherwise` for what cannot be told (None, NaN)."""
    if value is None or value != value:
        return otherwise
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def print_list(key: str, rows: Sequence[Mapping[str, Any]], json: bool) -> None:
    """One line per row: its name, what is true of it, its description. As JSON: all of it, under `key`."""
    if json:
        print_json({"version": 1, key: rows})
        return
    console = screen(highlight=False)
    for row in rows:
        facts = [_fact(name, value) for name, value in row.items() if name not in ("name", "description")]
        text = "  ".join(filter(None, (", ".join(filter(None, facts)), row.get("description"))))
        console.print(Text.assemble((str(row["name"]), "bold"), "  ", text), soft_wrap=True)
    if not rows:
        console.print(f"no {key}", style="dim")


def _fact(name: str, value: object) -> str:
    if not value:
        return ""
    return name if value is True else f"{name} {cell(value)}"
