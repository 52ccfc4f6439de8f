"""`sfms-robot servo`: find, inspect and change servos; `sfms-robot doctor`: check them before a run."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer
from typer import Argument, Exit, Option, Typer

from sfms_robot.cli.show import JSON, Later, Row, aside, counted, print_json, print_rows, show, with_shared_options
from sfms_robot.errors import BusError, ConfigError, ServoError

if TYPE_CHECKING:
    from sfms_robot.app import progress
    from sfms_robot.app.servo import single_servo
    from sfms_robot.app.servo.serial_line import FoundServo, Wire
else:
    progress, single_servo = Later("sfms_robot.app.progress"), Later("sfms_robot.app.servo.single_servo")

app = Typer(help="Servos: find them, read and write their registers, set id and rate.", no_args_is_help=True)

_SHOWN = ("model", "family", "protocol", "number", "firmware", "watchdog")  # the rest is in --json


Family = Literal["dynamixel2", "dynamixel1", "feetech"]
IDS = Argument(..., metavar="ID", help="One id, or several: 1-9,12.")
ONE_ID = Argument(..., metavar="ID")
YES = Option(False, "--yes", "-y", help="Do not ask before EEPROM is written.")


@dataclass(frozen=True, kw_only=True)
class Wiring:
    """Location of the servos of a command. Each field is an option of every command."""

    port: str | None = Option(None, help="Serial device, or 'sim'. Default: the only one found.")
    baud: int | None = Option(None, min=1, help="Search at this rate only. Default: every rate.")
    family: Family = Option("dynamixel2", help="The protocol of the servos.")
    head: str = Option("face28", help="The head whose servos --port sim emulates.")
    model: str | None = Option(None, help="Treat the servos as this model. Default: by their model number.")
    json: bool = JSON

    def open(self) -> AbstractContextManager[Wire]:
        """Return the wire to the servos, open inside a `with` block."""
        from sfms_robot.app.servo.serial_line import open_wire

        return open_wire(self.port, self.family, self.baud, self.head, self.model)


# --- looking ----------------------------------------------------------------------------------------------------


@app.command()
@with_shared_options
def scan(
    on: Wiring,
    ids: str | None = Option(None, help="Ping these ids one by one, as 1-9,12. Default: all."),
) -> None:
    """Find the servos on a wire, and their rates."""
    asked = single_servo.checked_ids(ids) if ids is not None else None
    with on.open() as wire, progress.bar("scanning", hidden=on.json) as step:
        found, hint = single_servo.scan_all(wire, asked, step)
        rows, where = [seen.row() for seen in found], wire.port.name
    title = f"{counted(len(rows), 'servo')} on {where}{f': {hint}' if hint else ''}"
    _show(rows, {"port": where, "servos": rows, "hint": hint}, on.json, title)


@app.command()
@with_shared_options
def ping(on: Wiring, ids: str = IDS) -> None:
    """Check that servos answer, and show their models."""
    rows = []
    with on.open() as wire:
        for servo in progress.tracked(single_servo.checked_ids(ids), "asking"):
            try:
                rows.append({**wire.find(servo).row(), "answers": True})
            except (BusError, ServoError):
                unknown = dict.fromkeys(("model", "model_number", "firmware", "firmware_minor", "baud", "family"))
                rows.append({"id": servo, **unknown, "note": "", "answers": False})
    _show(rows, {"servos": rows}, on.json)
    if not all(row["answers"] for row in rows):
        raise Exit(BusError.exit_code)


@app.command()
@with_shared_options
def read(
    on: Wiring,
    ids: str = IDS,
    registers: list[str] = Argument(..., metavar="REGISTER...", help="Names, or 'all'."),
) -> None:
    """Read registers by name: raw and in their unit."""
    _each(ids, on, "registers", lambda seen: single_servo.read_registers(seen, registers))


@app.command()
@with_shared_options
def monitor(
    on: Wiring,
    ids: str | None = Argument(None, metavar="ID", help="1-9,12. Default: all."),
    samples: int | None = Option(None, min=1, help="End after this many samples. Default: Ctrl-C ends."),
    rate: float = Option(5.0, min=0.1, max=50.0, help="Samples per second."),
) -> None:
    """Show position, load, voltage, temperature and faults, live. Reads only."""
    taken: Sequence[Sequence[Row]] = []
    with on.open() as wire:
        with progress.bar("looking for servos", hidden=on.json) as step:
            servos = _chosen(wire, ids, step)
        count = samples if samples is not None else 1 if on.json else None
        seen = single_servo.samples(servos, 1.0 / rate, count)
        if on.json:
            taken = list(seen)
        else:
            from sfms_robot.cli.show_servo import live

            live(seen, f"{counted(len(servos), 'servo')} on {wire.port.name}")
    if on.json:
        print_json({"samples": taken})


@app.command()
def maps(
    files: list[Path] = Argument(None, help="Your firmware maps, or folders of them, besides the shipped ones."),
    check: bool = Option(False, "--check", help="Check the maps for mistakes; exit code 2 if there are any."),
    json: bool = JSON,
) -> None:
    """List the servo models and boards that have a firmware map."""
    from sfms_robot.app.servo.maps import check_maps, list_maps

    if not check:
        rows = list_maps(files or [])
        _show([{key: row[key] for key in _SHOWN} for row in rows], {"maps": rows}, json)
        return
    findings = check_maps(files or [])
    lines = [f"{each.file}: {each.problem}" for each in findings] or ["the firmware maps are sound"]
    checked = {"sound": not findings, "findings": [each._asdict() for each in findings]}
    show(checked, json, lambda _: print("\n".join(lines)))
    if findings:
        raise Exit(2)


def doctor(
    port: str | None = Option(None, help="Serial device, NAME=DEVICE per bus, or 'sim'. Default: the only one found."),
    head: str | None = Option(None, help="Compare with this head: shipped name, or a folder with a head.yaml."),
    baud: int | None = Option(None, min=1, help="Without a head: search at this rate only. Default: every rate."),
    family: Family | None = Option(None, help="Without a head: protocol of the servos. Default: dynamixel2."),
    fix: bool = Option(
        False, "--fix", help="Correct stored values, in the servos or in the head's file; asks before each."
    ),
    yes: bool = Option(False, "--yes", "-y", help="With --fix: do not ask."),
    json: bool = JSON,
) -> None:
    """Check port, adapter, every servo, its stored values and the wire budget. Only reads, except with --fix.

    Exit code 0: fit to run. 3: the port cannot be opened. 4: a finding stops the head from running.
    """
    from sfms_robot.app.servo.doctor import examine
    from sfms_robot.cli.show_servo import print_doctor

    with progress.bar("looking", hidden=json or fix) as step:
        report = examine(port, head, family, baud, step, confirmation(yes) if fix else None)
    show(report, json, print_doctor)


# --- changing ---------------------------------------------------------------------------------------------------


@app.command(context_settings={"ignore_unknown_options": True})
@with_shared_options
def write(
    on: Wiring,
    ids: str = IDS,
    register: str = Argument(..., help="Its name in the firmware map."),
    value: str = Argument(..., help="Raw number, or one with the register's unit: 90deg."),
    yes: bool = YES,
) -> None:
    """Write a register and read it back. Asks before EEPROM, and refuses it while torque is on."""
    confirm = confirmation(yes, ids)
    _each(ids, on, "written", lambda seen: [single_servo.write_register(seen, register, value, confirm)])


@app.command(context_settings={"ignore_unknown_options": True})
@with_shared_options
def move(
    on: Wiring,
    servo: int = ONE_ID,
    to: str | None = Option(None, help="Ticks, or degrees of its shaft: 180deg."),
    by: str | None = Option(None, help="From its present position: ticks, or -5deg."),
) -> None:
    """Move one servo slowly, and restore torque and profile."""
    from sfms_robot.app.servo.move import move as go

    _each(str(servo), on, "moved", lambda seen: [go(seen, to, by)])


@app.command()
def release(
    head: str = Option("face28", help="Head whose servos are released."),
    port: str = Option("auto", help="As in `run`: DEVICE, BUS=DEVICE[,BUS=DEVICE], auto or sim."),
    everything: bool = Option(False, "--all", help="Release every id on the wires, at the rates of the head."),
    yes: bool = Option(False, "--yes", "-y", help="Do not ask before --all."),
    json: bool = JSON,
) -> None:
    """Switch off the torque of a head's servos, in any state; the head may fall."""
    from sfms_robot.app.servo.move import release_head

    if everything and not confirmation(yes)(f"--all takes torque off every servo on {port}"):
        raise ConfigError("--all: not confirmed, nothing was written")
    rows = release_head(head, port, everything)
    left = [row["joint"] or f"id {row['id']}" for row in rows if row["torque"] != "off"]
    title = f"torque off: {len(rows) - len(left)} of {len(rows)}"
    _show(rows, {"released": rows, "torque_unconfirmed": left}, json, title)
    if left:
        aside(f"torque is not confirmed off: {', '.join(left)}; switch off their supply")
        raise Exit(BusError.exit_code)


@app.command()
@with_shared_options
def dump(
    on: Wiring,
    file: Path = Argument(..., help="File to write; must not exist yet."),
    ids: str | None = Option(None, help="1-9,12. Default: all."),
) -> None:
    """Write all registers of servos to a YAML file."""
    single_servo.check_new(file)
    with on.open() as wire, progress.bar("reading", hidden=on.json) as step:
        servos = _chosen(wire, ids, step)
        single_servo.save_dump(single_servo.dump(servos), file)
    rows = [seen.row() for seen in servos]
    _show(rows, {"file": str(file), "servos": rows}, on.json)


@app.command()
@with_shared_options
def restore(
    on: Wiring,
    file: Path = Argument(..., help="File that `servo dump` wrote."),
    source: int | None = Option(None, "--from", help="Id in the file. Default: each servo of the file."),
    into: int | None = Option(None, help="Id on the wire, with --from. Default: the same."),
    identity: bool = Option(False, "--identity", help="Also write id and rate of the file."),
    yes: bool = YES,
) -> None:
    """Write the EEPROM of a dumped servo to one of the same model. Shows the differences and asks."""
    from sfms_robot.config.base import load

    kept = {each.id: each for each in load(single_servo.Dump, file).servos}
    if source is None and into is not None:
        raise ConfigError("servo restore: --into needs --from, the id in the file")
    if source is not None and source not in kept:
        raise ConfigError.at(str(file), "--from", source, "is not in the file", kept)
    pairs = kept if source is None else {source if into is None else into: kept[source]}
    confirm = confirmation(yes)
    with on.open() as wire:
        rows = [
            row
            for servo, was in pairs.items()
            for row in single_servo.restore(wire.find(servo), was, confirm, identity)
        ]
    _show(rows, {"written": rows}, on.json, "" if rows else "nothing differs")


@app.command("set-id")
@with_shared_options
def set_id(
    on: Wiring,
    old: int = Argument(..., help="Its present id."),
    new: int = Argument(..., help="Its new id."),
    in_chain: bool = Option(False, "--in-chain", help="Allow other servos on the wire."),
    yes: bool = YES,
) -> None:
    """Change the id of a servo. Best with only this servo on the wire."""
    _each(str(old), on, "servos", lambda seen: [single_servo.set_id(seen, new, confirmation(yes), in_chain).row()])


@app.command("set-baud")
@with_shared_options
def set_baud(
    on: Wiring,
    ids: str = IDS,
    rate: int = Argument(..., metavar="BAUD", help="New rate, bits per second."),
    yes: bool = YES,
) -> None:
    """Change the rate of servos, and check that they answer at it."""
    confirm = confirmation(yes, ids)
    _each(ids, on, "servos", lambda seen: [single_servo.set_baud(seen, rate, confirm).row()])


@app.command()
@with_shared_options
def reboot(on: Wiring, ids: str = IDS, yes: bool = YES) -> None:
    """Reboot servos: torque goes off, latched hardware errors are cleared."""
    confirm = confirmation(yes, ids)
    _each(ids, on, "servos", lambda seen: [single_servo.reboot(seen, confirm).row()])


@app.command("factory-reset")
@with_shared_options
def factory_reset(
    on: Wiring,
    servo: int = ONE_ID,
    keep: Literal["all", "keep-id", "keep-id-and-baud"] = Option(
        "keep-id-and-baud", "--reset", help="Settings to reset."
    ),
    yes: bool = YES,
) -> None:
    """Set a servo to its factory values."""
    _each(str(servo), on, "servos", lambda seen: [single_servo.factory_reset(seen, keep, confirmation(yes)).row()])


# --- shared -----------------------------------------------------------------------------------------------------


def confirmation(yes: bool, ids: str = "") -> Callable[[str], bool]:
    """Return a function that asks a question and returns whether the answer is yes; with `yes` it asks nothing.

    With several `ids`, one answer holds for the same change to all of them; otherwise each question is asked.
    """
    alike = f" and the same for all of {ids}" if len(ids) > 1 and not ids.isdigit() else ""
    said = [True] if yes else []

    def ask(question: str) -> bool:
        if said:
            return said[0]
        if not sys.stdin.isatty():
            raise ConfigError(f"{question}: no terminal to ask on; confirm with --yes")
        answer = typer.confirm(f"{question}{alike}. Do it?", err=True)
        if alike:
            said.append(answer)
        return answer

    return ask


def _chosen(wire: Wire, ids: str | None, step: progress.Progress) -> list[FoundServo]:
    """Return the servos of `ids`, or all servos. Raises BusError if none answers."""
    servos = (
        [wire.find(servo) for servo in single_servo.checked_ids(ids)]
        if ids is not None
        else single_servo.scan(wire, None, step)
    )
    if not servos:
        raise BusError(f"{wire.port.name}: no servo answers")
    return servos


def _each(ids: str, on: Wiring, key: str, work: Callable[[FoundServo], Sequence[Row]]) -> None:
    """Call `work` for every id; the rows of the first ids are shown even if a later id fails."""
    rows: list[Row] = []
    servos = single_servo.checked_ids(ids)
    try:
        with on.open() as wire:
            for servo in servos:
                rows += [{"id": servo, **row} for row in work(wire.find(servo))]
    except Exception:
        if rows and not on.json:
            _show(rows, {}, on.json)
        raise
    _show(rows, {key: rows}, on.json)


def _show(rows: Sequence[Row], result: Row, json: bool, title: str = "") -> None:
    show(result, json, lambda _: print_rows([_for_people(row) for row in rows], title))


def _for_people(row: Row) -> Row:
    """Return a register in fewer columns, and any other row unchanged."""
    if "area" not in row:
        return row
    takes = None if row["min"] is None else f"{row['min']}..{row['max']}"
    kept = {key: row[key] for key in ("id", "register", "raw", "value", "unit")}
    return {**kept, "takes": takes, "kept in": f"{row['area']} ({row['access']})"}
