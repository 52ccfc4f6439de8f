"""The printer of every command: one JSON object with --json, lines and tables for people without.

rich is imported when something is printed. Output that is piped keeps whole rows: nothing is cut or folded there.
"""

from __future__ import annotations

import json as to_json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from typer import Exit, Option

if TYPE_CHECKING:
    from rich.console import Console

JSON = Option(False, "--json", help="Print the result as one JSON object, the last line of stdout.")
_UNBROKEN = 1_000  # columns: wider than any table
_NESTED = 12


def show(result: Mapping[str, Any], json: bool, printed: Callable[[Mapping[str, Any]], None] | None = None) -> None:
    """Print the result of a command, and its `error` to stderr. Raises typer.Exit with its `exit_code`, if not 0.

    `printed` prints it for people; None: `print_report`.
    """
    if json:
        print_json(result)
    else:
        (printed or print_report)(result)
    if result.get("error"):
        print(f"sfms-robot: {result['error']}", file=sys.stderr)
    if result.get("exit_code"):
        raise Exit(result["exit_code"])


def print_report(result: Mapping[str, Any]) -> None:
    """Print a line for each value; a table for a list of rows, and for a mapping of names to rows."""
    for key, value in result.items():
        title = key.replace("_", " ")
        if isinstance(value, Mapping) and value and all(isinstance(each, Mapping) for each in value.values()):
            value = [{"": name, **each} for name, each in value.items()]
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            print_rows(value, None if key == "rows" else title)
        elif key not in ("version", "exit_code", "error"):
            say(f"{title}: {cell(value)}")


def print_json(result: Mapping[str, Any]) -> None:
    """Print an object as one line, and flush it. NaN and infinity, which JSON does not have, become null."""
    print(to_json.dumps(_finite(result), allow_nan=False), flush=True)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def screen() -> Console:
    """Return standard output, as wide as the terminal; of unlimited width where it is not one."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _UNBROKEN
    return console


def say(line: str, style: str = "") -> None:
    """Print one line of text, without markup, which the terminal wraps."""
    screen().print(line, style=style, markup=False, soft_wrap=True)


def print_rows(
    rows: Sequence[Mapping[str, Any]],
    title: str | None = None,
    *,
    alarming: Callable[[Mapping[str, Any]], bool] = lambda row: False,
) -> None:
    """Print a table whose columns are the keys of the rows; nothing without rows. `alarming` rows are red.

    A column of mappings with more than `_NESTED` keys is left to --json.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    if not rows:
        return
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    columns = {key: value for row in reversed(rows) for key, value in row.items()}
    order = dict.fromkeys(key for row in rows for key in row)
    keys = [key for key in order if not (isinstance(columns[key], Mapping) and len(columns[key]) > _NESTED)]
    for key in keys:
        numbers = all(isinstance(row.get(key), int | float | None) for row in rows)
        table.add_column(key, justify="right" if numbers else "left", no_wrap=numbers, overflow="fold")
    for row in rows:
        cells = [Text(cell(row.get(key))) for key in keys]
        table.add_row(*cells, style="bold red" if alarming(row) else "")
    screen().print(table)


def cell(value: object, missing: str = "-") -> str:
    """Return a value as text: a float in four digits, "a 1, b 2" for a mapping, "a, b" for a list.

    `missing` for None and NaN, and for what is empty.
    """
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {cell(each)}" for key, each in value.items()) or missing
    if isinstance(value, list | tuple):
        nested = [f"[{cell(each)}]" if isinstance(each, list | tuple) else cell(each) for each in value]
        return ", ".join(nested) or missing
    if value is None or value != value:
        return missing
    return f"{value:.4g}" if isinstance(value, float) else str(value)
