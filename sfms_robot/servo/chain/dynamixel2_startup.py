"""First contact with Dynamixel 2.0: who is there, is it what the head says, and torque on without a jump."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from sfms_robot.config import variant
from sfms_robot.errors import ConfigError
from sfms_robot.servo.chain.dynamixel2_link import Dxl2Link
from sfms_robot.servo.chain.link import Answer, Found
from sfms_robot.servo.chain.startup import PATIENCE_S, Contact, Silent, Steps, finish
from sfms_robot.servo.codecs.dxl2 import ALERT, error_text
from sfms_robot.servo.policy import torque_limit
from sfms_robot.servo.registers import Table

_POSITION_MODE: Final = 3
_CURRENT_POSITION_MODE: Final = 5
_TORQUE_ON_BY_GOAL: Final = 0x08  # drive mode bit 3
_REBOOT_S: Final = 0.5  # until a rebooted servo is sure to answer
_LONGEST_READ: Final = 128


class Handshake(Contact[Dxl2Link]):
    """`Contact` with servos that tell their firmware, which decides where their registers lie."""

    can_reboot = True

    # --- start-up -----------------------------------------------------------------------------------------------

    def run(self) -> list[int]:
        with self._link.patient(PATIENCE_S):
            self._identify()
            for index in range(len(self._servos)):
                self._speak_up(index)
            return [finish(self.prepare(index)) for index in range(len(self._servos))]

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

    def _speak_up(self, index: int) -> None:
        """Unheard: at status level 0 a servo acknowledges nothing."""
        level = self.tables[index].role("status_level")
        if level is not None:
            self._link.sync_write(level.address, {self._servos[index].id: level.to_bytes(2)})

    # --- jobs ---------------------------------------------------------------------------------------------------

    def prepare(self, index: int) -> Steps[int]:
        """Mode, gains, profile and limits, before torque; the latched hardware errors."""
        now = yield from self._snapshot(index)
        wanted = self._wanted(index, now)
        self._compare(index, now | wanted)
        torque = now[self._name(index, "torque_enable")]
        for name, target in wanted.items():
            if now[name] == target:
                continue
            if self.tables[index][name].eeprom and torque:
                if name == self._name(index, "return_delay"):
                    continue  # slower, not wrong
                raise self._error(index, f"has torque on and {name} {now[name]}, must be {target}: release it first")
            yield from self._put(index, name, target)
            if name == self._name(index, "operating_mode"):
                now = yield from self._snapshot(index)  # another mode resets gains, profile and goals
        error = self.tables[index].role("error_status")
        return now[error.name] if error is not None else 0

    def _compare(self, index: int, now: Mapping[str, int]) -> None:
        """Refuse what is stored in the servo where the head's file says otherwise: it is for a person to change."""
        for name, value in self._servos[index].safety.stored.items():
            if now.get(name) != value:
                mend = f"sfms-robot servo write {self._servos[index].id} {name} {value}"
                raise self._error(index, f"has {name} {now.get(name)} stored, the head's file says {value} ({mend})")

    def torque_on(self, index: int) -> Steps[int]:
        present = self.get(index, self._name(index, "present_position"))
        yield 0.0
        yield from self._put(index, self._name(index, "goal_position"), present)
        yield from self._put(index, self._name(index, "torque_enable"), 1)
        return present

    def bring_back(self, index: int, reboot: bool) -> Steps[int]:
        servo = self._servos[index].id
        if reboot:
            self._repeat(index, "reboot", lambda: self._link.reboot(servo))
            yield _REBOOT_S
        found = self._link.ping(servo)
        if found is None:
            raise Silent(self._about(index, "does not answer to a ping"))
        self._recognise(index, found)
        self._speak_up(index)
        yield 0.0
        yield from self.prepare(index)
        return (yield from self.torque_on(index))

    def _wanted(self, index: int, now: Mapping[str, int]) -> dict[str, int]:
        """Register values before torque; the mode comes before what it resets."""
        table, safety = self.tables[index], self._servos[index].safety
        current = table.fields.get("goal_current") if safety.current_limit_mA is not None else None
        mode = table.position_mode or _POSITION_MODE
        wanted = {
            self._name(index, "operating_mode"): _CURRENT_POSITION_MODE if current is not None else mode,
            "drive_mode": now.get("drive_mode", 0) & ~_TORQUE_ON_BY_GOAL,
            self._name(index, "return_delay"): 0,
            **dict.fromkeys(("bus_watchdog", "profile_acceleration", "profile_velocity"), 0),
        }
        if "pwm_limit" in now:  # an earlier run may have left it with less
            wanted["goal_pwm"] = now["pwm_limit"]
        wanted |= torque_limit(self._servos[index])
        if current is not None and safety.current_limit_mA is not None:
            wanted[current.name] = min(current.high, round(safety.current_limit_mA / current.scale))
        wanted |= safety.registers
        return {name: target for name, target in wanted.items() if name in table.fields}

    def _snapshot(self, index: int) -> Steps[dict[str, int]]:
        """Values of all registers up to those that tell the present, in as few reads as they take."""
        table = self.tables[index]
        told = [table.role(role) for role in ("torque_enable", "present_position", "error_status")]
        last = max(field.address for field in told if field is not None)
        fields = [field for field in table.fields.values() if field.address <= last]
        end = max(field.address + field.size for field in fields)
        memory = bytearray()
        for start in range(0, end, _LONGEST_READ):
            length = min(_LONGEST_READ, end - start)
            answer = self._ask(index, "reading its registers", start, length)
            memory += answer.data
            yield 0.0
        return {field.name: field.from_bytes(memory[field.address :]) for field in fields}

    # --- exchanges ----------------------------------------------------------------------------------------------

    def get(self, index: int, name: str) -> int:
        """A register's value. Raises ServoError when the servo refuses, `Silent` when it does not answer."""
        field = self.tables[index][name]
        return field.from_bytes(self._ask(index, f"reading {name}", field.address, field.size).data)

    def _put(self, index: int, name: str, value: int) -> Steps[None]:
        """Write a register and read it back."""
        field, servo = self.tables[index][name], self._servos[index].id
        try:
            data = field.to_bytes(value)
        except OverflowError:
            raise self._error(index, f"{name} = {value} does not fit the register") from None
        self._repeat(index, f"{name} := {value}", lambda: self._link.write(servo, field.address, data))
        yield 0.0
        if (now := self.get(index, name)) != value:
            raise self._error(index, f"{name} was set to {value} and reads {now}")
        yield 0.0

    def _ask(self, index: int, what: str, address: int, length: int) -> Answer:
        servo = self._servos[index].id
        return self._repeat(index, what, lambda: self._link.read(servo, address, length))

    def _refusal(self, answer: Answer) -> str:
        if not answer.error & ~ALERT:
            return ""
        return error_text(answer.error) + (", and reports a hardware error" if answer.error & ALERT else "")

    def _name(self, index: int, role: str) -> str:
        """Name of the register of a role; the role itself where the model has none."""
        field = self.tables[index].role(role)
        return role if field is None else field.name
