"""What people see after a command: tables by rich. Imported only when something is printed.

A pipe gets whole rows: tables are as wide as the terminal, and as wide as they are where nobody looks.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sfms_robot.cli.json_line import print_json

_UNBROKEN = 1_000  # columns: wider than any table
_QUIETEST_DB: Final = -60.0
_WIDTH: Final = 40
_LOUD_DB: Final = -12.0
_FALLS_DB_S: Final = 20.0  # of the mark at the loudest level, as meters do


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


# --- a level meter on one line, while a microphone is checked -------------------------------------------------------


class LevelMeter:
    """On stderr, and gone afterwards; nothing is shown where that is no terminal."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._loudest_db, self._since_s = _QUIETEST_DB, 0.0
        self._clipped = False

    def __enter__(self) -> LevelMeter:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def __call__(self, level_db: float, clips: bool) -> None:
        now_s = time.monotonic()
        self._loudest_db = max(level_db, self._loudest_db - _FALLS_DB_S * (now_s - self._since_s))
        self._since_s = now_s
        self._clipped |= clips
        if self._live.is_started:
            self._live.update(meter_line(level_db, self._loudest_db, self._clipped), refresh=True)


def meter_line(level_db: float, loudest_db: float, clipped: bool) -> Text:
    """A bar from -60 to 0 dB of full scale, a mark at the loudest, and whether anything has clipped."""
    full, mark = _cells(level_db), max(_cells(loudest_db) - 1, 0)
    cells = ["█" if cell < full else " " for cell in range(_WIDTH)]
    cells[mark] = "│" if mark >= full else cells[mark]
    colour = "red" if clipped else "yellow" if level_db > _LOUD_DB else "green"
    return Text.assemble(("".join(cells), colour), f" {level_db:6.1f} dBFS", (" clips" if clipped else "", "bold red"))


def _cells(level_db: float) -> int:
    return round(_WIDTH * min(max(1.0 - level_db / _QUIETEST_DB, 0.0), 1.0))
