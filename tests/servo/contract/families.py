"""What the contract needs to know of each family: its bus, a model, where its emulated servos stand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from chain_rig import bus_of
from emulated_port import Straight

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.lab.bench import campaign_rig
from sfms_robot.ports import Bus
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table

LIMIT_RAD = 0.7
STARTS_RAD = (-0.2, 0.0, 0.4, 0.1)


@dataclass(frozen=True)
class Family:
    """`bus`: its name in `servo.families`. `checksum`: of its packets, "" for none. `other`: a model that is not
    `model`, and says so when it is asked; None where nobody can tell.
    """

    bus: str
    model: str
    ids: Sequence[int]
    baud: int
    checksum: str = ""
    other: str | None = None

    @property
    def crc(self) -> bool:
        """A Maestro with "Enable CRC" on."""
        return self.checksum == "CRC-7"

    @property
    def table(self) -> Table:
        return Table.of(load_firmware_map(self.model))

    @property
    def conversion(self) -> Straight:
        return Straight(self.table, LIMIT_RAD)

    def plugged(self, model: str | None = None) -> list[EmulatedServo]:
        """Servos that stand here and there."""
        model, stored = model or self.model, {"crc": 1} if self.crc else {}
        starts = zip(self.ids, self.start_ticks(), strict=True)
        return [EmulatedServo(i, model, self.baud, ticks, registers=stored) for i, ticks in starts]

    def start_ticks(self) -> list[int]:
        return [int(t) for t in self.conversion.to_ticks(np.array(STARTS_RAD)[: len(self.ids)])]

    def build(self, open_port: Callable[[], Port], deadline_s: float) -> Bus:
        maps = [load_firmware_map(self.model)] * len(self.ids)
        options = {"baud": self.baud, "read_deadline_s": deadline_s, "crc": self.crc}
        return bus_of(maps, self.ids, open_port, LIMIT_RAD, **options)

    def on(self, servos: str) -> Family:
        """The same family with other servos: `MODEL:IDS[@BAUD]`, ids as 1-3 or 1+4."""
        model, _, rest = servos.partition(":")
        ids, _, baud = rest.partition("@")
        first, dash, last = ids.partition("-")
        numbers = range(int(first), int(last) + 1) if dash else map(int, ids.split("+"))
        return replace(self, model=model, ids=tuple(numbers), baud=int(baud or self.baud))


OTHERS = {"dynamixel2": "xl330-m077", "dynamixel1": "ax-18a", "dynamixel1-mx": "mx-64-1.0", "sts": "sts3250"}
FAMILIES = {name: Family(*row, other=OTHERS.get(name)) for name, row in campaign_rig.FAMILIES.items()}
