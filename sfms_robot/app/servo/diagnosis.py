"""Problems of a port, a servo or a bus, and commands that solve them: facts in, findings out. Opens nothing.

Three severities: an `error` stops the head from running, a `warning` makes it run worse or not for long, a `note` is
good to know or is corrected by the run itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from itertools import chain
from shlex import quote
from typing import Final, Literal, cast

from sfms_robot.app.options import SIM
from sfms_robot.app.servo.serial_line import FoundServo
from sfms_robot.app.servo.single_servo import ServoState
from sfms_robot.config import Faults
from sfms_robot.config.firmware import user_maps
from sfms_robot.config.wire_time import BITS, FRAMINGS, Way
from sfms_robot.data import Report
from sfms_robot.servo.discovery import Holder, SerialDevice, is_address
from sfms_robot.servo.families import servo_families
from sfms_robot.servo.policy import counts
from sfms_robot.servo.registers import Table, consecutive
from sfms_robot.servo.stored_settings import Contradiction, JointNeeds, contradictions, limit_names

Severity = Literal["error", "warning", "note"]

SEVERITIES: Final = ("error", "warning", "note")
DEFAULT_RATE_HZ: Final = 100.0
FAST_ENOUGH_MS: Final = 1
_ROUND: Final = 0.95  # share of its rate from which a bus counts as reaching it
_POLOLU: Final = "1ffb"
_BOARD_HELP: Final = {
    "maestro": "use the first of its two USB ports (command port) with serial mode USB Dual Port or USB Chained, or "
    "its RX and TX with serial mode UART at the baud of the head's file; Pololu's Maestro Control Center sets the "
    "mode, and Enable CRC, which has to be what `crc` of the bus says",
    "ssc32": "set the board's baud jumpers to the baud of the head's file; an SSC-32U leaves the factory at 9600",
}
_HOT_C: Final = 10  # a servo this close to its limit is about to switch off


@dataclass(frozen=True)
class Finding:
    """A finding about a port, a bus or a servo.

    Attributes:
        about: Name of the port, bus or servo, for people.
        fix: Command to type or action to take, empty if there is none; `{id}` stands for the servo's id.
        servo: Id of the servo, if the finding is about one servo.
    """

    severity: Severity
    about: str
    problem: str
    fix: str = ""
    _: KW_ONLY
    servo: int | None = None

    def plain(self) -> Report:
        """Return the finding as plain data for a report."""
        return {key: value for key, value in asdict(self).items() if key != "servo"}


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """One servo as the head's file describes it.

    Attributes:
        model_number: None if it cannot be checked.
        faults: The faults to which the head reacts.
        needs: The stored values that its joint requires.
    """

    joint: str
    model: str
    model_number: int | None
    faults: Faults = field(default_factory=Faults)
    needs: JointNeeds | None = None

    def lives_with(self, fault: str, state: ServoState) -> bool:
        """Return whether the head's file ignores this fault."""
        measured = {"input voltage": state.in_unit("voltage"), "overheating": state.in_unit("temperature")}
        return not counts(fault, self.faults, measured)


@dataclass(frozen=True, kw_only=True)
class Line:
    """One port to examine, and the servos that are expected on it.

    Attributes:
        shown: Its name in commands.
        ports: The ports of the whole head, as `--port` named them.
    """

    device: str
    shown: str
    family: str
    baud: int | None = None
    rate_hz: float = DEFAULT_RATE_HZ
    wanted: dict[int, Wanted] = field(default_factory=dict)
    bus: str | None = None
    head: str | None = None
    ports: str | None = None
    crc: bool = False

    @property
    def first_baud(self) -> int:
        return self.baud or servo_families()[self.family].bauds[0]

    @property
    def is_terminal(self) -> bool:
        """True for a pseudo terminal of an emulator, which also has the port open and has no adapter."""
        return os.path.realpath(self.device).startswith("/dev/pts/")

    @property
    def fix(self) -> str:
        """The command that corrects stored values as the head's file requires."""
        return f"sfms-robot doctor --port {quote(self.ports or self.shown)}{self._of_head or self._of_family} --fix"

    def servo(self, words: str, baud: int | None = None) -> str:
        """Return a `servo` command for this port."""
        rate = f" --baud {baud}" if baud is not None else ""
        # The head determines which emulated servos there are, and their rate.
        which = self._of_head if self.shown == SIM and self.head else f"{rate}{self._of_family}"
        return f"sfms-robot servo {words} --port {quote(self.shown)}{which}"

    def name(self, servo: int) -> str:
        """Return the name of a servo with its joint, for people."""
        return f"id {servo} ({self.wanted[servo].joint})" if servo in self.wanted else f"id {servo}"

    @property
    def _of_head(self) -> str:
        return f" --head {quote(self.head)}" if self.head else ""

    @property
    def _of_family(self) -> str:
        return "" if self.family == "dynamixel2" else f" --family {self.family}"


# --- the port ---------------------------------------------------------------------------------------------------


def judge_port(path: str, problem: str, group: str, ports: Sequence[SerialDevice]) -> Finding:
    """Return the problem of a path that cannot be opened as a port, with its fix."""
    there = ", ".join(each.by_id or each.path for each in ports)
    fix = f"use one of: {there}" if there else "plug the adapter in; `dmesg | tail` says whether it was recognised"
    if is_address(path):
        fix = "correct --port"
    elif "permission" in problem:
        fix = f"sudo usermod -aG {group} $USER, then log out and in again"
    return Finding("error", path, problem, fix)


def judge_opening(path: str, failure: str, held_by: Sequence[Holder]) -> Iterator[Finding]:
    """Yield the problems of a port whose opening failed."""
    problem = failure.removeprefix(f"{path}: ")
    if is_address(path):
        yield Finding("error", path, problem, "check the address, and that its server runs")
    elif not held_by:
        yield Finding("error", path, problem, f"see who has it open: sudo fuser -v {path}")
    yield from _holders("error", path, held_by, "")


def _holders(severity: Severity, path: str, held_by: Sequence[Holder], too: str) -> Iterator[Finding]:
    for holder in held_by:
        yield Finding(severity, path, f"is open in process {holder.pid} ({holder.command}){too}", f"kill {holder.pid}")


def judge_adapter(device: SerialDevice, held_by: Sequence[Holder]) -> Iterator[Finding]:
    """Yield the problems of an open port: other programs that use it, and an adapter that delays answers."""
    yield from _holders("warning", device.path, held_by, " too")
    if device.latency_ms is not None and device.latency_ms > FAST_ENOUGH_MS:
        fix = f"echo 1 | sudo tee {device.latency_file}  (until it is unplugged; for good: the udev rule below)"
        yield Finding("warning", device.path, f"the adapter holds every answer back for {device.latency_ms} ms", fix)


def udev_rule(device: SerialDevice) -> str | None:
    """Return the lines of a permanent udev rule: the latency timer, and a name for this adapter.

    None for a port that is not a USB adapter. An adapter without a serial number is named by its USB socket, since two
    adapters of one kind would share a name; `ID_PATH_TAG` is set by 60-serial.rules of systemd, which come before 99.
    """
    if device.vendor is None or device.product is None:
        return None
    which = f'ATTRS{{idVendor}}=="{device.vendor}", ATTRS{{idProduct}}=="{device.product}"'
    if device.serial:
        which += f', ATTRS{{serial}}=="{device.serial}"'
    lines = [f'SUBSYSTEM=="tty", {which}, SYMLINK+="servos-{device.serial or "$env{ID_PATH_TAG}"}"']
    if device.latency_file is not None:
        timer = f'ATTR{{latency_timer}}="{FAST_ENOUGH_MS}"'
        lines.insert(0, f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="{device.driver}", {timer}')
    return "\n".join(lines)


# --- which servos answer ----------------------------------------------------------------------------------------


def judge_presence(line: Line, found: Iterable[FoundServo], baud: int, hint: str = "") -> Iterator[Finding]:
    """Yield ids of the head that are silent, at another rate, or of another model; and ids that the head does not name.

    Args:
        found: Servos that answer, at any rate.
        baud: The head's rate.
        hint: The protocol to which servos answer instead.
    """
    by_id = {seen.id: seen for seen in found}
    if line.wanted and not by_id:
        problem = f"no answer at any rate: none of {len(line.wanted)} servos{f'; {hint}' if hint else ''}"
        yield Finding("error", "bus", problem, "check power, cable, data direction of the adapter, and --port")
        return
    for servo, want in line.wanted.items():
        if (seen := by_id.get(servo)) is None:
            problem = "no answer, at any rate"
            look = f"{line.servo('scan')}, then {line.servo('set-id OLD NEW')}"
            fix = f"check its cable; if it has another id: {look}"
        elif seen.baud != baud:
            problem = f"set to {seen.baud} baud, the head says {baud}"
            fix = line.servo(f"set-baud {{id}} {baud}", seen.baud)
        elif want.model_number is not None and seen.model_number not in (None, want.model_number):
            said = f"the head says {want.model} ({want.model_number})"
            number = f" ({seen.model_number})" if seen.table is not None else ""  # else the model's name contains it
            problem = f"{seen.model}{number} answers, {said}"
            fix = "two cables swapped, or the head's file names the wrong model or id"
        else:
            continue
        yield Finding("error", line.name(servo), problem, fix, servo=servo)
    for servo, seen in sorted(by_id.items()):
        if line.wanted and servo not in line.wanted:
            problem = f"{seen.model} at {seen.baud} baud is not in the head's file"
            yield Finding("warning", line.name(servo), problem, servo=servo)


def duplicate_id(servo: int, line: Line) -> Finding:
    """Return the problem of an id to which two servos seem to answer."""
    problem = "two servos seem to answer to this id (or the wire is disturbed)"
    fix = f"unplug all but one of them, then: {line.servo(f'set-id {servo} NEW')}"
    return Finding("error", f"id {servo}", problem, fix, servo=servo)


# --- one servo --------------------------------------------------------------------------------------------------

Judged = Iterator[tuple[Severity, str, str]]  # severity, problem, fix


def judge_servo(state: ServoState, line: Line) -> Iterator[Finding]:
    """Yield the problems of settings and health of a servo whose registers were read."""
    seen, want = state.seen, line.wanted.get(state.seen.id)
    fix = (
        f"copy the map of its nearest relative in firmware_maps/ to {user_maps()}, name file and model as the servo is "
        f"called, and set model_number: {seen.model_number} and the registers of its manual"
    )
    judged: Judged = iter([("error" if want else "warning", f"model {seen.model} has no firmware map", fix)])
    if seen.table is not None:
        judged = chain(_health(state, seen.table, want, line), _stored(state, seen.table, want, line))
    for severity, problem, fix in judged:
        yield Finding(severity, line.name(seen.id), problem, fix, servo=seen.id)


def _health(state: ServoState, table: Table, want: Wanted | None, line: Line) -> Judged:
    """Yield the problems of a servo's firmware, faults, supply and temperature."""
    seen, (first, last) = state.seen, table.firmware
    if seen.firmware and not first <= seen.firmware <= last and table.family == "dynamixel":
        problem = f"firmware {seen.firmware} has no map of its own, that of {first}..{last} is used"
        yield "warning", problem, "update it with ROBOTIS' DYNAMIXEL Wizard"
    if seen.firmware is not None and table.watchdog == "flags_only":
        why = "its bus watchdog does not stop the motor if the computer dies"
        yield "note", f"firmware {seen.firmware} of {seen.model}: {why}", ""
    names = [name for name in state.faults().split(", ") if name]
    masked = [name for name in names if want and want.lives_with(name, state)]
    if masked:
        yield "note", f"{', '.join(masked)}: the head's file says to live with it", ""
    if named := ", ".join(name for name in names if name not in masked):
        power = "remove the cause, then switch its supply off and on"
        yield (
            "error",
            f"hardware error: {named}",
            line.servo("reboot {id}", seen.baud) if table.protocol == 2 else power,
        )
    volt, low, high = (state.in_unit(name) for name in ("voltage", "min_voltage_limit", "max_voltage_limit"))
    tolerated = want is not None and want.lives_with("input voltage", state)
    if volt is not None and low is not None and high is not None and not (low <= volt <= high or tolerated):
        fix = "measure the supply under load" if volt < low else "lower the supply before the servo is damaged"
        yield "warning", f"supply {volt:.1f} V is outside its limits {low:.1f}..{high:.1f} V", fix
    warm, limit = state.in_unit("temperature"), state.in_unit("temperature_limit")
    if warm is not None and limit is not None and warm > limit - _HOT_C:
        yield "warning", f"{warm:.0f} degC, it switches off at {limit:.0f}", "let it cool down"


def _stored(state: ServoState, table: Table, want: Wanted | None, line: Line) -> Judged:
    """Yield settings that slow a bus down, and stored values that contradict the needs of the joint.

    Without a head, the values are compared with one another.
    """
    seen, severities = state.seen, {"refused": "error", "set": "note", "told": "warning"}
    delay, level = table.role("return_delay"), table.role("status_level")
    if delay is not None and (waits := state.in_unit("return_delay")):
        fix = line.servo(f"write {{id}} {delay.name} 0", seen.baud)
        yield "note", f"return delay of {waits:.0f} us before every answer (a run sets it to 0)", fix
    if level is not None and (now := state.value("status_level")) is not None and now < 1:
        fix = line.servo(f"write {{id}} {level.name} {level.high}", seen.baud)
        yield "warning", f"status return level {now}: answers pings only", fix
    if state.torque():
        yield "note", "torque is on", ""
    for each in stored_contradictions(state, want):
        severity, fix = cast(Severity, severities[each.then]), ""
        if each.in_file and want is None:  # there is no head's file to contradict
            severity = "warning"
        elif each.fixable and not each.in_file and seen.registers()[each.register].writable:
            fix = line.servo(f"write {{id}} {each.register} {each.wanted}", seen.baud)
            if state.torque():
                severity = "error" if each.then == "set" else severity
                fix = f"{line.servo('write {id} torque_enable 0', seen.baud)}, then {fix}"
        elif each.fixable:
            fix = line.fix
        yield severity, str(each), fix


def stored_contradictions(state: ServoState, want: Wanted | None) -> list[Contradiction]:
    """Return the contradictions that startup would find."""
    table = state.seen.table
    if table is None or not state.values:
        return []
    if want is not None and want.needs is not None:
        needs = want.needs
    else:  # a servo that is not a joint of a head has to stay within its own limits
        low, high = (state.values.get(name, table.center_ticks) for name in limit_names(table) or ("", ""))
        needs = JointNeeds(*((low, high) if low < high else (table.center_ticks, table.center_ticks)))
    return contradictions(state.values, table, needs)


# --- the bus ----------------------------------------------------------------------------------------------------


def wire_budget(
    family: str,
    servos: int,
    baud: int,
    return_delay_us: float = 0.0,
    latency_ms: float = 0.0,
    read_bytes: int = 0,
    write_bytes: int | None = None,
    *,
    together: bool = True,
    crc: bool = False,
) -> Report:
    """Return the budget of a bus: bytes, ms and Hz of a tick that writes goals, and of one that also reads all servos.

    `plain` has one sync read, or one read after the other if the family has no sync read; it is None for a board.
    `fast` has one fast sync read; it is None if the servos do not support that.

        tick = 10 bits x bytes / baud + return delay of every answer + latency of the adapter of every request answered

    Servos that cannot be read together are read one by one, and each request costs the adapter's latency again. This
    makes factory settings slow.

    Args:
        servos: Number of servos; for a board the number of channels, all of which are written in every tick.
        return_delay_us: The pause of a servo before it answers.
        latency_ms: Time for which the adapter holds bytes back from the host.
        read_bytes, write_bytes: Data per servo and tick; by default no reads, and a goal of the family.
        together: False if the servos cannot answer one sync read.
        crc: Add one byte for every channel of a board.
    """
    framing = FRAMINGS[family]
    goals = framing.goals(servos, write_bytes) + crc * servos
    way: Way = "together" if together and family != "dynamixel1" else "one by one"  # AX cannot be read together

    def tick(size: int, answers: int = 0, waits: int = 0) -> dict[str, float]:
        ms = size * 1e3 * BITS / baud + answers * return_delay_us / 1e3 + waits * latency_ms
        return {"bytes": size, "ms": round(ms, 3), "hz": round(1e3 / ms, 1)}

    reads = goals + framing.reads(servos, read_bytes, way)
    return {
        "servos": servos,
        "baud": baud,
        "return_delay_us": return_delay_us,
        "latency_ms": latency_ms,
        "write_bytes_per_servo": write_bytes or (framing.goal if framing.read else goals // servos),
        "read_bytes_per_servo": read_bytes,
        "write_only": tick(goals),
        "plain": tick(reads, servos, 1 if way == "together" else servos) if framing.read else None,
        "fast": tick(goals + framing.reads(servos, read_bytes, "fast"), 1, 1) if together and framing.fast else None,
    }


def judge_rate(budget: Report, line: Line, fast_works: bool | None = None) -> Iterator[Finding]:
    """Yield a finding if the goals and answers of all servos do not fit into a tick."""
    usual, least_hz = budget["plain"] or budget["write_only"], _ROUND * line.rate_hz
    if usual["hz"] >= least_hz:
        return
    reached = f"{usual['hz']:.0f} Hz of {line.rate_hz:g}"
    if fast_works and budget["fast"] and budget["fast"]["hz"] >= least_hz:
        yield Finding(
            "note", "bus", f"each servo read: {reached}; all in one answer, as a run does: {budget['fast']['hz']:.0f}"
        )
        return
    slow, _, fix = max(
        (
            "return delay",
            budget["servos"] * budget["return_delay_us"] / 1e3,
            "set every return delay to 0 (see the notes)",
        ),
        ("adapter latency", budget["latency_ms"], "set the adapter's latency timer to 1 ms (see above)"),
        (
            "baud",
            usual["bytes"] * 10e3 / budget["baud"],
            f"set servos and head file to a higher rate than {budget['baud']} baud: "
            f"{line.servo('set-baud ID RATE', budget['baud'])}; or lower rate_hz in the head's file",
        ),
        key=lambda cause: cause[1],
    )
    done = "every servo read"
    if budget["plain"] is None:
        done, fix = (
            "every channel written",
            "lower rate_hz in the head's file, or set board and head file to a higher baud",
        )
    yield Finding("warning", "bus", f"reaches {reached} with {done} ({slow} takes most)", fix)


def judge_board(family: str, channels: int, problem: str | None, device: SerialDevice) -> Iterator[Finding]:
    """Yield the findings about a bus of hobby servos. `problem`: of the board on its port (`board_problem`)."""
    if problem is not None:
        yield Finding("error", "bus", problem, _BOARD_HELP[family])
    elif device.vendor == _POLOLU and device.path.startswith("/dev/ttyACM"):
        yield Finding("note", "bus", "a Maestro on USB has two ports: the first takes commands, the second is its TTL")
    unknown = f"which of its {channels} servos are there, nor where they stand"
    yield Finding("note", "bus", f"a {family} board does not report {unknown}")


# --- all together -----------------------------------------------------------------------------------------------


def grouped(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings, worst first. The same problem of several servos becomes one finding with one command."""
    same: dict[object, list[Finding]] = {}
    for finding in findings:
        alike = (finding.severity, finding.problem, finding.fix) if finding.servo is not None else id(finding)
        same.setdefault(alike, []).append(finding)
    out = []
    for group in same.values():
        first, ids = group[0], ids_text([each.servo for each in group if each.servo is not None])
        about = first.about if len(group) == 1 else f"ids {ids}"
        out.append(replace(first, about=about, fix=first.fix.replace("{id}", ids)))
    return sorted(out, key=lambda each: SEVERITIES.index(each.severity))


def ids_text(ids: Sequence[int]) -> str:
    """Return ids as the servo commands accept them: `1,5-9`."""
    return ",".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in consecutive(ids))
