"""`sfms-robot doctor`: examine a port, its adapter and every servo on it, and suggest fixes. Writes only to fix.

Without a head it reports which servos answer, at every rate. With a head it also reports servos that are missing, at
another rate, of another model or not in the file, and whether the bus reaches the head's rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from functools import partial
from typing import Final, cast

from sfms_robot.app.options import SIM
from sfms_robot.app.progress import Progress, no_progress
from sfms_robot.app.servo.diagnosis import (
    SEVERITIES,
    Finding,
    Line,
    Wanted,
    duplicate_id,
    grouped,
    judge_adapter,
    judge_board,
    judge_opening,
    judge_port,
    judge_presence,
    judge_rate,
    judge_servo,
    stored_contradictions,
    udev_rule,
    wire_budget,
)
from sfms_robot.app.servo.serial_line import (
    Confirm,
    FoundServo,
    Row,
    Wire,
    check_baud,
    only_port,
    other_wires,
    protocol_hint,
)
from sfms_robot.app.servo.single_servo import ServoState, read_all, scan
from sfms_robot.config import load_firmware_map, load_head
from sfms_robot.config.overlay import head_hash, layered, load_overlay, record_stored
from sfms_robot.data import Report
from sfms_robot.errors import BusError, ConfigError, PacketError, PortError, ServoError
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.boards import RateLimitedPort, board_for, board_problem
from sfms_robot.servo.chain.protocol2 import Dynamixel2Link
from sfms_robot.servo.chain.startup import needs_of
from sfms_robot.servo.discovery import SerialDevice, access_problem, describe, group_of, holders, list_ports, rivals
from sfms_robot.servo.families import family_named
from sfms_robot.servo.port import OpenPort, SerialPort
from sfms_robot.servo.registers import Table, span_of

FINE, PORT_FAILED, BUS_FAILED = 0, PortError.exit_code, ServoError.exit_code
DEFAULT_HEAD: Final = "face28"  # head whose servos are emulated
DEFAULT_FAMILY: Final = "dynamixel2"
_USB_MS: Final = 1.0  # an adapter without a latency timer of its own still waits for the next USB frame
_BOARD_S: Final = 0.2  # longest wait for a board, which answers at once; 9600 baud and a USB adapter take the rest
_READ: Final = ("present_position", "present_speed", "present_load", "present_current")


def examine(
    port: str | None,
    head: str | None,
    family: str | None,
    baud: int | None,
    progress: Progress = no_progress,
    fix: Confirm | None = None,
) -> Report:
    """Examine every bus of a head, or one port; return the report, whose `exit_code` is that of the command.

    `family` (None: dynamixel2) and `baud` (None: every rate) are for a port without a head: a head's file has both for
    each bus. `fix` must confirm each correction of a stored value that can be corrected safely; None corrects nothing.

    Raises ConfigError for a head, a family or a port description that cannot be used.
    """
    if head is None and port == SIM:
        head = DEFAULT_HEAD
    for key, value in (("--family", family), ("--baud", baud)):
        if head is not None and value is not None:
            raise ConfigError(f"{key} {value}: head {head!r} sets this for each of its buses; leave out one of the two")
    family = family or DEFAULT_FAMILY
    check_baud(family, baud)
    with ExitStack() as stack:
        lines = list(_lines(port, head, family, baud, stack))
        buses = [examine_line(line, open_port, progress, fix) for line, open_port in lines]
    codes = {bus["exit_code"] for bus in buses}
    return {
        "version": 1,
        "head": head,
        "port": port or lines[0][0].device,
        "buses": buses,
        "findings": sum((each["findings"] for each in buses), []),
        "exit_code": next((code for code in (PORT_FAILED, BUS_FAILED) if code in codes), FINE),
    }


def examine_line(
    line: Line, open_port: OpenPort, progress: Progress = no_progress, fix: Confirm | None = None
) -> Report:
    """Examine one port; return a report with `adapter`, `servos`, `budget`, `fixed`, `findings`, `exit_code`."""
    path, problem = line.device, access_problem(line.device)
    report: Report = {"bus": line.bus, "port": line.shown, "device": path, "family": line.family}
    report |= {"adapter": None, "udev_rule": None, "servos": [], "budget": None, "fixed": []}
    others = [Finding("warning", path, trouble, cure) for trouble, cure in rivals(path)]
    if problem is not None:
        return _finished(report, [judge_port(path, problem, group_of(path), list_ports()), *others], PORT_FAILED)
    held_by = [] if line.is_terminal else holders(path)
    try:
        port = open_port()
    except PortError as error:
        return _finished(report, [*judge_opening(path, str(error), held_by), *others], PORT_FAILED)
    with closing(port):
        adapter = describe(path)  # after opening, which may have set the latency
        report["adapter"] = asdict(adapter)
        try:
            if family_named(line.family).board:
                table = Table.of(load_firmware_map(next(iter(line.wanted.values())).model))
                wire = RateLimitedPort(port, line.first_baud, _BOARD_S)
                problem = board_problem(table, board_for(table, line.crc), wire)
                budget = wire_budget(line.family, len(line.wanted), line.first_baud, crc=line.crc)
                found = [*judge_board(line.family, len(line.wanted), problem, adapter), *judge_rate(budget, line)]
                facts = {"baud": line.first_baud, "rate_hz": line.rate_hz, "fast_sync_read": None, "budget": budget}
            else:
                found, facts = _look(line, Wire(port, line.family, line.first_baud), adapter, progress, fix)
            report |= {**facts, "udev_rule": udev_rule(adapter)}
        except (BusError, PacketError, ServoError) as error:
            found = [Finding("error", path, str(error).removeprefix(f"{path}: "), "check plug and cable")]
    return _finished(report, [*judge_adapter(adapter, held_by), *others, *found])


def _finished(report: Report, findings: Iterable[Finding], failed: int = BUS_FAILED) -> Report:
    together = grouped(findings)
    counts = {name: sum(each.severity == name for each in together) for name in SEVERITIES}
    code = failed if counts["error"] else FINE
    return {**report, "findings": [each.plain() for each in together], "counts": counts, "exit_code": code}


# --- the lines to examine -------------------------------------------------------------------------------------------


def _lines(
    port: str | None, head: str | None, family: str, baud: int | None, stack: ExitStack
) -> Iterator[tuple[Line, OpenPort]]:
    """Yield the lines to examine; the ports of a head are opened as its run opens them."""
    clock = RealClock()
    if head is None:
        device = port or only_port()
        line = Line(device=device, shown=device, family=family, baud=baud)
        yield line, partial(SerialPort, device, line.first_baud, clock)
        return
    from sfms_robot.app.open_head import bus_servos  # slow to load, and only a head needs them
    from sfms_robot.app.wiring import calibration_of, open_wires, port_of

    described = load_head(head)
    where = stack.enter_context(open_wires(described, port or only_port()))
    if port != SIM:
        described = layered(described, load_overlay(described), head_hash(head)).head  # with its measured calibration
    for name, each in where.items():
        bus, device = described.buses[name], each if isinstance(each, str) else each.device
        open_port: OpenPort = partial(SerialPort, device, bus.baud, clock, bus.rs485)
        if not isinstance(each, str):
            open_port = port_of(each, bus, clock)
        joints = described.on_bus(name)
        servos = bus_servos(described, joints)
        line = Line(
            device=device,
            shown=SIM if port == SIM else device,
            family=bus.family,
            baud=bus.baud,
            rate_hz=bus.rate_hz,
            wanted={
                servo.id: Wanted(
                    joint=servo.joint,
                    model=servo.table.model,
                    model_number=servo.table.model_number,
                    faults=described.faults,
                    needs=needs,
                )
                for servo, needs in zip(servos, needs_of(servos, calibration_of(joints), described.faults), strict=True)
            },
            bus=name,
            head=head,
            ports=port,
            crc=bus.crc,
        )
        yield line, open_port


# --- a chain of servos ----------------------------------------------------------------------------------------------


def _look(
    line: Line, wire: Wire, adapter: SerialDevice, progress: Progress, fix: Confirm | None
) -> tuple[list[Finding], Report]:
    """Return the findings and facts for which the port must be open."""
    baud, found = _present(wire, line, progress)
    findings = list(judge_presence(line, found, baud, "" if found else protocol_hint(other_wires(wire))))
    fixed: list[str] = []
    states = []
    for done, seen in enumerate(found):
        progress(done, len(found), f"id {seen.id}")
        wire.at(seen.baud)
        if wire.has_duplicate(seen.id):
            findings.append(duplicate_id(seen.id, line))
        try:
            state = read_all(seen)
            if fix is not None and (done_here := _fix(state, line, fix)):
                fixed += done_here
                state = read_all(seen)
            states.append(state)
            findings += judge_servo(state, line)
        except ServoError as error:
            level = seen.table.role("status_level") if seen.table else None
            cure = line.servo(f"write {{id}} {level.name} {level.high}", seen.baud) if level else ""
            findings.append(Finding("error", f"id {seen.id}", str(error), cure, servo=seen.id))
    members = [state for state in states if state.seen.baud == baud and state.seen.table is not None]
    wire.at(baud)
    fast, budget = _fast_read_works(wire, members), None
    if members:
        table = members[0].seen.registers()
        goal = table.role("goal_position")
        budget = wire_budget(
            line.family,
            max(len(line.wanted), len(members)),
            baud,
            return_delay_us=max(state.in_unit("return_delay") or 0.0 for state in members),
            latency_ms=0.0 if line.is_terminal else _USB_MS if adapter.latency_ms is None else adapter.latency_ms,
            read_bytes=span_of([field for role in _READ if (field := table.role(role)) is not None])[1],
            write_bytes=goal.size if goal else 2,
            together=table.byte_order == "little",
        )
        findings += judge_rate(budget, line, fast)
    return findings, {
        "baud": baud,
        "rate_hz": line.rate_hz,
        "servos": [_servo_row(state, line) for state in states],
        "fixed": fixed,
        "fast_sync_read": fast,
        "budget": budget,
    }


def _present(wire: Wire, line: Line, progress: Progress) -> tuple[int, Sequence[FoundServo]]:
    """Return the line's rate, or the rate of most servos, and the servos, those at this rate first.

    With a head, other rates are tried only for ids that are missing.
    """
    if line.baud is None and not line.wanted:
        every = scan(wire, None, progress)
        rates = Counter(seen.baud for seen in every)
        usual = max(rates, key=rates.__getitem__, default=wire.baud)
        return usual, sorted(every, key=lambda seen: seen.baud != usual)
    wanted = list(line.wanted)
    found = _at_this_rate(wire, line, wanted) or _at_this_rate(wire, line, wanted)  # twice: a packet may get lost
    for step, _ in enumerate(wire.reachable()):
        missing = [servo for servo in line.wanted if servo not in found]
        if not missing:
            break
        if step:
            progress(step, len(wire.bauds), f"{len(missing)} missing, {wire.baud} baud")
            for servo, seen in _at_this_rate(wire, line, missing).items():
                found.setdefault(servo, seen)
    return line.first_baud, list(found.values())


def _at_this_rate(wire: Wire, line: Line, ids: Sequence[int]) -> dict[int, FoundServo]:
    """Return the servos that answer a broadcast, if the family has it, and those of `ids` that answer a ping."""
    found = {seen.id: seen for seen in wire.answering()} if wire.kind.broadcast else {}
    if found or not wire.kind.broadcast:
        for servo in ids:
            if servo not in found and (seen := wire.ping(servo)) is not None:
                found[servo] = seen
    wanted = line.wanted
    return {id_: seen.taken_for(wanted[id_].model) if id_ in wanted else seen for id_, seen in found.items()}


def _fix(state: ServoState, line: Line, confirm: Confirm) -> list[str]:
    """Correct stored values that can be corrected safely, each confirmed and verified; return what was done.

    A value on which zero and direction depend is written to the head's file, never to the servo. Raises ConfigError for
    a file that cannot be written, ServoError for a servo that has torque on, or does not accept a value.
    """
    seen, want, done = state.seen, line.wanted.get(state.seen.id), []
    for each in stored_contradictions(state, want):
        about, change = f"id {seen.id} ({seen.model})", f"{each.register} {each.value} -> {each.wanted}"
        if each.in_file:
            change = f"in the head's file: {each.register} {each.wanted} -> {each.value}"
            if want and want.needs and line.head and confirm(f"{about}: {change} ({each.why})"):
                stored = {**want.needs.stored, each.register: each.value}
                file = record_stored(line.head, want.joint, stored, line.shown == SIM)
                line.wanted[seen.id] = want = replace(want, needs=replace(want.needs, stored=stored))
                done.append(f"{file}: {want.joint}: {each.register} {each.value}")
            continue
        if not each.fixable or not confirm(f"{about}: {change} ({each.why})"):
            continue
        seen.guard(change, lambda question: True)
        if (field := seen.named(each.register)).writable:
            seen.put(field, each.wanted)
        else:  # the reported position is brought into one turn; the shaft does not move
            link = cast(Dynamixel2Link, seen.wire.link)
            answer = link.clear_turns(seen.id)
            if answer is None or (refusal := link.refusal(answer)):
                raise ServoError(f"id {seen.id} does not clear its turns: {refusal if answer else 'no answer'}")
        done.append(f"id {seen.id}: {change}")
    return done


def _fast_read_works(wire: Wire, members: Sequence[ServoState]) -> bool | None:
    """Return whether a fast read works on the servos (None: not tried); a table of firmware numbers is less certain."""
    if wire.family != "dynamixel2" or not members:
        return None
    field = members[0].seen.registers().role("present_position")
    if field is None:
        return None
    alike = [state.seen.id for state in members if state.seen.registers().role(field.name) == field]
    where = field.address, field.size
    return any(set(wire.link.read_many(*where, alike, fast=True)) == set(alike) for _ in range(2))


def _servo_row(state: ServoState, line: Line) -> Row:
    want = line.wanted.get(state.seen.id)
    measured = state.measured(1, voltage_V="voltage", temperature_degC="temperature", return_delay_us="return_delay")
    row = {key: value for key, value in state.seen.row().items() if key != "family"}  # the report of the bus has it
    return {**row, "joint": want and want.joint, **measured, **state.health()}
