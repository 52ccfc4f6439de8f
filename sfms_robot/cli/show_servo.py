"""The live view of the servo tools, and the doctor's report. Imported when something is printed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Group
from rich.live import Live
from rich.text import Text

from sfms_robot.cli.show import Result, Row, counted, print_rows, say, screen, table_of

_COLUMNS = (
    "id",
    "joint",
    "model",
    "firmware",
    "firmware_minor",
    "baud",
    "voltage_V",
    "temperature_degC",
    "return_delay_us",
    "torque",
    "faults",
)  # columns of the table of a bus's servos
_STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def live(samples: Iterable[Sequence[Row]], title: str) -> None:
    """Show one table, redrawn with every sample, until the samples end or Ctrl-C is pressed."""
    console = screen()
    rows: Sequence[Row] = []
    try:
        with Live(console=console, auto_refresh=False, transient=console.is_terminal) as view:
            for rows in samples:
                if console.is_terminal:
                    view.update(Group(Text(f"{title}, Ctrl-C ends"), table_of(rows)), refresh=True)
    except KeyboardInterrupt:
        say("stopped", "dim")
    if rows:
        print_rows(rows, title)


def print_doctor(report: Result) -> None:
    """Print adapter, servos, budget, findings and verdict of every bus."""
    for bus in report["buses"]:
        say(f"bus {bus['bus']} on {bus['port']}" if bus["bus"] else bus["port"], "bold")
        _print_adapter(bus["adapter"] or {})
        print_rows([{key: row[key] for key in _COLUMNS} for row in bus["servos"]])
        if bus["budget"]:
            _print_budget(bus)
        for each in bus.get("fixed", ()):
            say(f"fixed   {each}", "green")
        for each in bus["findings"]:
            say(f"{each['severity']:8}{each['about']}: {each['problem']}", _STYLES[each["severity"]])
            if each["fix"]:
                say(f"        {each['fix']}", "cyan")
        if bus["udev_rule"] and any("udev rule" in each["fix"] for each in bus["findings"]):
            say("udev rule, for /etc/udev/rules.d/99-servos.rules (then sudo udevadm control --reload, and replug):")
            say(bus["udev_rule"], "cyan")
        counts = bus["counts"]
        verdict = "not fit to run" if counts["error"] else "fit to run"
        numbers = [counted(number, name) for name, number in counts.items()]
        say(f"{verdict}: {', '.join(numbers)}", "bold red" if counts["error"] else "bold green")


def _print_adapter(adapter: Result) -> None:
    usb = f"{adapter['vendor']}:{adapter['product']} {adapter['serial'] or ''}" if adapter.get("vendor") else None
    latency = f"latency timer {adapter['latency_ms']} ms" if adapter.get("latency_ms") is not None else None
    known = [adapter.get("description"), usb, adapter.get("driver"), latency, adapter.get("by_id")]
    if any(known):
        say("adapter: " + ", ".join(str(each).strip() for each in known if each))


def _print_budget(bus: Result) -> None:
    budget = bus["budget"]
    say(
        f"One turn of the loop with {budget['servos']} servos at {budget['baud']} baud; wanted {bus['rate_hz']:g} a "
        f"second; a servo answers {budget['return_delay_us']:g} us late, the adapter {budget['latency_ms']:g} ms"
    )
    tried = {True: "works here", False: "does not work here", None: "not tried"}[bus["fast_sync_read"]]
    names = {
        "write_only": "goals sent",
        "plain": "and each servo read",
        "fast": f"and all read in one answer ({tried})",
    }
    print_rows(
        [
            {"on the wire": name, "bytes": cost["bytes"], "ms": cost["ms"], "turns a second": cost["hz"]}
            for key, name in names.items()
            if (cost := budget[key])
        ]
    )
