"""First contact with servos of Dynamixel 1.0 or Feetech: who is there, is it what the head says, torque without a jump.

Whatever is written is read back: a locked EEPROM does not always say that it took nothing. These servos switch their
torque on by themselves when a goal is written, so the first goal anybody writes is where the servo stands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from sfms_robot.errors import BusError, ServoError
from sfms_robot.servo.codecs import dxl1, feetech
from sfms_robot.servo.frame1_link import Frame1Link
from sfms_robot.servo.link import Answer, Found
from sfms_robot.servo.policy import BusServo, torque_limit
from sfms_robot.servo.registers import Field, Table

_TRIES: Final = 3
_PATIENCE_S: Final = 0.05  # an adapter may hold an answer back for 16 ms
_UNLIMITED: Final = ("moving_speed", "goal_velocity", "acceleration", "goal_acceleration", "goal_time")  # 0 = none


class Silent(ServoError):
    """It did not answer."""


class Frame1Handshake:
    """Checked requests to one servo after the other. `index` counts servos in bus order.

    `patient`: ask again, and wait as long as a slow adapter may take; not beside a running bus.
    """

    def __init__(
        self,
        bus: str,
        link: Frame1Link,
        servos: Sequence[BusServo],
        tables: Sequence[Table],
        baud: int,
        patient: bool = True,
    ) -> None:
        self._bus = bus
        self._link = link
        self._servos = servos
        self._tables = tables
        self._baud = baud
        self._tries = _TRIES if patient else 1
        self._patience_s = _PATIENCE_S if patient else 0.0

    def run(self) -> None:
        """Identify and prepare every servo.

        Raises BusError listing the ids that do not answer, ServoError for one that is not what it should be.
        """
        with self._link.patient(self._patience_s):
            self._identify()
            for index in range(len(self._servos)):
                self.prepare(index)

    def _identify(self) -> None:
        found: dict[int, Found] = {}
        for _ in range(self._tries):
            for index, servo in enumerate(self._servos):
                if index not in found and (who := self._link.ping(servo.id)) is not None:
                    if who.model_number is None:
                        self._make_talk(index)
                    else:
                        found[index] = who
        absent = [f"{s.id} ({s.joint})" for i, s in enumerate(self._servos) if i not in found]
        if absent:
            there = ", ".join(str(self._servos[i].id) for i in sorted(found)) or "none"
            raise BusError(
                f"bus {self._bus!r} on {self._link.port.name} at {self._baud} baud: "
                f"no answer from id {', '.join(absent)}; ids that answer: {there}"
            )
        for index, who in found.items():
            self._check_model(index, who.model_number)

    def _check_model(self, index: int, number: int | None) -> None:
        table = self._tables[index]
        if table.model_number is not None and number != table.model_number:
            raise self._error(index, f"is model number {number}, the head says {table.model} ({table.model_number})")

    def prepare_again(self, index: int) -> None:
        """As at start-up, for a servo that was away; what its EEPROM holds is still there."""
        self._check_model(index, self._value(index, self._tables[index]["model_number"]))
        self.prepare(index, anew=True)

    def _make_talk(self, index: int) -> None:
        """Raise its status level; while that is low, it does not acknowledge."""
        servo, lock = self._servos[index].id, self._tables[index].role("lock")
        level = self._field(index, "status_level")
        if lock is not None:
            self._link.write(servo, lock.address, lock.to_bytes(0))
        self._link.write(servo, level.address, level.to_bytes(level.high))
        if lock is not None:
            self._link.write(servo, lock.address, lock.to_bytes(1))

    def prepare(self, index: int, anew: bool = False) -> None:
        """Position mode, all answers, no delay, no speed limit of its own. Torque is left as it is.

        `anew`: its EEPROM was seen to before.
        """
        table = self._tables[index]
        level = self._field(index, "status_level")
        if self._value(index, level) != level.high:
            self._make_talk(index)
        torque = self._value(index, self._field(index, "torque_enable"))
        for field, wanted in self._settings(index, table):
            if anew and field.eeprom:
                continue
            value = self._value(index, field)
            if value == wanted or (field == table.role("torque_limit") and not value):
                continue  # a torque limit of 0 is a shutdown, and stays until the goal is where the servo stands
            if torque and field.eeprom:
                if field.name == "return_delay_time":
                    continue  # slower, and no reason to let go
                raise self._error(index, f"has torque on and {field.name} {value}, must be {wanted}: release it first")
            self._set(index, field, wanted)

    def _settings(self, index: int, table: Table) -> list[tuple[Field, int]]:
        settings: list[tuple[Field, int]] = []
        delay, mode = table.role("return_delay"), table.role("operating_mode")
        if mode is not None and table.position_mode is not None:
            settings.append((mode, table.position_mode))
        settings += self._joint_mode(index, table)
        if delay is not None:
            settings.append((delay, 0))
        own = {name: 0 for name in _UNLIMITED if name in table.fields} | self._strength(index)
        own |= self._servos[index].safety.registers
        for name in own:
            if name not in table.fields:
                raise self._error(index, f"is a {table.model}, which has no register {name}")
        return settings + [(table[name], value) for name, value in own.items()]

    def _strength(self, index: int) -> dict[str, int]:
        """Register and value of the torque limit: what the head says, else all: an earlier run may have left less."""
        table = self._tables[index]
        strength = table.role("torque_limit")
        if strength is None or "max_torque" not in table.fields:
            return torque_limit(self._servos[index])
        return torque_limit(self._servos[index]) or {strength.name: self._value(index, table["max_torque"])}

    def _joint_mode(self, index: int, table: Table) -> list[tuple[Field, int]]:
        """Dynamixel 1.0 keeps its mode in its angle limits: both 0 is a wheel, both at the end many turns."""
        if "cw_angle_limit" not in table.fields:
            return []
        low, high = table["cw_angle_limit"], table["ccw_angle_limit"]
        if self._value(index, low) != self._value(index, high):
            return []
        return [(low, 0), (high, high.high)]

    def torque_on_without_a_jump(self, index: int) -> int:
        """Goal := present, read back, torque on; the position held, in ticks."""
        table = self._tables[index]
        goal, torque = self._field(index, "goal_position"), self._field(index, "torque_enable")
        with self._link.patient(self._patience_s):
            present = self._value(index, self._field(index, "present_position"))
            self._refuse_outside(index, present)
            self._set(index, goal, present)
            for name, value in self._strength(index).items():
                if not self._value(index, table[name]):  # since it shut down
                    self._set(index, table[name], value)
            self._set(index, torque, 1)
        return present

    def _refuse_outside(self, index: int, present: int) -> None:
        limits = self.own_limits(index)
        if limits is not None and not limits[0] <= present <= limits[1]:
            raise self._error(
                index,
                f"stands at {present}, outside its own limits {limits[0]}..{limits[1]}: torque would make it jump; "
                "turn it in by hand",
            )

    def own_limits(self, index: int) -> tuple[int, int] | None:
        """The position limits in the servo itself, ticks; None when there are none."""
        table = self._tables[index]
        for names in (("cw_angle_limit", "ccw_angle_limit"), ("min_position_limit", "max_position_limit")):
            if names[0] in table.fields:
                low, high = (self._value(index, table[name]) for name in names)
                return (low, high) if low < high else None
        return None

    def calibrate_here(self, index: int) -> None:
        """Make the present position the middle of the servo (STS: written 128, torque enable does that).

        Raises ServoError for a model that cannot.
        """
        table, servo = self._tables[index], self._servos[index]
        torque = self._field(index, "torque_enable")
        if "homing_offset" not in table.fields or torque.high < feetech.CALIBRATE_HERE:
            raise self._error(index, f"is a {table.model}, which cannot be calibrated where it stands")
        with self._link.patient(self._patience_s):
            self._set(index, torque, 0)
            lock = table.role("lock")
            if lock is not None:
                self._write(index, lock, 0)
            data = bytes([feetech.CALIBRATE_HERE])
            self._repeat(index, "calibration", lambda: self._link.write(servo.id, torque.address, data))
            if lock is not None:
                self._write(index, lock, 1)
            now = self._value(index, self._field(index, "present_position"))
            if abs(now - table.center_ticks) > 2:  # the gear may settle a little
                raise self._error(index, f"was calibrated and stands at {now}, not at {table.center_ticks}")

    # --- registers ----------------------------------------------------------------------------------------------

    def get(self, index: int, role: str) -> int:
        """Value of a role's register. Raises ServoError when the servo refuses or stays silent."""
        return self._value(index, self._field(index, role))

    def put(self, index: int, role: str, value: int) -> None:
        """Write a role's register, unlocking the EEPROM for it where that is needed, and read it back."""
        self._set(index, self._field(index, role), value)

    def _field(self, index: int, role: str) -> Field:
        field = self._tables[index].role(role)
        if field is None:
            raise self._error(index, f"is a {self._tables[index].model}, which has no register for {role}")
        return field

    def _value(self, index: int, field: Field) -> int:
        servo = self._servos[index].id
        answer = self._repeat(index, f"reading {field.name}", lambda: self._link.read(servo, field.address, field.size))
        if len(answer.data) != field.size:
            raise self._error(index, f"gives no value for {field.name}")
        return field.from_bytes(answer.data)

    def _set(self, index: int, field: Field, value: int) -> None:
        lock = self._tables[index].role("lock")
        if field.eeprom and lock is not None:
            self._write(index, lock, 0)
            try:
                self._write(index, field, value)
            finally:
                self._write(index, lock, 1)
        else:
            self._write(index, field, value)

    def _write(self, index: int, field: Field, value: int) -> None:
        servo = self._servos[index].id
        try:
            data = field.to_bytes(value)
        except OverflowError:
            raise self._error(index, f"{field.name} = {value} does not fit the register") from None
        what = f"{field.name} := {value}"
        self._repeat(index, what, lambda: self._link.write(servo, field.address, data))
        if (now := self._value(index, field)) != value:
            raise self._error(index, f"{field.name} was set to {value} and reads {now}{self._trouble(index)}")

    def _repeat(self, index: int, what: str, request: Callable[[], Answer | None]) -> Answer:
        for _ in range(self._tries):
            answer = request()
            if answer is not None:
                break
        else:
            raise Silent(str(self._error(index, f"does not answer to {what}")))
        refusal = dxl1.refusal_text(answer.error) if self._link.family == "dynamixel" else ""
        if refusal:
            raise self._error(index, f"refuses {what}: {refusal}")
        return answer

    def _trouble(self, index: int) -> str:
        """What the servo reports beside, to add to a message."""
        torque = self._field(index, "torque_enable")
        answer = self._link.read(self._servos[index].id, torque.address, torque.size)
        fault = "" if answer is None else self._tables[index].status_fault_names(answer.error)
        return f", and it reports a hardware error ({fault})" if fault else ""

    def _error(self, index: int, problem: str) -> ServoError:
        servo = self._servos[index]
        return ServoError(f"{servo.joint} (id {servo.id}) {problem}")
