"""`sfms-robot doctor`: look at a port, its adapter and every servo on it, and say what to do. Reads only, but to fix.

Without a head it reports which servos answer, at every rate. With a head it also reports servos that are missing, at
another rate, of another model or not in the file, and whether the bus reaches the head's rate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from functools import partial
from typing import Any, Final, cast

from sfms_robot.app.options import SIM
from sfms_robot.app.progress import Progress, no_progress
from sfms_robot.app.servo.diagnosis import (
    SEVERITIES,
    Budget,
    Finding,
    Line,
    Wanted,
    grouped,
    judge_adapter,
    judge_board,
    judge_duplicate_ids,
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
from sfms_robot.config import Head, load_firmware_map, load_head
from sfms_robot.config.overlay import head_hash, layered, load_overlay, record_stored
from sfms_robot.errors import BusError, ConfigError, PacketError, PortError, ServoError
from sfms_robot.ports import Clock
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.boards import RateLimitedPort, board_for, board_problem
from sfms_robot.servo.chain.protocol2 import Dynamixel2Link
from sfms_robot.servo.chain.startup import needs_of
from sfms_robot.servo.discovery import SerialDevice, access_problem, describe, group_of, holders, list_ports, rivals
from sfms_robot.servo.families import family_named
from sfms_robot.servo.port import Port, SerialPort
from sfms_robot.servo.registers import Table

FINE, PORT_FAILED, BUS_FAILED = 0, PortError.exit_code, ServoError.exit_code
DEFAULT_HEAD: Final = "face28"  # whose servos are emulated
DEFAULT_FAMILY: Final = "dynamixel2"
_USB_MS: Final = 1.0  # an adapter without a latency timer of its own still waits for the next USB frame
_BOARD_S: Final = 0.2  # a board answers at once; 9600 baud and a USB adapter take the rest
_READ: Final = ("present_position", "present_speed", "present_load", "present_current")

Report = dict[str, Any]
OpenPort = Callable[[str, int], Port]
Found = Mapping[int, FoundServo]  # by id


def examine(
    port: str | None,
    head: str | None,
    family: str | None,
    baud: int | None,
    progress: Progress = no_progress,
    fix: Confirm | None = None,
) -> Report:
    """Look at every bus of a head, or at one port; return the report, whose `exit_code` is that of the command.

    `family` (None: dynamixel2) and `baud` (None: every rate) are of a port alone: a head's file has both of each bus.
    `fix` is asked before each stored value that can be mended without harm is; None mends nothing.

    Raises ConfigError for a head, a family or a port description that cannot be used.
    """
    if head is None and port == SIM:
        head = DEFAULT_HEAD
    for key, value in (("--family", family), ("--baud", baud)):
        if head is not None and value is not None:
            raise ConfigError(f"{key} {value}: head {head!r} says that of each of its buses; leave out one of the two")
    family = family or DEFAULT_FAMILY
    check_baud(family, baud)
    clock = RealClock()
    with ExitStack() as stack:
        lines = list(_lines(port, head, family, baud, stack))
        buses = [examine_line(line, clock, partial(_port, line.control, clock), progress, fix) for line in lines]
    codes = {bus["exit_code"] for bus in buses}
    return {
        "version": 1,
        "head": head,
        "port": port or lines[0].device,
        "buses": buses,
        "findings": sum((each["findings"] for each in buses), []),
        "exit_code": next((code for code in (PORT_FAILED, BUS_FAILED) if code in codes), FINE),
    }


def _port(control: str | None, clock: Clock, device: str, baud: int) -> Port:
    """Open a device, on emulated servos as a run does: a silence is one only if the emulator confirms it."""
    if control is None:
        return SerialPort(device, baud, clock)
    from sfms_robot.app.wiring import EmulatedPort

    return EmulatedPort(device, control, baud, clock)


def examine_line(
    line: Line, clock: Clock, open_port: OpenPort, progress: Progress = no_progress, fix: Confirm | None = None
) -> Report:
    """Look at one port; return a report with `adapter`, `servos`, `budget`, `fixed`, `findings`, `exit_code`."""
    path, problem = line.device, access_problem(line.device)
    report: Report = {"bus": line.bus, "port": line.shown, "device": path, "family": line.family}
    report |= {"adapter": None, "udev_rule": None, "servos": [], "budget": None, "fixed": []}
    others = [Finding("warning", path, trouble, cure) for trouble, cure in rivals(path)]
    if problem is not None:
        failed = judge_port(path, problem, group_of(path), list_ports())
        return _finished(report, [failed, *others], PORT_FAILED)
    held_by = [] if line.is_terminal else holders(path)
    try:
        port = open_port(path, line.first_baud)
    except PortError as error:
        return _finished(report, [*judge_opening(path, str(error), held_by), *others], PORT_FAILED)
    with closing(port):
        adapter = describe(path)  # after opening, which may have set the latency
        report["adapter"] = asdict(adapter)
        try:
            if family_named(line.family).board:
                found, facts = _look_at_board(line, port, adapter)
            else:
                found, facts = _look(line, Wire(port, line.family, clock, line.first_baud), adapter, progress, fix)
        except (BusError, PacketError, ServoError) as error:
            found = [Finding("error", path, str(error).removeprefix(f"{path}: "), "check plug and cable")]
        else:
            report |= {**facts, "udev_rule": udev_rule(adapter)}
    return _finished(report, [*judge_adapter(adapter, held_by), *others, *found])


def _finished(report: Report, findings: Iterable[Finding], failed: int = BUS_FAILED) -> Report:
    together = grouped(findings)
    counts = {name: sum(each.severity == name for each in together) for name in SEVERITIES}
    found = [each.plain() for each in together]
    return {**report, "findings": found, "counts": counts, "exit_code": failed if counts["error"] else FINE}


# --- what to look at ------------------------------------------------------------------------------------------------


def _lines(port: str | None, head: str | None, family: str, baud: int | None, stack: ExitStack) -> Iterator[Line]:
    if head is None:
        device = port or only_port()
        yield Line(device=device, shown=device, family=family, baud=baud)
        return
    from sfms_robot.app.wiring import open_wires  # slow to load, and only a head needs it

    described = load_head(head)
    where = stack.enter_context(open_wires(described, port or only_port()))
    if port != SIM:
        described = layered(described, load_overlay(described), head_hash(head)).head  # as it was measured
    for name, each in where.items():
        bus, device = described.buses[name], each if isinstance(each, str) else each.device
        yield Line(
            device=device,
            shown=SIM if port == SIM else device,
            family=bus.family,
            baud=bus.baud,
            rate_hz=bus.rate_hz,
            wanted=_wanted(described, name),
            bus=name,
            head=head,
            ports=port,
            control=None if isinstance(each, str) else each.control,
            crc=bus.crc,
        )


def _wanted(head: Head, bus: str) -> dict[int, Wanted]:
    """Return the servos of a bus as the head's file describes them, by id."""
    from sfms_robot.app.open_head import bus_servos
    from sfms_robot.app.wiring import calibration_of

    joints = {name: joint for name, joint in head.joints.items() if joint.bus == bus}
    servos = bus_servos(head, joints)
    return {
        servo.id: Wanted(
            joint=servo.joint,
            model=joints[servo.joint].model,
            model_number=servo.table.model_number,
            faults=head.faults,
            needs=needs,
        )
        for servo, needs in zip(servos, needs_of(servos, calibration_of(joints)), strict=True)
    }


# --- a chain of servos ----------------------------------------------------------------------------------------------


def _look(
    line: Line, wire: Wire, adapter: SerialDevice, progress: Progress, fix: Confirm | None
) -> tuple[list[Finding], Report]:
    """Return findings and facts that need the open port."""
    here, elsewhere = _present(wire, line, progress)
    baud = line.baud or next((seen.baud for seen in here.values()), wire.baud)
    hint = "" if here or elsewhere else protocol_hint(other_wires(wire))
    findings = list(judge_presence(line, here, elsewhere, baud, hint))
    fixed: list[str] = []
    states: list[ServoState] = []
    double: list[int] = []
    for done, seen in enumerate([*here.values(), *elsewhere.values()]):
        progress(done, len(here) + len(elsewhere), f"id {seen.id}")
        wire.at(seen.baud)
        double += [seen.id] if wire.has_duplicate(seen.id) else []
        try:
            state = read_all(seen)
            if fix is not None and (done_here := _fix(state, line, fix)):
                fixed += done_here
                state = read_all(seen)
            states.append(state)
        except ServoError as error:
            level = seen.table.role("status_level") if seen.table else None
            cure = line.servo(f"write {{id}} {level.name} {level.high}", seen.baud) if level else ""
            findings.append(Finding("error", f"id {seen.id}", str(error), cure, servo=seen.id))
    findings += judge_duplicate_ids(double, line)
    for state in states:
        findings += judge_servo(state, line)
    members = [state for state in states if state.seen.id in here and state.seen.table is not None]
    wire.at(baud)
    fast = _fast_read_works(wire, members)
    budget = _budget(line, baud, members, adapter)
    if budget is not None:
        findings += judge_rate(budget, line, fast)
    facts = {"baud": baud, "rate_hz": line.rate_hz, "servos": [_servo_row(state, line) for state in states]}
    return findings, facts | {"fixed": fixed, "fast_sync_read": fast, "budget": budget}


def _present(wire: Wire, line: Line, progress: Progress) -> tuple[Found, Found]:
    """Return the servos at the line's rate and at others, by id.

    With a head, other rates are looked at only for ids that are missing.
    """
    if line.baud is None and not line.wanted:
        found = scan(wire, None, progress)
        usual = max({each.baud for each in found}, key=lambda b: sum(s.baud == b for s in found), default=0)
        return {s.id: s for s in found if s.baud == usual}, {s.id: s for s in found if s.baud != usual}
    wanted = list(line.wanted)
    here = _at_this_rate(wire, line, wanted) or _at_this_rate(wire, line, wanted)  # one lost packet hides no bus
    elsewhere: dict[int, FoundServo] = {}
    for step, _ in enumerate(wire.reachable()):
        missing = [servo for servo in line.wanted if servo not in here and servo not in elsewhere]
        if not missing:
            break
        if step:
            progress(step, len(wire.bauds), f"{len(missing)} missing, {wire.baud} baud")
            elsewhere |= {i: seen for i, seen in _at_this_rate(wire, line, missing).items() if i not in here}
    return here, elsewhere


def _at_this_rate(wire: Wire, line: Line, ids: Sequence[int]) -> dict[int, FoundServo]:
    """Return the servos that answer a broadcast, where there is one, and those of `ids` that answer a ping."""
    found = {seen.id: seen for seen in wire.answering()} if wire.kind.broadcast else {}
    if found or not wire.kind.broadcast:
        for servo in ids:
            if servo not in found and (seen := wire.ping(servo)) is not None:
                found[servo] = seen
    wanted = line.wanted
    return {id_: seen.taken_for(wanted[id_].model) if id_ in wanted else seen for id_, seen in found.items()}


def _fix(state: ServoState, line: Line, confirm: Confirm) -> list[str]:
    """Write what can be mended without harm, each confirmed and verified; return what was done.

    A value that zero and direction depend on goes into the head's file, never into the servo. Raises ConfigError for a
    file that cannot be written, ServoError for a servo that has torque on, or does not take a value.
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
        else:
            _clear_turns(seen)
        done.append(f"id {seen.id}: {change}")
    return done


def _clear_turns(seen: FoundServo) -> None:
    """Bring the position of a servo into one turn; the shaft stays where it is."""
    answer = cast(Dynamixel2Link, seen.wire.link).clear_turns(seen.id)
    if answer is None or (refusal := seen.wire.link.refusal(answer)):
        raise ServoError(f"id {seen.id} does not clear its turns: {refusal if answer else 'no answer'}")


def _fast_read_works(wire: Wire, members: Sequence[ServoState]) -> bool | None:
    """Try a fast read on the servos themselves, which is surer than a table of firmware numbers."""
    if wire.family != "dynamixel2" or not members:
        return None
    field = members[0].seen.registers().role("present_position")
    if field is None:
        return None
    alike = [state.seen.id for state in members if state.seen.registers().role(field.name) == field]
    where = field.address, field.size
    return any(set(wire.link.read_many(*where, alike, fast=True)) == set(alike) for _ in range(2))


def _budget(line: Line, baud: int, members: Sequence[ServoState], adapter: SerialDevice) -> Budget | None:
    if not members:
        return None
    table = members[0].seen.registers()
    goal = table.role("goal_position")
    return wire_budget(
        line.family,
        max(len(line.wanted), len(members)),
        baud,
        return_delay_us=max(state.in_unit("return_delay") or 0.0 for state in members),
        latency_ms=0.0 if line.is_terminal else _USB_MS if adapter.latency_ms is None else adapter.latency_ms,
        read_bytes=table.span([field.name for role in _READ if (field := table.role(role)) is not None])[1],
        write_bytes=goal.size if goal else 2,
        together=table.byte_order == "little",
    )


def _servo_row(state: ServoState, line: Line) -> Row:
    want = line.wanted.get(state.seen.id)
    measured = state.measured(1, voltage_V="voltage", temperature_degC="temperature", return_delay_us="return_delay")
    row = {key: value for key, value in state.seen.row().items() if key != "family"}  # the bus has it
    return {**row, "joint": want and want.joint, **measured, **state.health()}


# --- a board of hobby servos ----------------------------------------------------------------------------------------


def _look_at_board(line: Line, port: Port, adapter: SerialDevice) -> tuple[list[Finding], Report]:
    """Return what can be said of a board, whose port could be opened."""
    channels = max(1, len(line.wanted))
    budget = wire_budget(line.family, channels, line.first_baud, crc=line.crc)
    table = Table.of(load_firmware_map(next(iter(line.wanted.values())).model))
    wire = RateLimitedPort(port, line.first_baud, _BOARD_S)
    problem = board_problem(table, board_for(table, line.crc), wire)
    found = judge_board(line.family, len(line.wanted), problem, adapter)
    findings = [*found, *judge_rate(budget, line)]
    facts = {"baud": line.first_baud, "rate_hz": line.rate_hz, "fast_sync_read": None, "budget": budget}
    return findings, facts
