"""`sfms-robot servo`: find servos, look into them, change them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfms_robot.cli.servo_wiring import Wiring, confirmation, on_wire
from sfms_robot.cli.show import print_json
from sfms_robot.errors import BusError, ConfigError, ServoError

if TYPE_CHECKING:
    from sfms_robot.app.servo.serial_line import FoundServo, Wire

app = typer.Typer(help="Servos: find them, read and write their registers, set id and rate.", no_args_is_help=True)

_SHOWN = ("model", "family", "protocol", "number", "firmware", "watchdog")  # the rest is in --json


class Keep(StrEnum):
    all = "all"
    id = "keep-id"
    id_and_baud = "keep-id-and-baud"


Ids = Annotated[str, typer.Argument(metavar="ID", help="One id, or several: 1-9,12.")]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before EEPROM is written.")]


@app.command()
@on_wire
def scan(
    on: Wiring,
    ids: Annotated[str | None, typer.Option("--ids", help="Ask these one by one, as 1-9,12. Default: all.")] = None,
) -> None:
    """Who is there, at which rate."""
    from sfms_robot.app.servo.protocol_hint import protocol_hint
    from sfms_robot.app.servo.single_servo import parse_ids
    from sfms_robot.app.servo.single_servo import scan as look

    asked = parse_ids(ids) if ids is not None else None
    with on.open() as wire, _bar("scanning", hidden=on.json) as progress:
        hint = protocol_hint(wire)
        rows = [] if hint else [seen.row() for seen in look(wire, asked, progress)]
        where = wire.port.name
    title = f"{len(rows)} servo{'s' * (len(rows) != 1)} on {where}{f': {hint}' if hint else ''}"
    _show(rows, {"port": where, "servos": rows, "hint": hint}, on.json, title)


@app.command()
@on_wire
def ping(on: Wiring, ids: Ids) -> None:
    """Whether servos answer, and who they are."""
    rows: list[dict[str, Any]] = []
    with on.open() as wire:
        for servo in _parsed(ids):
            try:
                rows.append({**wire.find(servo).row(), "answers": True})
            except (BusError, ServoError):
                rows.append({"id": servo, "model": None, "model_number": None, "firmware": None, "baud": None,
                             "note": "", "answers": False})  # fmt: skip
    _show(rows, {"servos": rows}, on.json)
    if not all(row["answers"] for row in rows):
        sys.exit(BusError.exit_code)


@app.command()
@on_wire
def read(
    on: Wiring,
    ids: Ids,
    registers: Annotated[list[str], typer.Argument(metavar="REGISTER...", help="Names, or 'all'.")],
) -> None:
    """Registers by name: raw and in their unit."""
    from sfms_robot.app.servo.single_servo import read_registers

    def look(wire: Wire, seen: FoundServo) -> list[dict[str, Any]]:
        return [{"id": seen.id, **value.row()} for value in read_registers(wire, seen, registers)]

    _each(ids, on, look, "registers")


@app.command(context_settings={"ignore_unknown_options": True})
@on_wire
def write(
    on: Wiring,
    ids: Ids,
    register: Annotated[str, typer.Argument(help="Its name in the firmware map.")],
    value: Annotated[str, typer.Argument(help="Raw number, or one with the register's unit: 90deg.")],
    yes: YesOption = False,
) -> None:
    """Write a register and read it back. What lasts (EEPROM) is asked about first, and refused while torque is on."""
    from sfms_robot.app.servo.single_servo import write_register

    confirm = confirmation(yes, ids)

    def change(wire: Wire, seen: FoundServo) -> list[dict[str, Any]]:
        before, after = write_register(wire, seen, register, value, confirm)
        row = after.row()
        return [{"id": seen.id, "register": row["register"], "before": before.raw if before else None,
                 "raw": row["raw"], "value": row["value"], "unit": row["unit"]}]  # fmt: skip

    _each(ids, on, change, "written")


@app.command(context_settings={"ignore_unknown_options": True})
@on_wire
def move(
    on: Wiring,
    servo: Annotated[int, typer.Argument(metavar="ID")],
    to: Annotated[str | None, typer.Option("--to", help="Ticks, or degrees of its shaft: 180deg.")] = None,
    by: Annotated[str | None, typer.Option("--by", help="From where it stands: ticks, or -5deg.")] = None,
) -> None:
    """Move one servo slowly, and leave torque and profile as they were."""
    from sfms_robot.app.servo.move import move as go

    _each(str(servo), on, lambda wire, seen: [go(wire, seen, to, by)], "moved")


@app.command()
def release(
    head: Annotated[str, typer.Option("--head", help="Head whose servos are released.")] = "face28",
    port: Annotated[
        str, typer.Option("--port", help="As of run: DEVICE, BUS=DEVICE[,BUS=DEVICE], auto or sim.")
    ] = "auto",
    everything: Annotated[bool, typer.Option("--all", help="Every id on the wires, at the rates of the head.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before --all.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object, last line of stdout.")] = False,
) -> None:
    """Take torque off a head's servos, whatever state they are in; the head may fall."""
    from sfms_robot.app.options import HeadOptions
    from sfms_robot.app.servo.move import release as let_go
    from sfms_robot.app.servo.serial_line import real_clock
    from sfms_robot.app.wiring import open_wires
    from sfms_robot.config import load_head

    if everything and not confirmation(yes)(f"--all takes torque off every servo on {port}"):
        raise ConfigError("--all: not confirmed, nothing was written")
    found = load_head(head)
    with open_wires(found, HeadOptions(head=head, port=port)) as opened:
        rows = let_go(found, opened, real_clock(), everything)
    left = [row["joint"] or f"id {row['id']}" for row in rows if row["torque"] != "off"]
    _show(
        rows,
        {"released": rows, "torque_unconfirmed": left},
        json,
        f"torque off: {len(rows) - len(left)} of {len(rows)}",
    )
    if left:
        print(f"torque is not confirmed off: {', '.join(left)}; switch off their supply", file=sys.stderr)
        sys.exit(BusError.exit_code)


@app.command()
@on_wire
def dump(
    on: Wiring,
    file: Annotated[Path, typer.Argument(help="Is written; must not be there yet.")],
    ids: Annotated[str | None, typer.Option("--ids", help="1-9,12. Default: everybody.")] = None,
) -> None:
    """All registers of servos into a YAML file."""
    from sfms_robot.app.servo.dump import check_new, save_dump
    from sfms_robot.app.servo.dump import dump as taken

    check_new(file)
    with on.open() as wire, _bar("reading", hidden=on.json) as progress:
        servos = _chosen(wire, ids, progress)
        save_dump(taken(wire, servos), file)
    _show([seen.row() for seen in servos], {"file": str(file), "servos": [seen.row() for seen in servos]}, on.json)


@app.command()
@on_wire
def restore(
    on: Wiring,
    file: Annotated[Path, typer.Argument(help="As `servo dump` wrote it.")],
    source: Annotated[
        int | None, typer.Option("--from", help="Id in the file. Default: each servo of the file.")
    ] = None,
    into: Annotated[int | None, typer.Option("--into", help="Id on the wire, with --from. Default: the same.")] = None,
    identity: Annotated[bool, typer.Option("--identity", help="Give it id and rate of the file as well.")] = False,
    yes: YesOption = False,
) -> None:
    """Lasting settings (EEPROM) of a dumped servo into one of the same model. Shows the differences and asks."""
    from sfms_robot.app.servo.dump import load_dump
    from sfms_robot.app.servo.dump import restore as write_back

    kept = {each.id: each for each in load_dump(file).servos}
    if source is None and into is not None:
        raise ConfigError("servo restore: --into needs --from, the id in the file")
    if source is not None and source not in kept:
        raise ConfigError.at(str(file), "--from", source, "is not in the file", kept)
    pairs = {into if into is not None else servo: kept[servo] for servo in ([source] if source is not None else kept)}
    confirm = confirmation(yes)
    with on.open() as wire:
        rows = [
            row for servo, was in pairs.items() for row in write_back(wire, wire.find(servo), was, confirm, identity)
        ]
    _show(rows, {"written": rows}, on.json, None if rows else "nothing differs")


@app.command("set-id")
@on_wire
def set_id(
    on: Wiring,
    old: Annotated[int, typer.Argument(help="The id it has.")],
    new: Annotated[int, typer.Argument(help="The id it gets.")],
    in_chain: Annotated[bool, typer.Option("--in-chain", help="Other servos may be on the wire meanwhile.")] = False,
    yes: YesOption = False,
) -> None:
    """Give a servo another id. Best with that one servo on the wire."""
    from sfms_robot.app.servo.single_servo import set_id as change

    _each(str(old), on, lambda wire, seen: [change(wire, seen, new, confirmation(yes), in_chain).row()], "servos")


@app.command("set-baud")
@on_wire
def set_baud(
    on: Wiring,
    ids: Ids,
    rate: Annotated[int, typer.Argument(metavar="BAUD", help="The rate it gets, bits per second.")],
    yes: YesOption = False,
) -> None:
    """Give servos another rate, and check that they answer at it."""
    from sfms_robot.app.servo.single_servo import set_baud as change

    confirm = confirmation(yes, ids)
    _each(ids, on, lambda wire, seen: [change(wire, seen, rate, confirm).row()], "servos")


@app.command()
@on_wire
def reboot(on: Wiring, ids: Ids, yes: YesOption = False) -> None:
    """Start servos over: torque goes off, latched hardware errors go away."""
    from sfms_robot.app.servo.single_servo import reboot as restart

    confirm = confirmation(yes, ids)
    _each(ids, on, lambda wire, seen: [restart(wire, seen, confirm).row()], "servos")


@app.command("factory-reset")
@on_wire
def factory_reset(
    on: Wiring,
    servo: Annotated[int, typer.Argument(metavar="ID")],
    keep: Annotated[Keep, typer.Option("--reset", help="What goes back to its factory value.")] = Keep.id_and_baud,
    yes: YesOption = False,
) -> None:
    """Put a servo's settings back to what they were when it was new."""
    from sfms_robot.app.servo.single_servo import factory_reset as reset

    _each(str(servo), on, lambda wire, seen: [reset(wire, seen, keep.value, confirmation(yes)).row()], "servos")


@app.command()
@on_wire
def monitor(
    on: Wiring,
    ids: Annotated[str | None, typer.Argument(metavar="ID", help="1-9,12. Default: everybody.")] = None,
    samples: Annotated[int | None, typer.Option(min=1, help="End after so many looks. Default: Ctrl-C ends.")] = None,
    rate: Annotated[float, typer.Option("--rate", min=0.1, max=50.0, help="Looks per second.")] = 5.0,
) -> None:
    """Position, load, voltage, temperature and faults, live. Reads only."""
    from sfms_robot.app.servo.register_view import samples as looks

    taken: list[list[dict[str, Any]]] = []
    with on.open() as wire:
        with _bar("looking for servos", hidden=on.json) as progress:
            servos = _chosen(wire, ids, progress)
        count = samples if samples is not None else 1 if on.json else None
        if on.json:
            taken = list(looks(wire, servos, 1.0 / rate, count))
        else:
            from sfms_robot.cli.show_servo import live

            title = f"{len(servos)} servo{'s' * (len(servos) != 1)} on {wire.port.name}, Ctrl-C ends"
            live(looks(wire, servos, 1.0 / rate, count), title)
    if on.json:
        print_json({"samples": taken})


@app.command()
def maps(
    files: list[Path] = typer.Argument(None, help="Firmware maps of your own, or folders of them, beside the shipped."),
    check: bool = typer.Option(False, "--check", help="Look for mistakes in the maps; exit code 2 when there are any."),
    json: bool = typer.Option(False, "--json", help="Print as one JSON object."),
) -> None:
    """The servo models and boards that have a firmware map."""
    from sfms_robot.app.servo.maps import check_maps, list_maps

    if not check:
        rows = list_maps(files or [])
        if json:
            print_json({"maps": rows})
        else:
            from sfms_robot.cli.show import print_rows

            print_rows([{key: row[key] for key in _SHOWN} for row in rows])
        return
    findings = check_maps(files or [])
    if json:
        print_json({"sound": not findings, "findings": [each._asdict() for each in findings]})
    else:
        for each in findings:
            print(f"{each.file}: {each.problem}")
        print("the firmware maps are sound" if not findings else f"{len(findings)} problem(s)")
    if findings:
        raise typer.Exit(2)


def _parsed(ids: str) -> list[int]:
    from sfms_robot.app.servo.single_servo import parse_ids

    return parse_ids(ids)


def _chosen(wire: Wire, ids: str | None, progress: Any) -> list[FoundServo]:
    """Those of `ids`, or everybody. Raises BusError when nobody answers."""
    from sfms_robot.app.servo.single_servo import scan as look

    servos = [wire.find(servo) for servo in _parsed(ids)] if ids is not None else look(wire, None, progress)
    if not servos:
        raise BusError(f"{wire.port.name}: nobody answers")
    return servos


def _each(ids: str, on: Wiring, work: Callable[[Wire, FoundServo], list[dict[str, Any]]], key: str) -> None:
    """Do `work` for every id; what was done is shown even when a later one fails."""
    rows: list[dict[str, Any]] = []
    servos = _parsed(ids)
    try:
        with on.open() as wire:
            for servo in servos:
                rows += work(wire, wire.find(servo))
    except Exception:
        if rows and not on.json:
            _show(rows, {}, on.json)
        raise
    _show(rows, {key: rows}, on.json)


def _show(rows: Sequence[dict[str, Any]], result: dict[str, Any], json: bool, title: str | None = None) -> None:
    if json:
        print_json(result)
        return
    from sfms_robot.cli.show_servo import print_table

    print_table([_for_people(row) for row in rows], title)


def _for_people(row: dict[str, Any]) -> dict[str, Any]:
    """A register in fewer columns; any other row as it is."""
    if "area" not in row:
        return row
    takes = None if row["min"] is None else f"{row['min']}..{row['max']}"
    kept = {key: row[key] for key in ("id", "register", "raw", "value", "unit")}
    return {**kept, "takes": takes, "kept in": f"{row['area']} ({row['access']})"}


def _bar(text: str, hidden: bool) -> Any:
    from sfms_robot.cli.show_servo import bar

    return bar(text, hidden)
