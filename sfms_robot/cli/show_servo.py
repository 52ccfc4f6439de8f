"""Tables, bars and the live view of the servo tools and the doctor. Imported only when something is printed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from sfms_robot.cli.show import screen

_SHORT = {
    "model_number": "number",
    "firmware": "fw",
    "voltage_V": "V",
    "temperature_degC": "degC",
    "position_deg": "deg",
    "return_delay_us": "delay us",
    "current_mA": "mA",
    "load_percent": "load %",
    "before": "was",
}
_STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def print_table(rows: Sequence[Mapping[str, Any]], title: str | None = None) -> None:
    """Print rows that share their keys, without empty columns."""
    console = screen()
    if title is not None:
        console.print(Text(title, style="bold"), soft_wrap=True)
    if rows:
        console.print(_table(rows))


def live(samples: Iterable[Sequence[Mapping[str, Any]]], title: str) -> None:
    """Show one table, redrawn with every sample, until they end or Ctrl-C is pressed."""
    console = screen()
    rows: Sequence[Mapping[str, Any]] = []
    try:
        with Live(console=console, auto_refresh=False, transient=console.is_terminal) as view:
            for rows in samples:
                if console.is_terminal:
                    view.update(Group(Text(title), _table(rows)), refresh=True)
    except KeyboardInterrupt:
        console.print("stopped", style="dim")
    if rows:
        print_table(rows, title.split(",")[0])


@contextmanager
def bar(text: str, hidden: bool) -> Iterator[Callable[[int, int, str], None]]:
    """Show a progress bar on stderr where that is a terminal; yield the function that moves it."""
    console = Console(stderr=True)
    progress = Progress(
        TextColumn(text),
        BarColumn(),
        TextColumn("{task.percentage:.0f} %  {task.description}"),
        console=console,
        transient=True,
        disable=hidden or not console.is_terminal,
    )
    with progress:
        task = progress.add_task("", total=None)
        yield lambda done, total, what: progress.update(task, completed=done, total=total, description=what)


def print_doctor(report: Mapping[str, Any]) -> None:
    """Print adapter, servos, budget and findings of every bus."""
    console = screen()
    for bus in report["buses"]:
        for part in _bus(bus):
            console.print(part, soft_wrap=isinstance(part, Text))  # a command that is broken up cannot be pasted


def _bus(bus: Mapping[str, Any]) -> Iterator[RenderableType]:
    yield Text(f"bus {bus['bus']} on {bus['port']}" if bus["bus"] else bus["port"], style="bold")
    adapter = bus["adapter"] or {}
    usb = f"{adapter['vendor']}:{adapter['product']} {adapter['serial'] or ''}" if adapter.get("vendor") else None
    latency = f"latency timer {adapter['latency_ms']} ms" if adapter.get("latency_ms") is not None else None
    known = [adapter.get("description"), usb, adapter.get("driver"), latency, adapter.get("by_id")]
    if any(known):
        yield Text("adapter: " + ", ".join(str(each).strip() for each in known if each))
    if bus["servos"]:
        columns = (
            "id",
            "joint",
            "model",
            "firmware",
            "baud",
            "voltage_V",
            "temperature_degC",
            "return_delay_us",
            "torque",
            "faults",
        )
        yield _table([{key: row[key] for key in columns} for row in bus["servos"]])
    if bus["budget"]:
        yield from _budget(bus)
    for each in bus.get("fixed", ()):
        yield Text(f"fixed   {each}", style="green")
    for each in bus["findings"]:
        yield Text.assemble((f"{each['severity']:8}", _STYLES[each["severity"]]), f"{each['about']}: {each['problem']}")
        if each["fix"]:
            yield Text(f"        {each['fix']}", style="cyan")
    if bus["udev_rule"] and any("udev rule" in each["fix"] for each in bus["findings"]):
        yield Text("udev rule, for /etc/udev/rules.d/99-servos.rules (then sudo udevadm control --reload, and replug):")
        yield Text(bus["udev_rule"], style="cyan")
    counts = bus["counts"]
    verdict = "not fit to run" if counts["error"] else "fit to run"
    numbers = [f"{number} {name}{'s' if number != 1 else ''}" for name, number in counts.items()]
    yield Text(f"{verdict}: {', '.join(numbers)}", style="bold red" if counts["error"] else "bold green")


def _budget(bus: Mapping[str, Any]) -> Iterator[RenderableType]:
    budget = bus["budget"]
    yield Text(
        f"One tick of {budget['servos']} servos at {budget['baud']} baud; wanted {bus['rate_hz']:g} Hz; "
        f"return delay {budget['return_delay_us']:g} us, adapter {budget['latency_ms']:g} ms"
    )
    tried = {True: "works here", False: "does not work here", None: "not tried"}[bus["fast_sync_read"]]
    names = {"write_only": "goals", "plain": "goals, and all read", "fast": f"the same by fast sync read ({tried})"}
    costs = [(name, budget[key]) for key, name in names.items() if budget[key]]
    yield _table(
        [{"on the wire": name, "bytes": cost["bytes"], "ms": cost["ms"], "Hz": cost["hz"]} for name, cost in costs]
    )


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    keys = [key for key in rows[0] if any(row[key] not in (None, "") for row in rows)]
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for key in keys:
        numbers = all(isinstance(row[key], (int, float, type(None))) for row in rows)
        table.add_column(
            _SHORT.get(key, key.replace("_", " ")),
            justify="right" if numbers else "left",
            no_wrap=numbers,  # in a narrow terminal texts are folded, numbers stay whole
            overflow="fold",
        )
    for row in rows:
        table.add_row(*(_cell(row[key]) for key in keys))
    return table


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)
