"""What is wrong with a port, a servo or a bus, and what to type against it: facts in, findings out. Opens nothing.

Three severities: an `error` stops the head from running, a `warning` makes it run worse or not for long, a `note` is
good to know or is put right by the run itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from shlex import quote
from typing import Any, Final, Literal

from sfms_robot.app.servo.budget import Budget
from sfms_robot.app.servo.register_view import State
from sfms_robot.app.servo.serial_line import SIM, FoundServo
from sfms_robot.servo.discovery import Holder, SerialDevice, is_address
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import Contradiction, JointNeeds, contradictions, limit_names

Severity = Literal["error", "warning", "note"]

SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")
FAST_ENOUGH_MS: Final = 1
UDEV_FILE: Final = "/etc/udev/rules.d/99-servos.rules"
_ROUND: Final = 0.95  # a bus that reaches this share of its rate reaches it
_MEASURED: Final = {"input voltage": "voltage", "overheating": "temperature"}
_POLOLU: Final = "1ffb"
_BOARD_HELP: Final = {
    "maestro": "use the first of its two USB ports (command port) with serial mode USB Dual Port or USB Chained, or "
    "its RX and TX with serial mode UART at the baud of the head's file; Pololu's Maestro Control Center sets the "
    "mode, and Enable CRC, which has to be what `crc` of the bus says",
    "ssc32": "set the board's baud jumpers to the baud of the head's file; an SSC-32U leaves the factory at 9600",
}
_HOT_C: Final = 10  # this close to its limit a servo is about to switch off


@dataclass(frozen=True)
class Finding:
    """One thing found.

    Attributes:
        about: what it concerns, as a person would say it.
        fix: what to type or do, empty where there is nothing to do; `{id}` stands for the servo's id.
        servo: id, for what concerns one servo.
    """

    severity: Severity
    about: str
    problem: str
    fix: str = ""
    servo: int | None = None

    def plain(self) -> dict[str, Any]:
        return {"severity": self.severity, "about": self.about, "problem": self.problem, "fix": self.fix}


@dataclass(frozen=True)
class Wanted:
    """What the head says of one servo.

    Attributes:
        model_number: None where it cannot be checked.
        masked: faults that the head lives with.
        thresholds: fault -> (lowest, highest) reading with which the head lives with it; None is open.
        needs: what its joint needs the servo to have stored.
    """

    joint: str
    model: str
    model_number: int | None
    masked: frozenset[str] = frozenset()
    thresholds: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    needs: JointNeeds | None = None

    def lives_with(self, fault: str, state: State) -> bool:
        """Whether the head's file says that this fault does not count."""
        if fault in self.masked:
            return True
        reading = state.in_unit(_MEASURED.get(fault, ""))
        if fault not in self.thresholds or reading is None:
            return False
        low, high = self.thresholds[fault]
        return (low is None or reading >= low) and (high is None or reading <= high)


@dataclass(frozen=True)
class Command:
    """Commands that can be pasted. `port`: of one bus; `ports`: of the whole head, where it has several."""

    port: str
    family: str
    head: str | None = None
    ports: str | None = None

    @property
    def fix(self) -> str:
        """Return the command that mends what servos store against the head's file."""
        return f"sfms-robot doctor --port {self.ports or self.port}{self._of_head or self._of_family} --fix"

    def servo(self, words: str, baud: int | None = None) -> str:
        rate = f" --baud {baud}" if baud is not None else ""
        # Which emulated servos there are, and at what rate, is their head's to say.
        which = self._of_head if self.port == SIM and self.head else f"{rate}{self._of_family}"
        return f"sfms-robot servo {words} --port {self.port}{which}"

    @property
    def _of_head(self) -> str:
        return f" --head {quote(self.head)}" if self.head else ""

    @property
    def _of_family(self) -> str:
        return "" if self.family == "dynamixel2" else f" --family {self.family}"


# --- the port ---------------------------------------------------------------------------------------------------


def judge_port(path: str, problem: str | None, group: str, ports: Sequence[SerialDevice]) -> Iterator[Finding]:
    """Before opening: is it there, is it a port, may we."""
    if problem is None:
        return
    if is_address(path):
        yield Finding("error", path, problem, "correct --port")
        return
    if "permission" in problem:
        yield Finding("error", path, problem, f"sudo usermod -aG {group} $USER, then log out and in again")
        return
    there = ", ".join(each.by_id or each.path for each in ports)
    fix = f"use one of: {there}" if there else "plug the adapter in; `dmesg | tail` says whether it was recognised"
    yield Finding("error", path, problem, fix)


def judge_opening(path: str, failure: str, held_by: Sequence[Holder]) -> Iterator[Finding]:
    """It could not be opened."""
    problem = failure.removeprefix(f"{path}: ")
    if is_address(path):
        yield Finding("error", path, problem, "is the address right, and does whoever serves it run?")
    elif not held_by:
        yield Finding("error", path, problem, f"see who has it open: sudo fuser -v {path}")
    for holder in held_by:
        yield Finding("error", path, f"is open in process {holder.pid} ({holder.command})", f"kill {holder.pid}")


def judge_adapter(device: SerialDevice, held_by: Sequence[Holder]) -> Iterator[Finding]:
    """It is open: who else talks there, and how long it holds bytes back."""
    for holder in held_by:
        yield Finding(
            "warning", device.path, f"is open in process {holder.pid} ({holder.command}) too", f"kill {holder.pid}"
        )
    if device.latency_ms is not None and device.latency_ms > FAST_ENOUGH_MS:
        yield Finding(
            "warning",
            device.path,
            f"the adapter holds every answer back for {device.latency_ms} ms",
            f"echo 1 | sudo tee {device.latency_file}  (until it is unplugged; for good: the udev rule below)",
        )


def udev_rule(device: SerialDevice) -> str | None:
    """Lines for `UDEV_FILE` that outlive replugging: the latency timer, and a name of its own for this adapter.

    None for a port that is no USB adapter. An adapter without a serial number is told by the socket it is plugged
    into, since two of a kind would share a name.
    """
    if device.vendor is None or device.product is None:
        return None
    which = f'ATTRS{{idVendor}}=="{device.vendor}", ATTRS{{idProduct}}=="{device.product}"'
    if device.serial:
        which += f', ATTRS{{serial}}=="{device.serial}"'
        name = f"servos-{device.serial}"
    else:
        name = "servos-%k"
    lines = [f'SUBSYSTEM=="tty", {which}, SYMLINK+="{name}"']
    if device.latency_file is not None:
        timer = f'ATTR{{latency_timer}}="{FAST_ENOUGH_MS}"'
        lines.insert(0, f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="{device.driver}", {timer}')
    return "\n".join(lines)


# --- who is there -----------------------------------------------------------------------------------------------


def judge_presence(
    wanted: Mapping[int, Wanted],
    here: Mapping[int, FoundServo],
    elsewhere: Mapping[int, FoundServo],
    baud: int,
    command: Command,
    hint: str = "",
) -> Iterator[Finding]:
    """Ids that the head wants and are not there, at another rate, or somebody else; and ids it does not know.

    Args:
        here: who answers at the head's rate, by id.
        elsewhere: who answers at another one.
        hint: who answers to another protocol.
    """
    if wanted and not here and not elsewhere:
        yield Finding(
            "error",
            "bus",
            f"nobody answers, at any rate: none of {len(wanted)} servos{f'; {hint}' if hint else ''}",
            "check power, cable, data direction of the adapter, and --port",
        )
        return
    for servo, want in wanted.items():
        if servo in here:
            yield from _judge_model(here[servo], want, command)
        elif servo in elsewhere:
            rate = elsewhere[servo].baud
            fix = command.servo(f"set-baud {{id}} {baud}", rate)
            problem = f"set to {rate} baud, the head says {baud}"
            yield Finding("error", _name(servo, want), problem, fix, servo)
        else:
            look, change = command.servo("scan"), command.servo("set-id OLD NEW")
            fix = f"check its cable; if it has another id: {look}, then {change}"
            yield Finding("error", _name(servo, want), "no answer, at any rate", fix, servo)
    for servo, seen in sorted({**elsewhere, **here}.items()):
        if wanted and servo not in wanted:
            yield Finding(
                "warning", f"id {servo}", f"{seen.model} at {seen.baud} baud is not in the head's file", servo=servo
            )


def _judge_model(seen: FoundServo, want: Wanted, command: Command) -> Iterator[Finding]:
    if want.model_number is not None and seen.model_number not in (None, want.model_number):
        yield Finding(
            "error",
            _name(seen.id, want),
            f"{seen.model} ({seen.model_number}) answers, the head says {want.model} ({want.model_number})",
            "two cables swapped, or the head's file names the wrong model or id",
            seen.id,
        )


def judge_duplicate_ids(ids: Sequence[int]) -> Iterator[Finding]:
    """Ids to which two servos seem to answer."""
    for servo in ids:
        yield Finding(
            "error",
            f"id {servo}",
            "two servos seem to answer to this id (or the wire is disturbed)",
            f"unplug all but one of them, then: sfms-robot servo set-id {servo} NEW",
            servo,
        )


# --- one servo --------------------------------------------------------------------------------------------------


def judge_servo(state: State, want: Wanted | None, command: Command) -> Iterator[Finding]:
    """Settings and health of a servo whose registers were read."""
    seen = state.seen
    about = _name(seen.id, want)
    if seen.table is None:
        yield Finding("error" if want else "warning", about, f"model {seen.model} has no firmware map", servo=seen.id)
        return
    yield from _judge_firmware(state, about)
    yield from _judge_health(state, about, want, command)
    yield from _judge_settings(state, about, command)
    yield from judge_stored(state, want, command)


def _judge_firmware(state: State, about: str) -> Iterator[Finding]:
    seen, table = state.seen, state.seen.table
    if table is None or seen.firmware is None:
        return
    first, last = table.firmware
    if seen.firmware > 0 and not first <= seen.firmware <= last and table.family == "dynamixel":
        yield Finding(
            "warning", about, f"firmware {seen.firmware} has no map of its own, that of {first}..{last} is used",
            "update it with ROBOTIS' DYNAMIXEL Wizard", seen.id,
        )  # fmt: skip
    if table.watchdog == "flags_only":
        yield Finding(
            "note",
            about,
            f"firmware {seen.firmware} of {seen.model}: its bus watchdog does not stop the motor if the computer dies",
            servo=seen.id,
        )


def _judge_health(state: State, about: str, want: Wanted | None, command: Command) -> Iterator[Finding]:
    seen = state.seen
    names = [name for name in state.faults().split(", ") if name]
    masked = [name for name in names if want and want.lives_with(name, state)]
    named = ", ".join(name for name in names if name not in masked)
    if masked:
        yield Finding("note", about, f"{', '.join(masked)}: the head's file says to live with it", servo=seen.id)
    if named:
        fix = command.servo("reboot {id}", seen.baud)
        if state.seen.table is None or state.seen.table.protocol != 2:
            fix = "remove the cause, then switch its supply off and on"
        yield Finding("error", about, f"hardware error: {named}", fix, seen.id)
    volt, low, high = (state.in_unit(name) for name in ("voltage", "min_voltage_limit", "max_voltage_limit"))
    tolerated = want is not None and want.lives_with("input voltage", state)
    if volt is not None and low is not None and high is not None and not (low <= volt <= high or tolerated):
        yield Finding(
            "warning", about, f"supply {volt:.1f} V is outside its limits {low:.1f}..{high:.1f} V",
            "measure the supply under load" if volt < low else "lower the supply before the servo is damaged", seen.id,
        )  # fmt: skip
    warm, limit = state.in_unit("temperature"), state.in_unit("temperature_limit")
    if warm is not None and limit is not None and warm > limit - _HOT_C:
        yield Finding("warning", about, f"{warm:.0f} degC, it switches off at {limit:.0f}", "let it cool down", seen.id)


def _judge_settings(state: State, about: str, command: Command) -> Iterator[Finding]:
    seen, table = state.seen, state.seen.table
    assert table is not None
    delay, level = table.role("return_delay"), table.role("status_level")
    waits, torque = state.in_unit("return_delay"), state.value("torque_enable")
    if delay is not None and waits:
        fix = command.servo(f"write {{id}} {delay.name} 0", seen.baud)
        yield Finding(
            "note", about, f"return delay of {waits:.0f} us before every answer (a run sets it to 0)", fix, seen.id
        )
    if level is not None and (now := state.value("status_level")) is not None and now < 1:
        fix = command.servo(f"write {{id}} {level.name} {level.high}", seen.baud)
        yield Finding("warning", about, f"status return level {now}: answers pings only", fix, seen.id)
    if torque:
        yield Finding("note", about, "torque is on", servo=seen.id)


def judge_stored(state: State, want: Wanted | None, command: Command) -> Iterator[Finding]:
    """Yield a finding for each stored value that is not what its joint needs; without a head, against itself."""
    seen = state.seen
    about, torque = _name(seen.id, want), state.value("torque_enable")
    for each in stored_contradictions(state, want):
        severity: Severity = "error" if each.then == "refused" else "note" if each.then == "set" else "warning"
        fix = ""
        if each.in_file and want is None:  # no head's file that it could contradict
            severity = "warning"
        elif each.fixable and not each.in_file and seen.registers()[each.register].writable:
            fix = command.servo(f"write {{id}} {each.register} {each.wanted}", seen.baud)
            if torque:
                severity = "error" if each.then == "set" else severity
                fix = f"{command.servo('write {id} torque_enable 0', seen.baud)}, then {fix}"
        elif each.fixable:
            fix = command.fix
        yield Finding(severity, about, str(each), fix, seen.id)


def stored_contradictions(state: State, want: Wanted | None) -> list[Contradiction]:
    """As startup sees them, and with the faults that the head's file says to live with."""
    table = state.seen.table
    if table is None or not state.table:
        return []
    values = state.values()
    needs = want.needs if want is not None and want.needs is not None else _as_it_is(values, table)
    if want is not None:
        needs = replace(needs, allowed_faults=want.masked)
    return contradictions(values, table, needs)


def _as_it_is(values: Mapping[str, int], table: Table) -> JointNeeds:
    """What a servo that is no joint of a head needs: to stay within its own limits."""
    low, high = (values.get(name, table.center_ticks) for name in limit_names(table) or ("", ""))
    return JointNeeds(low, high) if low < high else JointNeeds(table.center_ticks, table.center_ticks)


# --- the bus ----------------------------------------------------------------------------------------------------


def judge_rate(budget: Budget, rate_hz: float, fast_works: bool | None, command: Command) -> Iterator[Finding]:
    """Whether goals and answers of all servos fit into a tick."""
    if budget.usual.hz >= _ROUND * rate_hz:
        return
    hertz = f"{budget.usual.hz:.0f} Hz"
    if budget.fast is not None and fast_works and budget.fast.hz >= _ROUND * rate_hz:
        yield Finding("note", "bus", f"plain reads reach {hertz} of {rate_hz:g}, fast sync read {budget.fast.hz:.0f}")
        return
    slow = max(
        ("return delay", budget.servos * budget.return_delay_us / 1e3),
        ("adapter latency", budget.latency_ms),
        ("baud", budget.usual.bytes * 10e3 / budget.baud),
        key=lambda cause: cause[1],
    )[0]
    fix = {
        "return delay": "set every return delay to 0 (see the notes)",
        "adapter latency": "set the adapter's latency timer to 1 ms (see above)",
        "baud": f"set servos and head file to a higher rate than {budget.baud} baud: "
        f"{command.servo('set-baud ID RATE', budget.baud)}; or lower rate_hz in the head's file",
    }[slow]
    if budget.plain is None:
        fix = "lower rate_hz in the head's file, or set board and head file to a higher baud"
    what = "every servo read" if budget.plain else "every channel written"
    yield Finding("warning", "bus", f"reaches {hertz} of {rate_hz:g} with {what} ({slow} takes most)", fix)


def judge_board(family: str, channels: int, answers: bool | None, device: SerialDevice) -> Iterator[Finding]:
    """A bus of hobby servos: there is little to ask. `answers`: whether the board did; None where it was not asked."""
    if answers is False:
        yield Finding("error", "bus", f"no {family} board answers", _BOARD_HELP[family])
    elif device.vendor == _POLOLU and device.path.startswith("/dev/ttyACM"):
        yield Finding("note", "bus", "a Maestro on USB has two ports: the first takes commands, the second is its TTL")
    yield Finding(
        "note", "bus", f"a {family} board does not tell which of its {channels} servos are there, nor where they stand"
    )


def grouped(findings: Sequence[Finding]) -> list[Finding]:
    """Worst first; what holds for several servos alike is one finding, and its fix one command."""
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
    """`1,5-9`, as the servo commands take it."""
    runs: list[list[int]] = []
    for servo in sorted(set(ids)):
        if runs and servo == runs[-1][-1] + 1:
            runs[-1].append(servo)
        else:
            runs.append([servo])
    return ",".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _name(servo: int, want: Wanted | None) -> str:
    return f"id {servo} ({want.joint})" if want else f"id {servo}"


def summary(findings: Sequence[Finding]) -> dict[str, Any]:
    """How many of each severity."""
    return {name: sum(each.severity == name for each in findings) for name in SEVERITIES}
