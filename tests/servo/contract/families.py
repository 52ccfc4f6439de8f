"""What the contract needs to know of each family: its bus, a model, where its emulated servos stand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.ports import Bus
from sfms_robot.servo.families import family_named
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table

LIMIT_RAD = 0.7
STARTS_RAD = (-0.2, 0.0, 0.4, 0.1)


@dataclass(frozen=True)
class Family:
    """`bus`: its name in `servo.families`. `other`: a model that is not `model`, and says so when it is asked; None
    where nobody can tell.
    """

    bus: str
    model: str
    ids: Sequence[int] = (1, 2, 3, 4)
    baud: int = 1_000_000
    other: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def table(self) -> Table:
        return Table.of(load_firmware_map(self.model))

    @property
    def conversion(self) -> Linear:
        table = self.table
        return Linear(table.center_ticks, 2 * math.pi / table.ticks_per_revolution)

    def plugged(self, model: str | None = None) -> list[EmulatedServo]:
        """Servos that stand here and there."""
        starts = self.start_ticks()
        return [EmulatedServo(i, model or self.model, self.baud, t) for i, t in zip(self.ids, starts, strict=True)]

    def start_ticks(self) -> list[int]:
        return [int(t) for t in self.conversion.to_ticks(np.array(STARTS_RAD)[: len(self.ids)])]

    def bus_class(self) -> Any:
        return family_named(self.bus).bus_class()

    def build(self, open_port: Callable[[], Port], deadline_s: float) -> Bus:
        firmware_map = load_firmware_map(self.model)
        servos = [BusServo(f"joint{i}", i, firmware_map, -LIMIT_RAD, LIMIT_RAD) for i in self.ids]
        bus: Bus = self.bus_class()("face", servos, self.conversion, open_port, self.baud, deadline_s, **self.options)
        return bus

    def on(self, servos: str) -> Family:
        """The same family with other servos: `MODEL:IDS[@BAUD]`, ids as 1-3 or 1+4."""
        model, _, rest = servos.partition(":")
        ids, _, baud = rest.partition("@")
        first, dash, last = ids.partition("-")
        numbers = range(int(first), int(last) + 1) if dash else map(int, ids.split("+"))
        return replace(self, model=model, ids=tuple(numbers), baud=int(baud or self.baud))


@dataclass(frozen=True)
class Linear:
    """Middle of the servo is 0 rad; angles outside the limits give the ticks of the limit."""

    center_ticks: int
    rad_per_tick: float

    def to_ticks(self, angles_rad):
        inside = np.clip(angles_rad, -LIMIT_RAD, LIMIT_RAD) / self.rad_per_tick
        highest = math.floor(LIMIT_RAD / self.rad_per_tick)
        return self.center_ticks + np.clip(np.rint(inside), -highest, highest).astype(np.int64)

    def to_rad(self, ticks):
        return (np.asarray(ticks) - self.center_ticks) * self.rad_per_tick


SURE = {"confirmed": True}  # hobby servos jump to their first pose, and the tests know it
FAMILIES = {
    "dynamixel2": Family("dynamixel2", "xl330-m288", other="xl330-m077"),
    "dynamixel1": Family("dynamixel1", "ax-12a", other="ax-18a"),
    "dynamixel1-mx": Family("dynamixel1", "mx-28-1.0", other="mx-64-1.0"),
    "sts": Family("feetech", "sts3215", other="sts3250"),
    "scs": Family("feetech", "scs0009"),
    "maestro": Family("maestro", "maestro-24", (0, 1, 2, 5), 115200, options=SURE),
    "ssc32": Family("ssc32", "ssc-32", (0, 1, 2, 5), 115200, options=SURE),
}
