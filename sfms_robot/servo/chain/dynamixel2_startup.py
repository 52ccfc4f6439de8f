"""Startup of Dynamixel servos of Protocol 2.0."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Final

from sfms_robot.config import variant
from sfms_robot.errors import ConfigError
from sfms_robot.servo.chain.dynamixel2_link import Dynamixel2Link
from sfms_robot.servo.chain.link import Found
from sfms_robot.servo.chain.startup import Silent, Startup, Steps
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import contradictions

log = logging.getLogger(__name__)

_TORQUE_ON_BY_GOAL: Final = 0x08  # drive mode bit 3
_REBOOT_S: Final = 0.5  # until a rebooted servo is sure to answer
_AT_REST: Final = ("torque_enable", "present_position", "error_status")  # the last registers that startup reads


class Dynamixel2Startup(Startup[Dynamixel2Link]):
    """`Startup` with servos that tell their firmware, which decides where their registers lie."""

    can_reboot = True
    unlimited = ("profile_acceleration", "profile_velocity", "moving_speed")  # the last of the XL-320

    @property
    def family(self) -> str:
        return "dynamixel2"

    def _recognise(self, index: int, found: Found) -> None:
        """Refuse another model; take the table of the firmware that answers."""
        super()._recognise(index, found)
        table = self.tables[index]
        low, high = table.firmware
        if found.firmware is not None and not low <= found.firmware <= high:
            try:
                self.tables[index] = Table.of(variant(self._servos[index].map.model, found.firmware))
            except ConfigError as error:
                raise self._error(index, f"has firmware {found.firmware}: {error}") from error

    def _acknowledge(self, index: int) -> None:
        """Status return level 2, unconfirmed: at level 0 a servo answers pings and nothing else."""
        level = self.tables[index].role("status_level")
        if level is not None:
            self._link.sync_write(level.address, {self._servos[index].id: level.to_bytes(2)})

    # --- jobs ---------------------------------------------------------------------------------------------------

    def prepare(self, index: int) -> Steps[int]:
        table = self.tables[index]
        self._acknowledge(index)
        now = yield from self._clear_turns(index, (yield from self._state(index)))
        now = yield from self._release_outside(index, now)
        for name, target in self._settings(index, now).items():
            if name not in now:
                now[name] = self.value(index, table[name])
                yield 0.0
            written = yield from self._set(index, now, name, target)
            if written and name == self._name(index, "operating_mode"):
                now = yield from self._state(index)  # another mode resets gains, profile and goals
        error = table.role("error_status")
        return now[error.name] if error is not None else 0

    def bring_back(self, index: int, reboot: bool) -> Steps[int]:
        servo = self._servos[index].id
        if reboot:
            answer = self._link.reboot(servo)
            if answer is None:
                raise Silent(self._about(index, "does not answer to a reboot"))
            if refusal := self._link.refusal(answer):
                raise self._error(index, f"refuses to reboot: {refusal}")
            yield _REBOOT_S
        found = self._ping(index)
        if found is None:
            raise Silent(self._about(index, "does not answer to a ping"))
        self._recognise(index, found)
        yield 0.0
        yield from self.prepare(index)
        return (yield from self.torque_on(index))

    def _settings(self, index: int, now: Mapping[str, int]) -> dict[str, int]:
        """Register values before torque; the mode comes first, since it resets others."""
        settings = {each.register: each.wanted for each in self._verify(index, now) if each.then == "set"}
        settings["drive_mode"] = now.get("drive_mode", 0) & ~_TORQUE_ON_BY_GOAL
        settings[self._name(index, "return_delay")] = 0
        settings["bus_watchdog"] = 0
        if "pwm_limit" in now:  # an earlier run may have left it with less
            settings["goal_pwm"] = now["pwm_limit"]
        settings |= self.wanted(index)
        return {name: target for name, target in settings.items() if name in self.tables[index].fields}

    def _clear_turns(self, index: int, now: dict[str, int]) -> Steps[dict[str, int]]:
        """Whole turns forgotten (CLEAR) by a servo that was turned by hand past its one turn, at rest without torque.

        The shaft stays; only its reading comes back into the turn that position mode knows.
        """
        present = self._field(index, "present_position")
        found = contradictions(now, self.tables[index], self._needs[index])
        turned = any(each.register == present.name and each.fixable for each in found)
        if not turned or now[self._name(index, "torque_enable")] or now.get("moving"):
            return now
        answer = self._link.clear_turns(self._servos[index].id)
        yield 0.0
        if answer is not None and (refusal := self._link.refusal(answer)):
            raise self._error(index, f"stands at {now[present.name]}, beyond one turn, and refuses CLEAR: {refusal}")
        cleared = self.value(index, present)
        yield 0.0
        log.warning("%s", self._about(index, f"was turned past one turn: {now[present.name]} now reads {cleared}"))
        return {**now, present.name: cleared}

    def _state(self, index: int) -> Steps[dict[str, int]]:
        """Values of all registers up to those that tell the present."""
        table = self.tables[index]
        last = [field.address + field.size for role in _AT_REST if (field := table.role(role)) is not None]
        return (yield from self._snapshot(index, max(last)))
