"""Startup of the servos of a chain: identify, verify, prepare, enable.

    identify   which servos answer, each of the model that the head's file names and of a firmware that is known
    verify     what the unit has stored against what the head's file reckons with (`stored_settings`): refused by name,
               or a warning where it only weakens protection
    prepare    mode, profile, torque limit and the registers of the head's file, each written and read back
    enable     goal := present, then torque: no jump. A servo that stands outside its own limits, as of a sagged head,
               cannot hold there: its own profile moves it inside, slowly (`slow_profile`)

The same steps bring a servo back that was away. They are generators (`Steps`): between two exchanges on the wire they
yield how long they would like to wait. At startup they are run through; while the bus is running, a tick takes a few
of them beside its own work.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import ClassVar, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import BusError, ServoError
from sfms_robot.ports import TickConversion
from sfms_robot.servo.chain.link import Found, RegisterLink
from sfms_robot.servo.chain.slow_profile import SPEED_DEG_S, WayInside, slow_profile, way_inside
from sfms_robot.servo.chain.verified_write import TRIES, finish, verified_write
from sfms_robot.servo.chain.verified_write import Silent as Silent
from sfms_robot.servo.chain.verified_write import Steps as Steps
from sfms_robot.servo.policy import BusServo, torque_limit
from sfms_robot.servo.registers import Field, Table
from sfms_robot.servo.stored_settings import (
    Contradiction,
    JointNeeds,
    contradictions,
    limit_names,
    limits_count,
    operating_mode,
)

L = TypeVar("L", bound=RegisterLink)

log = logging.getLogger(__name__)

PATIENCE_S: Final = 0.05  # an adapter may hold an answer back for 16 ms
LONGEST_READ: Final = 64
_LOOK_S: Final = 0.05  # between two looks at a servo that is moved inside its limits
_STILL_TICKS: Final = 1  # between two looks: it stands


class Startup(ABC, Generic[L]):
    """Requests to the servos of a bus. `index` counts servos in bus order.

    Args:
        bus: its name, for messages.
        tables: of each servo; a protocol whose servos tell their firmware replaces those of another layout.
        conversion: joint angles (J,) <-> ticks (J,), which says how far the goals of each joint go.
        baud: for messages.
        tries: before a servo counts as silent; 1 beside a running bus.
        warnings: joints by what their servos have stored that only weakens protection; filled here.

    Attributes:
        others: returns the indices of known servos that are being started up too.
        can_reboot: whether the protocol has an instruction for it.
        unlimited: registers of speed and acceleration, in which 0 is no limit.
    """

    can_reboot: ClassVar[bool]
    unlimited: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        bus: str,
        link: L,
        servos: Sequence[BusServo],
        tables: list[Table],
        conversion: TickConversion,
        baud: int,
        tries: int = TRIES,
        warnings: dict[str, list[str]] | None = None,
    ) -> None:
        self._bus = bus
        self._link = link
        self._servos = servos
        self.tables = tables
        self._needs = needs_of(servos, conversion)
        self._baud = baud
        self._tries = tries
        self._warnings = {} if warnings is None else warnings
        self.others: Callable[[], Sequence[int]] = tuple

    @property
    @abstractmethod
    def family(self) -> str:
        """As `--family` takes it."""

    # --- all together -------------------------------------------------------------------------------------------

    def run(self) -> dict[int, int]:
        """Identify, verify and prepare every servo; torque is left as it is.

        Latched faults, as bits of the table's faults (0 where the protocol has no such register), by index of those
        that answered. Each servo that does not costs `tries` times `PATIENCE_S`.

        Raises BusError when nobody answers, ServoError for one that is not what the head's file says.
        """
        bits: dict[int, int] = {}
        with self._link.patient(PATIENCE_S):
            for index, who in self._identify().items():
                self._recognise(index, who)
                try:
                    bits[index] = finish(self.prepare(index))
                except Silent:
                    continue
        if not bits:
            absent = ", ".join(f"{servo.id} ({servo.joint})" for servo in self._servos)
            raise BusError(
                f"bus {self._bus!r} on {self._link.port.name} at {self._baud} baud: no answer from id {absent}; "
                f"look for them: sfms-robot servo scan --port {self._link.port.name}"
            )
        return bits

    def switch_on(self, index: int) -> int:
        """`torque_on`, run through; the position held, in ticks."""
        with self._link.patient(PATIENCE_S):
            return finish(self.torque_on(index), self._link.wait)

    def _identify(self) -> dict[int, Found]:
        """Who answers a ping, by index."""
        found: dict[int, Found] = {}
        for _ in range(self._tries):
            for index in range(len(self._servos)):
                if index not in found and (who := self._ping(index)) is not None:
                    found[index] = who
        return {index: found[index] for index in sorted(found)}

    # --- one servo ----------------------------------------------------------------------------------------------

    @abstractmethod
    def prepare(self, index: int) -> Steps[int]:
        """Verify what is stored, then settings, before torque; the latched faults. Torque is left as it is.

        Raises ServoError for a stored value that contradicts the head's file.
        """

    @abstractmethod
    def bring_back(self, index: int, reboot: bool) -> Steps[int]:
        """A servo that was away, from the beginning: is it still the same, settings, torque on; the position held.

        Raises Silent, and ServoError as `prepare` and `torque_on`.
        """

    def torque_on(self, index: int) -> Steps[int]:
        """Goal := present, read back, torque on, read back; the position held, in ticks.

        A servo that stands outside its own limits is moved inside first, at `SPEED_DEG_S`, which takes as long as that.
        Raises ServoError, with torque off, for one that does not arrive, or that has no speed of its own.
        """
        limits = self.own_limits(index)
        yield 0.0
        present = self.value(index, self._field(index, "present_position"))  # from here on without a pause
        if limits is not None and not _inside(present, limits):
            return (yield from self._move_inside(index, present, limits))
        yield from self._enable_at(index, present)
        return present

    def _enable_at(self, index: int, goal: int) -> Steps[None]:
        """The goal first, since some servos switch their torque on when it is written."""
        yield from self._write(index, self._field(index, "goal_position"), goal)
        yield from self._restore_torque(index)
        yield from self._write(index, self._field(index, "torque_enable"), 1)

    def _move_inside(self, index: int, start: int, limits: tuple[int, int]) -> Steps[int]:
        """Slow profile, torque with a goal just inside, and once it stands there, goal := present and its usual
        profile; the position held. Whatever ends it before, also somebody who closes it, leaves torque off.
        """
        table, servo = self.tables[index], self._servos[index].id
        drive_mode = table.fields.get("drive_mode")
        mode = 0 if drive_mode is None else self.value(index, drive_mode)
        way = way_inside(start, limits, table.ticks_per_revolution)
        profile = slow_profile(table, mode, 0.0 if way is None else way.distance_deg)
        where = f"stands at {start}, outside its own limits {limits[0]}..{limits[1]}"
        if way is None or not profile:
            raise self._error(index, f"{where}: torque would make it jump; turn it in by hand")
        log.warning("%s", self._about(index, f"{where}: moving it inside at {SPEED_DEG_S:g} deg/s"))
        torque, usual = self._field(index, "torque_enable"), self.wanted(index)
        try:
            for name, value in profile.items():
                yield from self._write(index, table[name], value)
            yield from self._enable_at(index, way.goal_ticks)
            present = yield from self._arrival(index, way, limits)
            if present is None:
                yield from self._write(index, torque, 0)
            else:
                yield from self._write(index, self._field(index, "goal_position"), present)
            for name in profile:
                yield from self._write(index, table[name], usual.get(name, 0))
        except BaseException:
            with suppress(BusError):  # a port that is gone: nothing can be said
                self._link.sync_write(torque.address, {servo: torque.to_bytes(0)})
            raise
        if present is None:
            late = f"{where}, and does not come inside in {way.bound_s:.1f} s"
            raise self._error(index, f"{late}: torque is off; see what holds it, and turn it in by hand")
        return present

    def _arrival(self, index: int, way: WayInside, limits: tuple[int, int]) -> Steps[int | None]:
        """Where it stands inside its limits; None where it does not come there in time, or loses its torque."""
        torque, position = self._field(index, "torque_enable"), self._field(index, "present_position")
        before: int | None = None
        for _ in range(math.ceil(way.bound_s / _LOOK_S)):
            yield _LOOK_S
            present = self.value(index, position)
            if before is not None and abs(present - before) <= _STILL_TICKS and _inside(present, limits):
                return present
            before = present
            yield 0.0
            if not self.value(index, torque):
                break
        return None

    def _release_outside(self, index: int, now: Mapping[str, int]) -> Steps[dict[str, int]]:
        """Torque off where a servo stands outside its own limits under torque with another profile than its usual:
        it was lost sight of while it was moved inside, and its usual profile would let it jump. `now`, with that.
        """
        limits, torque, usual = self._limits_in(index, now), self._field(index, "torque_enable"), self.wanted(index)
        slow = any(now[name] != usual.get(name, 0) for name in slow_profile(self.tables[index], 0, 0.0))
        outside = limits is not None and not _inside(now[self._name(index, "present_position")], limits)
        if not (now[torque.name] and slow and outside):
            return dict(now)
        yield from self._write(index, torque, 0)
        return {**now, torque.name: 0}

    def wanted(self, index: int) -> Mapping[str, int]:
        """Registers and values that are to be in force as long as the bus runs: mode, profile, torque limit, and those
        of the head's file. Raises ServoError for a register that the model does not have.
        """
        table, safety = self.tables[index], self._servos[index].safety
        mode = operating_mode(table, self._needs[index])
        wanted = {} if mode is None else {self._name(index, "operating_mode"): mode}
        current = table.fields.get("goal_current")
        if current is not None and safety.current_limit_mA is not None:
            wanted[current.name] = min(current.high, round(safety.current_limit_mA / current.scale))
        wanted |= dict.fromkeys(self.unlimited, 0) | torque_limit(self._servos[index])
        return {name: value for name, value in wanted.items() if name in table.fields} | self._registers(index)

    def _restore_torque(self, index: int) -> Steps[None]:
        """What a servo took back when it shut down."""
        yield from ()

    def _set(self, index: int, now: Mapping[str, int], name: str, target: int) -> Steps[bool]:
        """Write a register that holds another value; whether it was written. `now`: what they hold.

        Raises ServoError for one of the EEPROM under torque.
        """
        field = self.tables[index][name]
        if now[name] == target:
            return False
        if field.eeprom and now[self._name(index, "torque_enable")]:
            if name == self._name(index, "return_delay"):
                return False  # slower, and no reason to let go
            raise self._error(index, f"has torque on and {name} {now[name]}, must be {target}: release it first")
        if name == self._name(index, "return_delay"):
            self._shorten_delays(field, target)
        yield from self._write(index, field, target)
        return True

    def _shorten_delays(self, field: Field, value: int) -> None:
        """Write the return delay of all servos that are being started up in one packet; each still verifies it.

        With the factory delay of 0.5 ms each, reading 28 servos takes longer than a tick, and a startup takes 20 reads.
        Where an EEPROM lock is closed (Feetech), the value holds until the servo loses its supply.
        """
        data = field.to_bytes(value)
        same = {self._servos[i].id: data for i in self.others() if self.tables[i].role("return_delay") == field}
        if same:
            self._link.sync_write(field.address, same)

    def own_limits(self, index: int) -> tuple[int, int] | None:
        """The position limits stored in the servo, ticks; None where it has none or they do not count."""
        names = limit_names(self.tables[index]) or ()
        return self._limits_in(index, {name: self.value(index, self.tables[index][name]) for name in names})

    def _limits_in(self, index: int, values: Mapping[str, int]) -> tuple[int, int] | None:
        """As `own_limits`, of registers that have been read."""
        table = self.tables[index]
        names = limit_names(table)
        if names is None or not limits_count(table, self._needs[index]):
            return None
        low, high = (values[name] for name in names)
        return (low, high) if low < high else None

    def _verify(self, index: int, values: Mapping[str, int]) -> list[Contradiction]:
        """Return the contradictions that startup sets right or warns of. Raises ServoError for the others."""
        found, servo = contradictions(values, self.tables[index], self._needs[index]), self._servos[index]
        for each in found:
            if each.then == "refused":
                kept = "measure the joint (sfms-robot head calibrate), or record the value if the head's file fits it: "
                cure = f"; {kept * each.in_file}{servo.doctor}" if each.fixable else ""
                raise ServoError(f"{self._link.port.name}: servo {servo.id} ({servo.joint}): {each}{cure}")
            if each.then == "told" and servo.joint not in (joints := self._warnings.setdefault(str(each), [])):
                joints.append(servo.joint)
                if self._tries == 1:
                    log.warning("%s", self._about(index, f"comes back, and {each}"))
        return found

    # --- exchanges ----------------------------------------------------------------------------------------------

    def _ping(self, index: int) -> Found | None:
        return self._link.ping(self._servos[index].id)

    def _recognise(self, index: int, found: Found) -> None:
        """Refuse another model. One without a number cannot be told from others."""
        table = self.tables[index]
        if table.model_number is not None and found.model_number != table.model_number:
            raise self._error(
                index, f"is model number {found.model_number}, the head says {table.model} ({table.model_number})"
            )

    def _snapshot(self, index: int, end: int) -> Steps[dict[str, int]]:
        """Values of all registers below address `end`, in as few reads as they take."""
        memory = bytearray()
        for start in range(0, end, LONGEST_READ):
            memory += self._read(index, "its registers", start, min(LONGEST_READ, end - start))
            yield 0.0
        fields = self.tables[index].fields.values()
        return {
            each.name: each.from_bytes(memory[each.address :]) for each in fields if each.address + each.size <= end
        }

    def value(self, index: int, field: Field) -> int:
        """One register. Raises Silent, ServoError when it is refused."""
        return field.from_bytes(self._read(index, field.name, field.address, field.size))

    def _read(self, index: int, what: str, address: int, length: int) -> bytes:
        for _ in range(self._tries):
            answer = self._link.read(self._servos[index].id, address, length)
            if answer is not None:
                break
        else:
            raise Silent(self._about(index, f"does not answer when asked for {what}"))
        if refusal := self._link.refusal(answer):
            raise self._error(index, f"does not tell {what}: {refusal}")
        if len(answer.data) != length:
            raise self._error(index, f"gives no value for {what}")
        return answer.data

    def _write(self, index: int, field: Field, value: int) -> Steps[None]:
        """A verified write, through the lock of the EEPROM where there is one."""
        servo, lock = self._servos[index], self.tables[index].role("lock")
        about = f"{servo.joint} (id {servo.id})"
        yield from verified_write(self._link, servo.id, field, value, lock=lock, tries=self._tries, about=about)

    def _registers(self, index: int) -> dict[str, int]:
        """Those of the head's file."""
        table, own = self.tables[index], self._servos[index].safety.registers
        for name in own:
            if name not in table.fields:
                raise self._error(index, f"is a {table.model}, which has no register {name}")
        return dict(own)

    def _field(self, index: int, role: str) -> Field:
        field = self.tables[index].role(role)
        if field is None:
            raise self._error(index, f"is a {self.tables[index].model}, which has no register for {role}")
        return field

    def _name(self, index: int, role: str) -> str:
        """Name of the register of a role; the role itself where the model has none."""
        field = self.tables[index].role(role)
        return role if field is None else field.name

    def _error(self, index: int, problem: str) -> ServoError:
        return ServoError(self._about(index, problem))

    def _about(self, index: int, problem: str) -> str:
        servo = self._servos[index]
        return f"{servo.joint} (id {servo.id}) {problem}"


def _inside(ticks: int, limits: tuple[int, int]) -> bool:
    return limits[0] <= ticks <= limits[1]


def needs_of(servos: Sequence[BusServo], conversion: TickConversion) -> list[JointNeeds]:
    """What each joint of a bus asks of its servo."""
    ends: list[NDArray[np.int64]] = [
        conversion.to_ticks(np.array([servo.min_rad for servo in servos])),
        conversion.to_ticks(np.array([servo.max_rad for servo in servos])),
    ]
    ids = frozenset(servo.id for servo in servos)
    needs = []
    for servo, a, b in zip(servos, *ends, strict=True):
        bounded = servo.safety.current_limit_mA is not None
        needs.append(JointNeeds(int(min(a, b)), int(max(a, b)), servo.safety.stored, ids - {servo.id}, bounded))
    return needs
