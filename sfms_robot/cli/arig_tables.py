"""What `evaluate interaction` shows people: its figures, and the confusion of states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from sfms_robot.cli.show import print_rows, screen


def print_interaction(result: Mapping[str, Any]) -> None:
    """Every figure on a line; then the states, labels down, answers across, in percent of the label."""
    print_rows([{"figure": key.replace("_", " "), "value": value} for key, value in result.items()
                if not isinstance(value, dict)])  # fmt: skip
    confusion = result.get("confusion")
    if confusion is None:
        return
    table = Table("label \\ answer, %", *(name.replace("_", " ") for name in confusion["states"]), "frames")
    for name, row in zip(confusion["states"], confusion["label_by_answer"], strict=True):
        total = sum(row)
        shares = (f"{100 * count / total:.0f}" if total else "-" for count in row)
        table.add_row(name.replace("_", " "), *shares, str(total))
    screen().print(table)
