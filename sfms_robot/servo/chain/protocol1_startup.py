"""Startup of servos that speak the FF FF frame: Dynamixel 1.0 and Feetech.

These servos switch their torque on by themselves when a goal is written, so the first goal anybody writes is where
the servo stands. They have no reboot, and tell their faults in every answer.
"""

from __future__ import annotations

from collections.abc import Mapping

from sfms_robot.errors import ServoError
from sfms_robot.servo.chain.link import Found
from sfms_robot.servo.chain.protocol1_link import Protocol1Link
from sfms_robot.servo.chain.startup import Silent, Startup, Steps
from sfms_robot.servo.policy import torque_limit
from sfms_robot.servo.registers import Field


class Protocol1Startup(Startup[Protocol1Link]):
    """`Startup` with servos that have no reboot, and tell their faults in every answer."""

    can_reboot = False
    unlimited = ("moving_speed", "goal_velocity", "acceleration", "goal_acceleration", "goal_time")

    @property
    def family(self) -> str:
        return "feetech" if self._link.family == "feetech" else "dynamixel1"

    def _ping(self, index: int) -> Found | None:
        who = super()._ping(index)
        if who is not None and who.model_number is None:
            self._acknowledge(index)
            return None
        return who

    def _acknowledge(self, index: int) -> None:
        """Raise its status level, unconfirmed: while that is low, it answers pings and nothing else."""
        servo, lock = self._servos[index].id, self.tables[index].role("lock")
        level = self._field(index, "status_level")
        if lock is not None:
            self._link.write(servo, lock.address, lock.to_bytes(0))
        self._link.write(servo, level.address, level.to_bytes(level.high))
        if lock is not None:
            self._link.write(servo, lock.address, lock.to_bytes(1))

    def prepare(self, index: int) -> Steps[int]:
        table = self.tables[index]
        level = self._field(index, "status_level")
        if self.value(index, level) != level.high:
            self._acknowledge(index)
        yield 0.0
        now = yield from self._release_outside(index, (yield from self._snapshot(index, table.size)))
        for name, target in self._settings(index, now).items():
            if name == self._name(index, "torque_limit") and not now[name]:
                continue  # a torque limit of 0 is a shutdown, and stays until the goal is where the servo stands
            yield from self._set(index, now, name, target)
        return 0

    def bring_back(self, index: int, reboot: bool) -> Steps[int]:
        number = self.tables[index]["model_number"]
        self._recognise(index, Found(self.value(index, number), None))
        yield 0.0
        yield from self.prepare(index)
        return (yield from self.torque_on(index))

    def _settings(self, index: int, now: Mapping[str, int]) -> dict[str, int]:
        """Position mode, no delay, no speed limit of its own, all of its torque unless the head's file says less."""
        settings = {each.register: each.wanted for each in self._verify(index, now) if each.then == "set"}
        settings[self._name(index, "return_delay")] = 0
        settings |= {**self._full_torque(index, now), **self.wanted(index)}
        return {name: target for name, target in settings.items() if name in now}

    def _full_torque(self, index: int, now: Mapping[str, int]) -> dict[str, int]:
        """An earlier run may have left less; `max_torque` is what the EEPROM allows."""
        limit = self.tables[index].role("torque_limit")
        return {limit.name: now["max_torque"]} if limit is not None and "max_torque" in now else {}

    def _restore_torque(self, index: int) -> Steps[None]:
        """A shutdown leaves a torque limit of 0, also when torque is switched on again."""
        table, limit = self.tables[index], self.tables[index].role("torque_limit")
        if limit is None or self.value(index, limit):
            return
        yield 0.0
        full = torque_limit(self._servos[index])
        if not full and "max_torque" in table.fields:
            full = {limit.name: self.value(index, table["max_torque"])}
        for name, value in full.items():
            yield from self._write(index, table[name], value)

    def _write(self, index: int, field: Field, value: int) -> Steps[None]:
        """A value that was not taken is told with what the servo reports beside."""
        try:
            yield from super()._write(index, field, value)
        except Silent:
            raise
        except ServoError as error:
            torque = self._field(index, "torque_enable")
            answer = self._link.read(self._servos[index].id, torque.address, torque.size)
            fault = "" if answer is None else self.tables[index].status_fault_names(answer.error)
            raise ServoError(f"{error}, and it reports a hardware error ({fault})" if fault else str(error)) from None
