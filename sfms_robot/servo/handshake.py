"""First contact with the servos of a bus: who is there, is it what the head says, and torque on without a jump.

Every servo must answer here; later, on the running bus, one may fall silent. Whatever is written is read back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

from sfms_robot.errors import BusError, ServoError
from sfms_robot.servo.codecs.dxl2 import ALERT, Packet, error_text
from sfms_robot.servo.dxl2_link import Dxl2Link
from sfms_robot.servo.registers import Table

_TRIES: Final = 3
_PATIENCE_S: Final = 0.05  # an adapter may hold an answer back for 16 ms
_POSITION_MODE: Final = 3
_TORQUE_ON_BY_GOAL: Final = 0x08  # drive mode bit 3


class Named(Protocol):
    """The part of a bus servo that matters here."""

    @property
    def joint(self) -> str: ...

    @property
    def id(self) -> int: ...


class Handshake:
    """Checked, repeated requests to one servo after the other. `index` counts servos in bus order."""

    def __init__(self, bus: str, link: Dxl2Link, servos: Sequence[Named], tables: Sequence[Table], baud: int) -> None:
        self._bus = bus
        self._link = link
        self._servos = servos
        self._tables = tables
        self._baud = baud

    def run(self) -> list[str | None]:
        """Identify and prepare every servo; the latched hardware errors, named, in bus order.

        Raises BusError listing the ids that do not answer, ServoError for one that is not what it should be.
        """
        with self._link.patient(_PATIENCE_S):
            self._identify()
            level = self._tables[0]["status_return_level"]
            everyone = dict.fromkeys([servo.id for servo in self._servos], level.to_bytes(2))
            self._link.sync_write(level.address, everyone)  # unheard: at level 0 a servo acknowledges nothing
            return [self._prepare(index) for index in range(len(self._servos))]

    def _identify(self) -> None:
        found: dict[int, Packet] = {}
        for _ in range(_TRIES):
            for servo in self._servos:
                if servo.id not in found and (answer := self._link.ping(servo.id)) is not None:
                    found[servo.id] = answer
        absent = [f"{servo.id} ({servo.joint})" for servo in self._servos if servo.id not in found]
        if absent:
            there = ", ".join(str(i) for i in found) or "none"
            raise BusError(
                f"bus {self._bus!r} on {self._link.port.name} at {self._baud} baud: "
                f"no answer from id {', '.join(absent)}; ids that answer: {there}"
            )
        for servo, table in zip(self._servos, self._tables, strict=True):
            model = int.from_bytes(found[servo.id].params[:2], "little")
            if model != table.model_number:
                raise ServoError(
                    f"{servo.joint} (id {servo.id}) is model number {model}, "
                    f"the head says {table.model} ({table.model_number})"
                )

    def _prepare(self, index: int) -> str | None:
        torque = self.get(index, "torque_enable")
        mode = self.get(index, "operating_mode")
        drive = self.get(index, "drive_mode")
        wanted = {"operating_mode": (mode, _POSITION_MODE), "drive_mode": (drive, drive & ~_TORQUE_ON_BY_GOAL)}
        for name, (value, target) in wanted.items():
            if value != target and torque:
                raise self._error(index, f"has torque on and {name} {value}, must be {target}: release it first")
            if value != target:
                self.put(index, name, target)
        if not torque and self.get(index, "return_delay_time"):
            self.put(index, "return_delay_time", 0)
        for name in ("bus_watchdog", "profile_acceleration", "profile_velocity"):
            if self.get(index, name):
                self.put(index, name, 0)
        return self._tables[index].fault_names(self.get(index, "hardware_error_status")) or None

    def torque_on_without_a_jump(self, index: int) -> int:
        """Goal := present, read back, torque on; the position held, in ticks."""
        with self._link.patient(_PATIENCE_S):
            present = self.get(index, "present_position")
            self.put(index, "goal_position", present)
            self.put(index, "torque_enable", 1)
        return present

    def get(self, index: int, name: str) -> int:
        """A register's raw value. Raises ServoError when the servo refuses or stays silent."""
        field, servo = self._tables[index][name], self._servos[index].id
        answer = self._repeat(index, f"reading {name}", lambda: self._link.read(servo, field.address, field.size))
        return field.from_bytes(answer.params)

    def put(self, index: int, name: str, value: int) -> None:
        """Write a register and read it back."""
        field, servo = self._tables[index][name], self._servos[index].id
        try:
            data = field.to_bytes(value)
        except OverflowError:
            raise self._error(index, f"{name} = {value} does not fit the register") from None
        self._repeat(index, f"{name} := {value}", lambda: self._link.write(servo, field.address, data))
        if (now := self.get(index, name)) != value:
            raise self._error(index, f"{name} was set to {value} and reads {now}")

    def _repeat(self, index: int, what: str, request: Callable[[], Packet | None]) -> Packet:
        for _ in range(_TRIES):
            answer = request()
            if answer is not None:
                break
        else:
            raise self._error(index, f"does not answer to {what}")
        if answer.error & ~ALERT:
            alert = ", and reports a hardware error" if answer.error & ALERT else ""
            raise self._error(index, f"refuses {what}: {error_text(answer.error)}{alert}")
        return answer

    def _error(self, index: int, problem: str) -> ServoError:
        servo = self._servos[index]
        return ServoError(f"{servo.joint} (id {servo.id}) {problem}")
