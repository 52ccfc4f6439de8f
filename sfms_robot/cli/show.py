"""Output of all commands: one JSON object with --json, otherwise lines and tables for people; shared options.

rich is imported when something is printed. Output that is piped keeps whole rows: nothing is cut or folded there.
"""

from __future__ import annotations

import inspect
import json as to_json
import math
import os
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from itertools import chain
from string import Formatter
from typing import TYPE_CHECKING, Any

from typer import Exit, Option

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

Result = Mapping[str, Any]  # result of a command, as --json prints it
Row = Result  # row of a table

JSON = Option(False, "--json", help="Print the result as one JSON object, the last line of stdout.")
_UNBROKEN = 1_000  # columns: wider than any table
_NESTED = 12  # most keys of a mapping that is printed inside a table
_WIDE = 12  # columns; a table with more is transposed, with a row for each
_UNPRINTED = ("version", "exit_code", "error")
_WORDS = {
    "blind": "cannot show",
    "current_mA": "mA",
    "firmware": "fw",
    "firmware_minor": "minor",
    "load_percent": "load %",
    "missing": "to calibrate first (until then 20 % of the travel, 0.3 of the speed)",
    "model_number": "number",
    "paper_mse_e2": "paper mse e-2",
    "position_deg": "deg",
    "position_rad": "rad",
    "return_delay_us": "delay us",
    "speaker_frames": "frames of the person (40 ms)",
    "temperature_degC": "degC",
    "torque_unconfirmed": "torque not confirmed off",
    "voltage_V": "V",
    "whole": "complete",
}  # keys of results that are printed in other words; in any other key underscores become spaces


@dataclass(frozen=True)
class Later:
    """A module that is imported when one of its names is first used."""

    module: str

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.module), name)


def show(
    result: Result,
    json: bool,
    printed: Callable[[Result], None] | None = None,
    *,
    heading: str = "",
    keys: Sequence[str] = (),
    note: str = "",
) -> None:
    """Print the result of a command, and its `error` to stderr. Raises typer.Exit with its `exit_code`, if not 0.

    `printed`: function that prints it for people; None: `print_report`, which describes the other arguments.
    """
    if json:
        print_json(result)
    elif printed is not None:
        printed(result)
    else:
        print_report(result, heading, keys, note)
    if result.get("error"):
        aside(f"sfms-robot: {result['error']}")
    if result.get("exit_code"):
        raise Exit(result["exit_code"])


def with_shared_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return `command(shared, ...)` with a signature for typer: fields of `shared`, a dataclass, are options too."""
    first, *own = inspect.signature(command, eval_str=True).parameters.values()
    shared = inspect.signature(first.annotation, eval_str=True).parameters.values()

    @wraps(command)
    def run(**given: Any) -> None:
        command(first.annotation(**{each.name: given.pop(each.name) for each in shared}), **given)

    seen = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*own, *shared)]
    run.__dict__.pop("__wrapped__")  # or typer would use the signature of `command`
    run.__dict__["__signature__"] = inspect.Signature(seen)
    run.__annotations__ = {each.name: each.annotation for each in seen}
    return run


def print_report(result: Result, heading: str = "", keys: Sequence[str] = (), note: str = "") -> None:
    """Print a heading, the values of `keys` (default: all), and a note.

    A value is a line, or a table if it is a list of rows or a mapping of names to rows. Heading and note may contain
    values, as in "{head} on {port}", which are then not printed again.
    """
    texts = defaultdict(lambda: "-", {key: cell(value) for key, value in result.items()})
    named = {name for _, name, _, _ in Formatter().parse(heading + note)}
    if heading:
        say(heading.format_map(texts), "bold")
    for key, value in ((key, result[key]) for key in keys or result if key in result):
        if isinstance(value, Mapping) and value and all(isinstance(each, Mapping) for each in value.values()):
            value = [{"": name, **each} for name, each in value.items()]
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            print_rows(value, "" if key == "rows" else _words(key))
        elif key not in named and key not in _UNPRINTED:
            say(f"{_words(key)}: {cell(value, 'none')}")
    if note:
        say(note.format_map(texts), "dim")


def print_json(result: Result) -> None:
    """Print an object as one line, and flush it. NaN and infinity, which JSON does not have, become null."""
    print(to_json.dumps(_finite(result), allow_nan=False), flush=True)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def screen() -> Console:
    """Return standard output, as wide as the terminal; of unlimited width if it is not a terminal."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _UNBROKEN
    return console


def aside(line: str) -> None:
    """Print one line to stderr, apart from the result."""
    print(line, file=sys.stderr, flush=True)


def say(line: str, style: str = "") -> None:
    """Print one line of text, without markup, which the terminal wraps."""
    screen().print(line, style=style, markup=False, soft_wrap=True)


def print_rows(rows: Sequence[Row], title: str = "") -> None:
    """Print a title, and a table unless there are no rows."""
    if title:
        say(title, "bold")
    if rows:
        screen().print(table_of(rows))


def table_of(rows: Sequence[Row]) -> Table:
    """Return rows as a table: a column for each key that is not empty in all of them.

    A key `interval` of figures by name is printed after these figures. A mapping with more than `_NESTED` keys is only
    in --json. A table of more than `_WIDE` columns and few rows is transposed: a line for each key.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    def shown(value: Any) -> bool:
        return value not in (None, "", [], {}) and not (isinstance(value, Mapping) and len(value) > _NESTED)

    rows = [_with_intervals(row) for row in rows]
    keys = [key for key in dict.fromkeys(chain(*rows)) if any(shown(row.get(key)) for row in rows)]
    lines = [list(map(_words, keys)), *([cell(row.get(key)) for key in keys] for row in rows)]
    if len(keys) > max(_WIDE, len(rows)):
        lines = [list(column) for column in zip(*lines, strict=True)]
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading, *cells in zip(*lines, strict=True):
        numbers = all(each[:1] in "-+.0123456789" for each in cells)
        # In a narrow terminal texts are folded, numbers stay whole.
        table.add_column(Text(heading), justify="right" if numbers else "left", no_wrap=numbers, overflow="fold")
    for line in lines[1:]:
        table.add_row(*map(Text, line))
    return table


def _words(key: str) -> str:
    return _WORDS.get(key, key.replace("_", " "))


def _with_intervals(row: Row) -> Row:
    ends = row.get("interval")
    if not isinstance(ends, Mapping):
        return row
    figures = {key: value for key, value in row.items() if key != "interval"}
    return {key: f"{cell(each)} [{cell(ends[key])}]" if ends.get(key) else each for key, each in figures.items()}


def cell(value: object, missing: str = "-") -> str:
    """Return a value as text: "yes" or "no", a float in four digits or three decimals, "a 1, b 2" for a mapping.

    `missing` for None, NaN and empty values. A list is "a, b".
    """
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_nested(each)}" for key, each in value.items()) or missing
    if isinstance(value, list | tuple):
        return ", ".join(map(_nested, value)) or missing
    if value is None or value != value:
        return missing
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1 else f"{round(value, 3):g}"
    return str(value)


def counted(number: float, name: str) -> str:
    """Return "1 nod" or "2 nods"."""
    return f"{number} {name}{'s' * (number != 1)}"


def _nested(value: object) -> str:
    return f"[{cell(value)}]" if isinstance(value, list | tuple) else cell(value)
