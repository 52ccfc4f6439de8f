"""Startup of the servos of a chain: identify, verify, prepare, enable.

    identify   find the servos that answer; each must be of the model in the head's file and of a known firmware
    verify     compare the stored values with the head's file (`stored_settings`): an error that names the value, or a
               warning if the value only weakens protection
    prepare    write and read back the mode, the profile, the torque limit and the registers of the head's file
    enable     goal := present, then torque: no jump. A servo that stands outside its own limits, as in a sagged head,
               cannot hold there: its own profile moves it inside, slowly

The same steps bring back a servo that was lost. They are generators (`Steps`): between two exchanges on the wire they
yield the seconds to wait. At startup they run to their end; while the bus is running, a tick makes a few of them in
addition to its own work.

A servo outside its own position limits is moved inside by these registers:

    family                    speed                      acceleration
    X, MX (2.0), velocity     profile velocity (112)     profile acceleration (108)
    X, MX (2.0), time         duration in ms (112)       ramp in ms (108), if drive mode bit 2 is set
    XL-320, AX                moving speed (32)          none
    MX (1.0)                  moving speed (32)          goal acceleration (73)
    STS                       goal speed (46)            acceleration (41)
    SCS                       goal speed (46)            none

Sources: ROBOTIS e-manual, "Drive Mode (10)" and "Profile Velocity (112)" of the X series, "Moving Speed (32)" of the AX
and MX series; Feetech STS memory table V3.6, SCS15 manual.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import ClassVar, Final, NamedTuple

from sfms_robot.config import Faults
from sfms_robot.errors import NOTE, BusError, ServoError
from sfms_robot.ports import TickConversion
from sfms_robot.servo.bus import tick_ranges
from sfms_robot.servo.chain.link import TRIES, Found, RegisterLink, Silent, Steps, finish, verified_write
from sfms_robot.servo.policy import BusServo, torque_limit
from sfms_robot.servo.registers import Field, Table, Values, span_of
from sfms_robot.servo.stored_settings import JointNeeds, contradictions, limit_names, limits_count, operating_mode

log = logging.getLogger(__name__)

PATIENCE_S: Final = 0.05  # an adapter may hold an answer back for 16 ms
LONGEST_READ: Final = 64
SPEED_DEG_S: Final = 20.0  # speed of the shaft of a servo that is moved inside its limits
INSIDE_DEG: Final = 1.0  # from the limit to the goal: load and friction stop a servo a little short of its goal
_RAMP_S: Final = 0.25  # time to reach `SPEED_DEG_S`
_SLACK_S: Final = 1.0  # added to twice the time that the way should take
_LOOK_S: Final = 0.05  # between two position reads of a servo that is moved inside its limits
_STILL_TICKS: Final = 1  # largest change between two reads of a servo at rest
_AT_REST: Final = ("torque_enable", "present_position", "error_status")  # the snapshot of 2.0 ends at the last of them
_BY_TIME: Final = 0x04  # drive mode bit 2: the profile registers are durations


class WayInside(NamedTuple):
    """The way of a servo inside its limits: goal, distance, and the time by which it must have arrived."""

    goal_ticks: int
    distance_deg: float
    bound_s: float


def way_inside(present: int, limits: tuple[int, int], turn_ticks: float) -> WayInside | None:
    """Return the shortest way from `present` to inside `limits`, ticks.

    None if the nearer end is on the other side of the end of the turn: a servo counts its ticks without wrapping, and
    would turn all the way round in the other direction.
    """
    low, high = limits
    outside = max(low - present, present - high)
    # The way in the other direction is as long as the turn without the limits' range and this gap.
    if 2 * outside > turn_ticks - (high - low):
        return None
    margin = min(round(INSIDE_DEG / 360.0 * turn_ticks), (high - low) // 2)
    goal = low + margin if present < low else high - margin
    distance_deg = abs(goal - present) * 360.0 / turn_ticks
    return WayInside(goal, distance_deg, 2.0 * distance_deg / SPEED_DEG_S + _SLACK_S)


def slow_profile(table: Table, drive_mode: int, distance_deg: float) -> Values:
    """Return values by register name that move a servo at `SPEED_DEG_S`; empty for a model without a speed register.

    0 would mean no limit, so no value is less than 1.
    """
    speed, acceleration = table.role("moving_speed"), table.acceleration
    if speed is None:
        return {}
    if speed.name == "profile_velocity" and drive_mode & _BY_TIME:
        profile = {speed.name: max(1, round(1e3 * (distance_deg / SPEED_DEG_S + _RAMP_S)))}
        return profile if acceleration is None else {acceleration.name: round(1e3 * _RAMP_S / 2.0), **profile}
    ticks_s = SPEED_DEG_S / 360.0 * table.ticks_per_revolution
    profile = {speed.name: max(1, int(ticks_s / table.in_ticks(speed)))}
    if acceleration is not None:
        profile[acceleration.name] = max(1, int(ticks_s / _RAMP_S / table.in_ticks(acceleration)))
    return profile


class Startup(ABC):
    """The requests that start up one servo.

    Args:
        servo: the servo with its joint, id, control table, limits and safety.
        needs: requirements of its joint.
        warnings: a stored value that only weakens protection -> joints; filled here.
        others: returns the startups of other known servos that are being started up.

    Attributes:
        link: link over the wire; set before the first request.
        table: control table. If the servo reports a firmware with another layout, it is replaced by that table.
        can_reboot: whether the protocol has a reboot instruction.
        unlimited: registers of speed and acceleration in which 0 means unlimited.
    """

    can_reboot: ClassVar[bool]
    unlimited: ClassVar[tuple[str, ...]]
    link: RegisterLink

    def __init__(
        self,
        servo: BusServo,
        needs: JointNeeds,
        warnings: dict[str, list[str]],
        others: Callable[[], list[Startup]] = list,
    ) -> None:
        self.servo = servo
        self.table = servo.table
        self._needs = needs
        self._warnings = warnings
        self._others = others

    @abstractmethod
    def _read_state(self) -> Steps[dict[str, int]]:
        """Make the servo answer; return the values of its registers, at least of those up to the present position."""

    @abstractmethod
    def _defaults(self, now: Values) -> Values:
        """Return the values that registers get before torque, in any head; `now`: their present values."""

    @abstractmethod
    def _find_again(self, reboot: bool) -> Steps[None]:
        """Identify a servo that was lost. Raises Silent, ServoError."""

    def prepare(self) -> Steps[int]:
        """Verify the stored values, write settings, and return the latched faults.

        Torque is left unchanged, except in `_release_outside`. Raises ServoError for a stored value that contradicts
        the head's file.
        """
        now = yield from self._release_outside((yield from self._read_state()))
        settings = {**self._corrections(now), **self._defaults(now), **self.wanted()}  # the mode first
        for name, target in settings.items():
            if (field := self.table.fields.get(name)) is None:
                continue
            if name not in now:
                now[name] = self.value(field)
                yield 0.0
            written = yield from self._set(now, name, target)
            if written and self.table.protocol == 2 and name == self._name("operating_mode"):
                now = yield from self._snapshot()  # a change of mode resets gains, profile and goals
        error = self.table.role("error_status") if self.table.protocol == 2 else None
        return now[error.name] if error is not None else 0

    def bring_back(self, reboot: bool) -> Steps[int]:
        """Start up a servo that was lost: model, settings, torque on, all verified; return the position held, in ticks.

        Raises Silent, and ServoError as `prepare` and `torque_on`.
        """
        yield from self._find_again(reboot)
        yield 0.0
        yield from self.prepare()
        return (yield from self.torque_on())

    def torque_on(self) -> Steps[int]:
        """Write goal := present, read it back, switch torque on, read it back; return the position held, in ticks.

        A servo that stands outside its own limits is moved inside first, at `SPEED_DEG_S`, which takes its time. Raises
        ServoError, with torque off, for a servo that does not arrive or has no speed register.
        """
        limits = self.own_limits()
        yield 0.0
        present = self.value(self._field("present_position"))  # no pause from here on
        if limits is not None and not _inside(present, limits):
            return (yield from self._move_inside(present, limits))
        yield from self._enable_at(present)
        return present

    def _enable_at(self, goal: int) -> Steps[None]:
        """Write the goal, then torque on, in this order because some servos switch torque on when a goal is written."""
        yield from self._write(self._field("goal_position"), goal)
        yield from self._restore_torque()
        yield from self._write(self._field("torque_enable"), 1)

    def _move_inside(self, start: int, limits: tuple[int, int]) -> Steps[int]:
        """Write a slow profile, switch torque on with a goal just inside, and wait until the servo stands there.

        Then write goal := present and the usual profile; return the position held. If this ends early, also because the
        caller closes the generator, torque is switched off.
        """
        table = self.table
        drive_mode = table.fields.get("drive_mode")
        mode = 0 if drive_mode is None else self.value(drive_mode)
        way = way_inside(start, limits, table.ticks_per_revolution)
        profile = slow_profile(table, mode, 0.0 if way is None else way.distance_deg)
        where = f"stands at {start}, outside its own limits {limits[0]}..{limits[1]}"
        if way is None or not profile:
            raise self._error(f"{where}: torque would make it jump; turn it in by hand")
        log.log(NOTE, "%s", self._about(f"{where}: moving it inside at {SPEED_DEG_S:g} deg/s"))
        torque, usual = self._field("torque_enable"), self.wanted()
        try:
            for name, value in profile.items():
                yield from self._write(table[name], value)
            yield from self._enable_at(way.goal_ticks)
            present = yield from self._arrival(way, limits)
            if present is None:
                yield from self._write(torque, 0)
            else:
                yield from self._write(self._field("goal_position"), present)
            for name in profile:
                yield from self._write(table[name], usual.get(name, 0))
        except BaseException:
            with suppress(BusError):  # a port that is gone: nothing can be sent
                self.link.sync_write(torque.address, {self.servo.id: torque.to_bytes(0)})
            raise
        if present is None:
            late = f"{where}, and does not come inside in {way.bound_s:.1f} s"
            raise self._error(f"{late}: torque is off; see what holds it, and turn it in by hand")
        return present

    def _arrival(self, way: WayInside, limits: tuple[int, int]) -> Steps[int | None]:
        """Return the position at which it stops inside its limits; None if it arrives too late or loses its torque."""
        torque, position = self._field("torque_enable"), self._field("present_position")
        before: int | None = None
        for _ in range(math.ceil(way.bound_s / _LOOK_S)):
            yield _LOOK_S
            present = self.value(position)
            if before is not None and abs(present - before) <= _STILL_TICKS and _inside(present, limits):
                return present
            before = present
            yield 0.0
            if not self.value(torque):
                break
        return None

    def _release_outside(self, now: dict[str, int]) -> Steps[dict[str, int]]:
        """Switch torque off if a servo stands outside its own limits under torque with a slow profile.

        Such a servo was lost while it was moved inside, and would jump with its usual profile. Returns `now`, updated.
        """
        limits, torque, usual = self._limits(now), self._field("torque_enable"), self.wanted()
        slow = any(now[name] != usual.get(name, 0) for name in slow_profile(self.table, 0, 0.0))
        outside = limits is not None and not _inside(now[self._name("present_position")], limits)
        if not (now[torque.name] and slow and outside):
            return now
        yield from self._write(torque, 0)
        return {**now, torque.name: 0}

    def _restore_torque(self) -> Steps[None]:
        """Restore the registers that a servo reset when it shut down."""
        yield from ()

    # --- settings -----------------------------------------------------------------------------------------------

    def wanted(self) -> Values:
        """Return the register values that should be in force while the bus runs.

        These are mode, profile, torque limit, and the registers of the head's file. Raises ServoError for a register
        that the model does not have.
        """
        table, safety = self.table, self.servo.safety
        mode = operating_mode(table, self._needs)
        wanted = {} if mode is None else {self._name("operating_mode"): mode}
        current = table.fields.get("goal_current")
        if current is not None and safety.current_limit_mA is not None:
            wanted[current.name] = min(current.high, round(safety.current_limit_mA / current.scale))
        wanted |= dict.fromkeys(self.unlimited, 0) | torque_limit(self.servo)
        for name in safety.registers:
            if name not in table.fields:
                raise self._error(f"is a {table.model}, which has no register {name}")
        return {**{name: value for name, value in wanted.items() if name in table.fields}, **safety.registers}

    def _set(self, now: Values, name: str, target: int) -> Steps[bool]:
        """Write a register that holds another value; return whether it was written. `now`: present values.

        Raises ServoError for a register of the EEPROM under torque.
        """
        field, delay = self.table[name], name == self._name("return_delay")
        if now[name] == target:
            return False
        if field.eeprom and now[self._name("torque_enable")]:
            if delay:
                return False  # slower, but not a reason to switch torque off
            raise self._error(f"has torque on and {name} {now[name]}, must be {target}: release it first")
        if delay:
            # The delay of all servos that are being started up is written in one packet; each startup still verifies
            # it. With the factory delay of 0.5 ms each, reading 28 servos takes longer than a tick, and a startup takes
            # 20 reads. If an EEPROM lock is closed (Feetech), the value is kept until the servo loses its supply.
            data = field.to_bytes(target)
            alike = {each.servo.id: data for each in self._others() if each.table.role("return_delay") == field}
            if alike:
                self.link.sync_write(field.address, alike)
        yield from self._write(field, target)
        return True

    def own_limits(self) -> tuple[int, int] | None:
        """Return the position limits stored in the servo, ticks; None if it has none or they do not count."""
        return self._limits({name: self.value(self.table[name]) for name in limit_names(self.table) or ()})

    def _limits(self, values: Values) -> tuple[int, int] | None:
        """Return the limits as `own_limits` does, from registers that have been read."""
        names = limit_names(self.table)
        if names is None or not limits_count(self.table, self._needs):
            return None
        low, high = (values[name] for name in names)
        return (low, high) if low < high else None

    def _corrections(self, values: Values) -> Values:
        """Return the registers that startup corrects; warn about others. Raises ServoError for a contradiction."""
        servo = self.servo
        found = contradictions(values, self.table, self._needs)
        for each in found:
            if each.then == "refused":
                kept = f"measure the joint ({servo.calibrate}), or record the value if the head's file fits it: "
                cure = f"; {kept * each.in_file}{servo.doctor}" * each.fixable
                raise ServoError(f"{self.link.port.name}: servo {servo.id} ({servo.joint}): {each}{cure}")
            if each.then == "told" and servo.joint not in (joints := self._warnings.setdefault(str(each), [])):
                joints.append(servo.joint)
                if self.link.tries == 1:
                    log.warning("%s", self._about(f"comes back, and {each}"))
        return {each.register: each.wanted for each in found if each.then == "set"}

    # --- exchanges ----------------------------------------------------------------------------------------------

    def ping(self) -> Found | None:
        """Ping the servo; return its identity, or None if it does not answer."""
        return self.link.ping(self.servo.id)

    def recognise(self, found: Found) -> None:
        """Raise ServoError for another model. A model without a number accepts any servo."""
        table = self.table
        if table.model_number is not None and found.model_number != table.model_number:
            wanted = f"the head says {table.model} ({table.model_number})"
            raise self._error(f"is model number {found.model_number}, {wanted}")

    def _snapshot(self) -> Steps[dict[str, int]]:
        """Return the values of the registers, in as few reads as possible; for 2.0 only up to those in `_AT_REST`."""
        end, memory = self.table.size, bytearray()
        if self.table.protocol == 2:
            fields = [field for role in _AT_REST if (field := self.table.role(role)) is not None]
            end = sum(span_of(fields))
        for start in range(0, end, LONGEST_READ):
            memory += self._read("its registers", start, min(LONGEST_READ, end - start))
            yield 0.0
        inside = (each for each in self.table.fields.values() if each.address + each.size <= end)
        return {each.name: each.from_bytes(memory[each.address :]) for each in inside}

    def value(self, field: Field) -> int:
        """Return the value of one register. Raises Silent; ServoError if the read is refused."""
        return field.from_bytes(self._read(field.name, field.address, field.size))

    def _read(self, what: str, address: int, length: int) -> bytes:
        for _ in range(self.link.tries):
            answer = self.link.read(self.servo.id, address, length)
            if answer is not None:
                break
        else:
            raise Silent(self._about(f"does not answer when asked for {what}"))
        if refusal := self.link.refusal(answer):
            raise self._error(f"refuses to report {what}: {refusal}")
        return answer.data

    def _write(self, field: Field, value: int) -> Steps[None]:
        """Write and verify a register, through the lock of the EEPROM if there is one."""
        servo, lock = self.servo, self.table.role("lock")
        yield from verified_write(self.link, servo.id, field, value, lock=lock, tries=self.link.tries, about=str(servo))

    def _field(self, role: str) -> Field:
        field = self.table.role(role)
        if field is None:
            raise self._error(f"is a {self.table.model}, which has no register for {role}")
        return field

    def _name(self, role: str) -> str:
        """Return the name of the register of a role; the role itself if the model has none."""
        field = self.table.role(role)
        return role if field is None else field.name

    def _error(self, problem: str) -> ServoError:
        return ServoError(self._about(problem))

    def _about(self, problem: str) -> str:
        return f"{self.servo} {problem}"


def _inside(ticks: int, limits: tuple[int, int]) -> bool:
    return limits[0] <= ticks <= limits[1]


def start_up(bus: str, link: RegisterLink, startups: Sequence[Startup], baud: int) -> dict[int, int]:
    """Identify, verify and prepare every servo of a bus; torque is left unchanged.

    Returns the latched faults by index of the servos that answered, as bits of the table's faults (0 if the protocol
    has no such register). A servo that does not answer costs `TRIES` times `PATIENCE_S`. `bus` and `baud` are for
    messages.

    Raises BusError if no servo answers, ServoError for a servo that contradicts the head's file.
    """
    found: dict[int, Found] = {}
    bits: dict[int, int] = {}
    with link.patient(PATIENCE_S, TRIES):
        for _ in range(TRIES):
            for index, startup in enumerate(startups):
                if index not in found and (answer := startup.ping()) is not None:
                    found[index] = answer
        for index in sorted(found):
            startups[index].recognise(found[index])
            with suppress(Silent):
                bits[index] = finish(startups[index].prepare())
    if not bits:
        absent = ", ".join(f"{startup.servo.id} ({startup.servo.joint})" for startup in startups)
        raise BusError(
            f"bus {bus!r} on {link.port.name} at {baud} baud: no answer from id {absent}; "
            f"look for them: {startups[0].servo.doctor.removesuffix(' --fix')}"
        )
    return bits


def needs_of(servos: Sequence[BusServo], conversion: TickConversion, faults: Faults) -> list[JointNeeds]:
    """Return what each joint of a bus requires of its servo; `faults`: the faults that the head acts upon."""
    ids = frozenset(servo.id for servo in servos)
    return [
        JointNeeds(
            low,
            high,
            stored=servo.safety.stored,
            other_ids=ids - {servo.id},
            bounded_current=servo.safety.current_limit_mA is not None,
            allowed_faults=faults.mask,
        )
        for servo, low, high in zip(servos, *tick_ranges(servos, conversion).tolist(), strict=True)
    ]
