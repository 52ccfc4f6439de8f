"""docs/performance.md as `bench --write FILE` makes it: every row that was measured, and how."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sfms_robot.errors import ConfigError
from sfms_robot.lab.bench.measure import machine

_HEAD = """# Measured by `sfms-robot bench`

Written by `make bench`, {when}, on {machine}, in {minutes:.1f} minutes.
Speeds are of that machine; what travels is the ratio: each figure beside its peer, both measured in the same run.

| measured | median | p99 | ratio | to | repeats |
|---|---|---|---|---|---|
"""


def write(file: Path, rows: Mapping[str, Mapping[str, Any]], minutes: float) -> None:
    """Write the page. Raises ConfigError where that cannot be."""
    lines = [
        f"| {name} | {row['median']:.4g} {row['unit']} | {_number(row.get('p99'))} | {_number(row.get('ratio'))} "
        f"| {row.get('peer', '-')} | {row.get('repeats', '-')} |"
        for name, row in rows.items()
        if isinstance(row, Mapping) and "median" in row
    ]
    head = _HEAD.format(when=datetime.now(UTC).date().isoformat(), machine=machine(), minutes=minutes)
    try:
        file.write_text(head + "\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--write {file}: cannot be written: {error.strerror}") from error


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
