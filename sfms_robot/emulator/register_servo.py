"""What every emulated servo with a control table is: a register file, a plant, a supply, and somebody who looks on.

What its firmware makes of an instruction is the subclass's business.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Final, Protocol

from sfms_robot.emulator.emulated_servo import EmulatedServo
from sfms_robot.emulator.plant import MotorCommand, Plant
from sfms_robot.emulator.register_file import RegisterFile
from sfms_robot.servo.registers import Table

_BROWN_OUT: Final = 0.7  # of the lowest supply it allows: below that the controller itself stops


class Frame(Protocol):
    """Position registers <-> ticks of the shaft, as the registers stand. `sign`: -1 where they count the other way."""

    sign: float

    def reported(self, shaft: float) -> float: ...

    def shaft(self, told: float) -> float: ...


class RegisterServo(ABC):
    """A servo that answers instructions. All times are seconds of the wire's clock.

    Attributes:
        dead: silent, as with its cable out; its motor keeps doing what it was told.
        mute: it obeys, and never answers.
        fault_status: bits of what is wrong with it.
        plant: what turns; its ticks are those of the shaft.
    """

    id: int
    baud: int | None
    supply_v: float
    _frame: Frame
    _bits: dict[str, int]  # of `fault_status`, by the name of the fault

    def __init__(self, table: Table, size: int | None = None) -> None:
        self.table = table
        self.dead = self.mute = False
        self.fault_status = 0
        self.plant = Plant(0.0)
        self._file = RegisterFile(table, size)
        self._get, self._put = self._file.get, self._file.put
        self._drive: MotorCommand | None = None
        self._powered = True

    def _take_stored(self, what: EmulatedServo) -> None:
        """What somebody has stored in it before."""
        self._put_role("id", what.id)
        self._put_role("baud_rate", next(code for code, rate in self.table.baud_codes.items() if rate == what.baud))
        for name, value in what.registers.items():
            self._put(name, value)

    # --- what happens to it -------------------------------------------------------------------------------------

    @abstractmethod
    def advance(self, now_s: float) -> None:
        """Move the plant on, and see what that did to it."""

    @abstractmethod
    def fail(self, status: int, now_s: float) -> None:
        """Faults, as bits of `fault_status`; those it is told to give way to take the torque away."""

    def fail_named(self, fault: str, now_s: float) -> None:
        """The same by name: overheating, overload."""
        self.fail(self._bits[fault], now_s)

    def set_supply(self, volts: float, now_s: float) -> None:
        """Too low stops the controller; when it comes back the servo starts anew."""
        self.advance(now_s)
        self.supply_v = volts
        was_powered, self._powered = self._powered, volts >= _BROWN_OUT * self._volts("min_voltage_limit")
        if not self._powered:
            self._lose_power()
        elif not was_powered:
            self._start_anew(now_s)
        self._watch_supply()

    @abstractmethod
    def _lose_power(self) -> None:
        """The controller stops."""

    @abstractmethod
    def _start_anew(self, now_s: float) -> None:
        """The supply is back."""

    @abstractmethod
    def _watch_supply(self) -> None:
        """See whether the supply is within the servo's limits."""

    def turn(self, ticks: float, now_s: float) -> None:
        """Somebody turns the shaft by hand, to where its position reads `ticks`."""
        self.advance(now_s)
        self.plant.position = self._frame.shaft(ticks)

    def state(self, now_s: float) -> dict[str, Any]:
        """What an onlooker sees, whatever the wire says."""
        self.advance(now_s)
        return {
            "position": self._frame.reported(self.plant.position),
            "speed": self._frame.sign * self.plant.speed,
            "goal": self._get("goal_position"),
            "torque": self._powered and self._role("torque_enable") == 1,
            "faults": self._fault_names(),
            "temperature_C": self.plant.temperature_C,
        }

    @abstractmethod
    def _fault_names(self) -> str:
        """`fault_status` in words."""

    # --- registers ----------------------------------------------------------------------------------------------

    def _volts(self, name: str) -> float:
        return self.table[name].to_unit(self._get(name))

    def _role(self, role: str) -> int:
        """Value of a role's register; a role that the model does not have reads as 1: it limits nothing."""
        field = self.table.role(role)
        return 1 if field is None else self._get(field.name)

    def _put_role(self, role: str, value: int) -> None:
        field = self.table.role(role)
        if field is not None:
            self._put(field.name, value)
