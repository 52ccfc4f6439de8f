"""First contact with servos of Dynamixel 1.0 or Feetech: who is there, is it what the head says, torque without a jump.

Whatever is written is read back: a locked EEPROM does not always say that it took nothing. These servos switch their
torque on by themselves when a goal is written, so the first goal anybody writes is where the servo stands.
"""

from __future__ import annotations

from typing import Final

from sfms_robot.servo.chain.link import Answer, Found
from sfms_robot.servo.chain.protocol1_link import Frame1Link
from sfms_robot.servo.chain.startup import PATIENCE_S, Contact, Steps, finish
from sfms_robot.servo.codecs import dxl1, feetech
from sfms_robot.servo.policy import torque_limit
from sfms_robot.servo.registers import Field, Table

_UNLIMITED: Final = ("moving_speed", "goal_velocity", "acceleration", "goal_acceleration", "goal_time")  # 0 = none


class Frame1Handshake(Contact[Frame1Link]):
    """`Contact` with servos that have no reboot, and tell their faults in every answer."""

    can_reboot = False

    def run(self) -> list[int]:
        with self._link.patient(PATIENCE_S):
            self._identify()
            for index in range(len(self._servos)):
                finish(self.prepare(index))
        return [0] * len(self._servos)

    def _meet(self, index: int) -> Found | None:
        who = super()._meet(index)
        if who is not None and who.model_number is None:
            self._make_talk(index)
            return None
        return who

    def bring_back(self, index: int, reboot: bool) -> Steps[int]:
        self._recognise(index, Found(self._value(index, self.tables[index]["model_number"]), None))
        yield 0.0
        yield from self.prepare(index, anew=True)
        return (yield from self.torque_on(index))

    def _make_talk(self, index: int) -> None:
        """Raise its status level; while that is low, it does not acknowledge."""
        servo, lock = self._servos[index].id, self.tables[index].role("lock")
        level = self._field(index, "status_level")
        if lock is not None:
            self._link.write(servo, lock.address, lock.to_bytes(0))
        self._link.write(servo, level.address, level.to_bytes(level.high))
        if lock is not None:
            self._link.write(servo, lock.address, lock.to_bytes(1))

    def prepare(self, index: int, anew: bool = False) -> Steps[None]:
        """Position mode, all answers, no delay, no speed limit of its own. Torque is left as it is.

        `anew`: its EEPROM was seen to before.
        """
        table = self.tables[index]
        level = self._field(index, "status_level")
        if self._value(index, level) != level.high:
            self._make_talk(index)
        torque = self._value(index, self._field(index, "torque_enable"))
        yield 0.0
        for field, wanted in self._settings(index, table):
            yield 0.0
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
        table = self.tables[index]
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

    def torque_on(self, index: int) -> Steps[int]:
        yield 0.0
        table = self.tables[index]
        goal, torque = self._field(index, "goal_position"), self._field(index, "torque_enable")
        present = self._value(index, self._field(index, "present_position"))  # from here on without a pause
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
        table = self.tables[index]
        for names in (("cw_angle_limit", "ccw_angle_limit"), ("min_position_limit", "max_position_limit")):
            if names[0] in table.fields:
                low, high = (self._value(index, table[name]) for name in names)
                return (low, high) if low < high else None
        return None

    def calibrate_here(self, index: int) -> None:
        """Make the present position the middle of the servo (STS: written 128, torque enable does that).

        Raises ServoError for a model that cannot.
        """
        table, servo = self.tables[index], self._servos[index]
        torque = self._field(index, "torque_enable")
        if "homing_offset" not in table.fields or torque.high < feetech.CALIBRATE_HERE:
            raise self._error(index, f"is a {table.model}, which cannot be calibrated where it stands")
        with self._link.patient(PATIENCE_S):
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

    def _field(self, index: int, role: str) -> Field:
        field = self.tables[index].role(role)
        if field is None:
            raise self._error(index, f"is a {self.tables[index].model}, which has no register for {role}")
        return field

    def _value(self, index: int, field: Field) -> int:
        servo = self._servos[index].id
        answer = self._repeat(index, f"reading {field.name}", lambda: self._link.read(servo, field.address, field.size))
        if len(answer.data) != field.size:
            raise self._error(index, f"gives no value for {field.name}")
        return field.from_bytes(answer.data)

    def _set(self, index: int, field: Field, value: int) -> None:
        lock = self.tables[index].role("lock")
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

    def _refusal(self, answer: Answer) -> str:
        return dxl1.refusal_text(answer.error) if self._link.family == "dynamixel" else ""

    def _trouble(self, index: int) -> str:
        """What the servo reports beside, to add to a message."""
        torque = self._field(index, "torque_enable")
        answer = self._link.read(self._servos[index].id, torque.address, torque.size)
        fault = "" if answer is None else self.tables[index].status_fault_names(answer.error)
        return f", and it reports a hardware error ({fault})" if fault else ""
