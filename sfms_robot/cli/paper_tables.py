"""Tables of the SFMS paper as people read them: its row beside ours, then what follows from them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from sfms_robot.cli.screen import screen

TITLES = {
    "3": "Table III: where keyframes go",
    "4": "Table IV: kinds of codes",
}


def print_tables(result: Mapping[str, Any]) -> None:
    """What `evaluate tokenizer --table` found."""
    console = screen()
    for table in result.get("tables", [result]):
        _print(console, table)
    console.print(f"{result['windows']} windows of {result['data']}; MSE is the {result['unit']}. "
                  "The paper's figures are of other motion: compare ratios.", style="dim")  # fmt: skip


def _print(console: Console, found: Mapping[str, Any]) -> None:
    name = str(found["table"])
    table = Table(title=TITLES[name])
    table.add_column("")
    for heading in ("k", "params", "bits/window", "MSE", "median", "angles rad", "shapes", "paper MSE"):
        table.add_column(heading, justify="right")
    for row in found["rows"]:
        paper = row["paper_mse_e2"]
        table.add_row(
            row["name"] + (f"  [dim]{row['note']}[/dim]" if row["note"] else ""),
            "" if row["k"] is None else str(row["k"]),
            f"{row['params'] / 1e6:.2f} M",
            f"{row['bits_per_window']:,.0f}",
            f"{row['mse']:.4f}",
            f"{row['median']:.4f}",
            f"{row['angle_rmse_rad']:.4f}",
            f"{row['shape_rmse']:.4f}",
            "" if paper is None else f"{paper:.2f}e-2",
        )
    console.print(table)
    for line in _lines(found):
        console.print(line)


def _lines(found: Mapping[str, Any]) -> Iterator[str]:
    for name, ratio in found.get("ratios", {}).items():
        shown = (
            ", ".join(f"k = {k}: {value:.2f}" for k, value in ratio.items())
            if isinstance(ratio, Mapping)
            else f"{ratio:.3f} (1/{1 / ratio:.1f})"
        )
        yield f"{name.replace('_', ' ')}: {shown}"
