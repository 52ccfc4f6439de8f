"""`sfms-robot doctor`: look at a port, its adapter and every servo on it, and say what to do. Reads only, but to fix.

Without a head it tells who is there, at every rate. With a head it also tells who is missing, at another rate, of
another model or not in the file, and whether the bus reaches the head's rate.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, cast

from sfms_robot.app.servo.budget import Budget, board_budget, wire_budget
from sfms_robot.app.servo.diagnosis import (
    Command,
    Finding,
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
    summary,
    udev_rule,
)
from sfms_robot.app.servo.protocol_hint import protocol_hint
from sfms_robot.app.servo.register_view import State, read_all
from sfms_robot.app.servo.serial_line import SIM, FoundServo, Wire, check_baud, only_port, table_of
from sfms_robot.app.servo.single_servo import Confirm, Progress, field_named, guard, has_duplicate, put, scan
from sfms_robot.config import Head, load_firmware_map, load_head
from sfms_robot.config.overlay import head_hash, layered, load_overlay, record_stored
from sfms_robot.emulator.launch import launch
from sfms_robot.errors import BusError, ConfigError, PacketError, PortError, ServoError
from sfms_robot.ports import Clock
from sfms_robot.servo.boards import RateLimitedPort
from sfms_robot.servo.chain.protocol2 import Dynamixel2Link
from sfms_robot.servo.codecs import maestro, ssc32
from sfms_robot.servo.discovery import SerialDevice, access_problem, describe, group_of, holders, list_ports
from sfms_robot.servo.families import family_named, servo_families
from sfms_robot.servo.port import Port, SerialPort
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import JointNeeds

FINE, PORT_FAILED, BUS_FAILED = 0, PortError.exit_code, ServoError.exit_code
DEFAULT_RATE_HZ: Final = 100.0
DEFAULT_HEAD: Final = "face28"  # whose servos are emulated
DEFAULT_FAMILY: Final = "dynamixel2"
_USB_MS: Final = 1.0  # an adapter without a latency timer of its own still waits for the next USB frame
_NOTHING_SEEN: Final[dict[str, Any]] = {
    "adapter": None, "udev_rule": None, "servos": [], "budget": None, "fixed": [],
}  # fmt: skip
_BOARD_S: Final = 0.2  # a board answers at once; 9600 baud and a USB adapter take the rest
_READ: Final = ("present_position", "present_speed", "present_load", "present_current")

OpenPort = Callable[[str, int], Port]


@dataclass(frozen=True)
class Line:
    """One port to look at, and what is expected on it. `ports`: as `--port` named those of the whole head."""

    bus: str | None
    device: str
    shown: str
    family: str
    baud: int | None
    rate_hz: float
    wanted: dict[int, Wanted]
    head: str | None = None
    ports: str | None = None
    crc: bool = False


def examine(
    port: str | None,
    head: str | None,
    family: str | None,
    baud: int | None,
    clock: Clock,
    progress: Progress | None = None,
    fix: Confirm | None = None,
) -> dict[str, Any]:
    """Every bus of a head, or one port; the report, whose `exit_code` is that of the command.

    `family` (None: dynamixel2) and `baud` (None: every rate) are of a port alone: a head's file says both of each bus.
    `fix` is asked before each stored value that can be mended without harm is; None mends nothing.

    Raises ConfigError for a head, a family or a port description that cannot be used.
    """
    if head is None and port == SIM:
        head = DEFAULT_HEAD
    for key, value in (("--family", family), ("--baud", baud)):
        if head is not None and value is not None:
            raise ConfigError(f"{key} {value}: head {head!r} says that of each of its buses; leave out one of the two")
    family = DEFAULT_FAMILY if family is None else family
    if family not in servo_families():
        raise ConfigError.at("doctor", "family", family, "is unknown", servo_families())
    check_baud(family, baud)
    with ExitStack() as stack:
        lines = list(_lines(port, head, family, baud, stack))
        buses = [examine_line(line, clock, lambda d, b: SerialPort(d, b, clock), progress, fix) for line in lines]
    return {
        "version": 1,
        "head": head,
        "port": port or lines[0].device,
        "buses": buses,
        "findings": sum((each["findings"] for each in buses), []),
        "exit_code": next(
            (code for code in (PORT_FAILED, BUS_FAILED) if code in {b["exit_code"] for b in buses}), FINE
        ),
    }


def examine_line(
    line: Line, clock: Clock, open_port: OpenPort, progress: Progress | None = None, fix: Confirm | None = None
) -> dict[str, Any]:
    """One port: report with `adapter`, `servos`, `budget`, `fixed`, `findings`, `exit_code`."""
    path = line.device
    problem = access_problem(path)
    report: dict[str, Any] = {"bus": line.bus, "port": line.shown, "device": path, "family": line.family}
    findings = list(judge_port(path, problem, group_of(path), list_ports()))
    if problem is None:
        held_by = [] if _is_terminal(path) else holders(path)
        try:
            port = open_port(path, _first_baud(line))
        except PortError as error:
            findings += judge_opening(path, str(error), held_by)
        else:
            try:
                adapter = describe(path)  # after opening, which may have set the latency
                findings += judge_adapter(adapter, held_by)
                if family_named(line.family).board:
                    found, facts = _look_at_board(line, port, adapter)
                else:
                    found, facts = _look(line, port, clock, adapter, progress, fix)
            except (BusError, PacketError, ServoError) as error:
                findings.append(Finding("error", path, str(error).removeprefix(f"{path}: "), "check plug and cable"))
                return _finished({**report, **_NOTHING_SEEN, "adapter": asdict(adapter)}, findings)
            finally:
                port.close()
            facts |= {"adapter": asdict(adapter), "udev_rule": udev_rule(adapter)}
            return _finished({**report, **facts}, [*findings, *found])
    return _finished({**report, **_NOTHING_SEEN}, findings, PORT_FAILED)


def _is_terminal(path: str) -> bool:
    """A pseudo terminal, behind which an emulator sits: it has the port open too, and no adapter."""
    return os.path.realpath(path).startswith("/dev/pts/")


def _lines(port: str | None, head: str | None, family: str, baud: int | None, stack: ExitStack) -> Iterator[Line]:
    if head is None:
        device = port or only_port()
        yield Line(None, device, device, family, baud, DEFAULT_RATE_HZ, {})
        return
    from sfms_robot.app.wiring import devices, plugged_in  # slow to load, and only a head needs it

    described = load_head(head)
    if port == SIM:
        where = {
            name: stack.enter_context(launch(servos)).device for name, servos in plugged_in(head, described).items()
        }
    else:
        where = devices(described, port or only_port())
        described = layered(described, load_overlay(described), head_hash(head)).head  # as it was measured
    for name, device in where.items():
        bus = described.buses[name]
        shown = SIM if port == SIM else device
        want = _wanted(described, name)
        yield Line(name, device, shown, bus.family, bus.baud, bus.rate_hz, want, head=head, ports=port, crc=bus.crc)


def _wanted(head: Head, bus: str) -> dict[int, Wanted]:
    masked = frozenset(head.faults.mask)
    thresholds = {name: (each.min, each.max) for name, each in head.faults.thresholds.items()}
    joints = {name: joint for name, joint in head.joints.items() if joint.bus == bus}
    maps = {model: load_firmware_map(model) for model in {joint.model for joint in joints.values()}}
    from sfms_robot.app.wiring import calibration_of

    ranges = calibration_of(joints)
    ids = frozenset(joint.id for joint in joints.values())
    found = {}
    for name, low, high in zip(joints, ranges.low_ticks, ranges.high_ticks, strict=True):
        joint = joints[name]
        bounded = head.safety_of(name).current_limit_mA is not None
        needs = JointNeeds(
            int(low),
            int(high),
            stored=head.safety_of(name).stored,
            other_ids=ids - {joint.id},
            bounded_current=bounded,
        )
        found[joint.id] = Wanted(name, joint.model, maps[joint.model].model_number, masked, thresholds, needs)
    return found


def _look(
    line: Line, port: Port, clock: Clock, adapter: SerialDevice, progress: Progress | None, fix: Confirm | None
) -> tuple[list[Finding], dict[str, Any]]:
    """Return findings and facts that need the open port."""
    command = Command(line.shown, line.family, line.head, line.ports)
    wire = Wire(port, line.family, clock, _first_baud(line))
    here, elsewhere = (
        {servo: _as_wanted(seen, line) for servo, seen in found.items()} for found in _who(wire, line, progress)
    )
    baud = line.baud or next(iter(seen.baud for seen in here.values()), wire.baud)
    hint = "" if here or elsewhere else protocol_hint(wire)
    findings = list(judge_presence(line.wanted, here, elsewhere, baud, command, hint))
    fixed: list[str] = []
    states: list[State] = []
    double: list[int] = []
    for done, seen in enumerate([*here.values(), *elsewhere.values()]):
        if progress:
            progress(done, len(here) + len(elsewhere), f"id {seen.id}")
        wire.at(seen.baud)
        double += [seen.id] if has_duplicate(wire, seen.id) else []
        try:
            state = read_all(wire, seen)
            if fix is not None and (done_here := _fix(wire, state, line, fix)):
                fixed += done_here
                state = read_all(wire, seen)
            states.append(state)
        except ServoError as error:
            findings.append(Finding("error", f"id {seen.id}", str(error), _speak_again(seen, command), seen.id))
    findings += judge_duplicate_ids(double)
    for state in states:
        findings += judge_servo(state, line.wanted.get(state.seen.id), command)
    members = [state for state in states if state.seen.id in here and state.seen.table is not None]
    wire.at(baud)
    fast = _fast_read_works(wire, members)
    budget = _budget(line, baud, members, adapter)
    if budget is not None:
        findings += judge_rate(budget, line.rate_hz, fast, command)
    facts = {
        "baud": baud,
        "rate_hz": line.rate_hz,
        "servos": [_servo_row(state, line) for state in states],
        "fixed": fixed,
        "fast_sync_read": fast,
        "budget": budget and budget.plain_data(),
    }
    return findings, facts


def _fix(wire: Wire, state: State, line: Line, confirm: Confirm) -> list[str]:
    """Write what can be mended without harm, each confirmed and verified; return what was done.

    What zero and direction depend on goes into the head's file, never into the servo. Raises ConfigError for a file
    that cannot be written, ServoError for a servo that has torque on, or does not take a value.
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
        guard(wire, seen, change, lambda question: True)
        field = field_named(seen.registers(), each.register)
        if field.writable:
            put(wire, seen, field, each.wanted)
        else:
            _clear_turns(wire, seen)
        done.append(f"id {seen.id}: {change}")
    return done


def _clear_turns(wire: Wire, seen: FoundServo) -> None:
    """Forget whole turns; the shaft stays where it is."""
    answer = cast(Dynamixel2Link, wire.link).clear_turns(seen.id)
    if answer is None or (refusal := wire.link.refusal(answer)):
        raise ServoError(f"id {seen.id} does not forget its turns: {refusal if answer else 'no answer'}")


def _board_answers(line: Line, port: Port) -> bool:
    """Return whether the board answers the one question that it has, and not before its CRC where the head has one."""
    wire = RateLimitedPort(port, _first_baud(line), _BOARD_S)
    question, size = ssc32.query_moving(), 1
    if line.family == "maestro":
        question, size = maestro.addressed(maestro.get_errors()), 2
    parts = [question, bytes([maestro.crc7(question)])] if line.crc else [question]
    answers = [wire.exchange(part, size) for part in parts]
    return answers.pop() is not None and not any(answers)


def _look_at_board(line: Line, port: Port, adapter: SerialDevice) -> tuple[list[Finding], dict[str, Any]]:
    """What can be said of a board of hobby servos, whose port could be opened."""
    budget = board_budget(line.family, max(1, len(line.wanted)), _first_baud(line), line.crc)
    command = Command(line.shown, line.family)
    answers = _board_answers(line, port)
    found = judge_board(line.family, len(line.wanted), answers, adapter)
    findings = [*found, *judge_rate(budget, line.rate_hz, None, command)]
    facts = {"baud": budget.baud, "rate_hz": line.rate_hz, "servos": [], "fixed": [], "fast_sync_read": None}
    return findings, {**facts, "budget": budget.plain_data()}


def _first_baud(line: Line) -> int:
    return line.baud or servo_families()[line.family].bauds[0]


def _who(wire: Wire, line: Line, progress: Progress | None) -> tuple[dict[int, FoundServo], dict[int, FoundServo]]:
    """(at the line's rate, at others), by id. With a head, other rates are looked at only for ids that are missing."""
    if line.baud is None and not line.wanted:
        found = scan(wire, None, progress)
        usual = max({each.baud for each in found}, key=lambda b: sum(s.baud == b for s in found), default=0)
        return {s.id: s for s in found if s.baud == usual}, {s.id: s for s in found if s.baud != usual}
    wanted = list(line.wanted)
    here = _at_this_rate(wire, wanted)
    elsewhere: dict[int, FoundServo] = {}
    for step, _ in enumerate(wire.reachable()):
        missing = [servo for servo in wanted if servo not in here and servo not in elsewhere]
        if not missing:
            break
        if step == 0:
            continue
        if progress:
            progress(step, len(wire.bauds), f"{len(missing)} missing, {wire.baud} baud")
        elsewhere |= {i: seen for i, seen in _at_this_rate(wire, missing).items() if i not in here}
    return here, elsewhere


def _as_wanted(seen: FoundServo, line: Line) -> FoundServo:
    """The head knows better than the number which map holds: some models have none of their own, or share one."""
    want = line.wanted.get(seen.id)
    if want is None or want.model_number not in (None, seen.model_number):
        return seen
    if want.model_number is None:
        return replace(seen, table=Table.of(load_firmware_map(want.model)))
    return replace(seen, table=table_of(line.family, seen.model_number, seen.firmware, want.model))


def _at_this_rate(wire: Wire, ids: Sequence[int]) -> dict[int, FoundServo]:
    """Who answers: to a question to everybody where there is one, and those of `ids` that are asked once more."""
    found: dict[int, FoundServo] = {}
    if wire.kind.broadcast:
        found = {servo: wire.identified(servo, each) for servo, each in sorted(wire.link.broadcast_ping().items())}
    if found or not wire.kind.broadcast:
        for servo in ids:
            if servo not in found and (seen := wire.ping(servo)) is not None:
                found[servo] = seen
    return found


def _speak_again(seen: FoundServo, command: Command) -> str:
    level = seen.table.role("status_level") if seen.table else None
    return command.servo(f"write {{id}} {level.name} {level.high}", seen.baud) if level else ""


def _fast_read_works(wire: Wire, members: Sequence[State]) -> bool | None:
    """Tried on the servos themselves, which know better than a table of firmware numbers."""
    if wire.family != "dynamixel2" or not members:
        return None
    field = _table(members[0]).role("present_position")
    alike = [state.seen.id for state in members if field is not None and _table(state).role(field.name) == field]
    if field is None:
        return None
    where = field.address, field.size
    return any(set(wire.link.read_many(*where, alike, fast=True)) == set(alike) for _ in range(2))


def _budget(line: Line, baud: int, members: Sequence[State], adapter: SerialDevice) -> Budget | None:
    if not members:
        return None
    table = _table(members[0])
    fields = [field for role in _READ if (field := table.role(role)) is not None]
    goal = table.role("goal_position")
    latency_ms = 0.0 if _is_terminal(line.device) else _USB_MS if adapter.latency_ms is None else adapter.latency_ms
    start = min(field.address for field in fields)
    return wire_budget(
        line.family,
        max(len(line.wanted), len(members)),
        baud,
        max(state.in_unit("return_delay") or 0.0 for state in members),
        latency_ms,
        read_bytes=max(field.address + field.size for field in fields) - start,
        write_bytes=goal.size if goal else 2,
        together=table.byte_order == "little",
    )


def _servo_row(state: State, line: Line) -> dict[str, Any]:
    want = line.wanted.get(state.seen.id)
    return {
        **state.seen.row(),
        "joint": want.joint if want else None,
        "voltage_V": _tenth(state.in_unit("voltage")),
        "temperature_degC": _tenth(state.in_unit("temperature")),
        "return_delay_us": _tenth(state.in_unit("return_delay")),
        "torque": None if (torque := state.value("torque_enable")) is None else bool(torque),
        "faults": state.faults(),
    }


def _finished(report: dict[str, Any], findings: Sequence[Finding], failed: int = BUS_FAILED) -> dict[str, Any]:
    together = grouped(findings)
    counts = summary(together)
    found = [each.plain() for each in together]
    return {**report, "findings": found, "counts": counts, "exit_code": failed if counts["error"] else FINE}


def _table(state: State) -> Table:
    return state.seen.registers()


def _tenth(value: float | None) -> float | None:
    return None if value is None else round(value, 1)
