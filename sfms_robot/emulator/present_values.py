"""The registers that an emulated servo works out anew whenever somebody reads them: position, speed, voltage, ..."""

from __future__ import annotations

import struct
from operator import itemgetter
from typing import Final

from sfms_robot.servo.registers import Table

# Registers that are worked out whenever somebody reads them, in the order of the values.
LIVE: Final = (
    "realtime_tick", "moving", "moving_status", "present_pwm", "present_current", "present_load", "present_velocity",
    "present_speed", "present_position", "velocity_trajectory", "position_trajectory", "present_input_voltage",
    "present_voltage", "present_temperature",
)  # fmt: skip
_CODES: Final = {(1, "no"): "B", (2, "no"): "H", (4, "no"): "I",
                 (1, "twos_complement"): "b", (2, "twos_complement"): "h", (4, "twos_complement"): "i"}  # fmt: skip


class PresentValues:
    """Where the live registers of a model lie. Every X-series table holds them in one block: one struct fills it."""

    def __init__(self, table: Table) -> None:
        fields = [table[name] for name in LIVE if name in table.fields]
        self._pick = itemgetter(*(i for i, name in enumerate(LIVE) if name in table.fields))
        self._fields = fields
        self.address = min(field.address for field in fields)
        self.end = max(field.address + field.size for field in fields)
        speed = table.fields.get("present_velocity") or table["present_speed"]
        self.speed_per_tick = 60.0 / (table.ticks_per_revolution * speed.scale)
        current = table.fields.get("present_current")
        self.mA_per_tick = current.scale if current is not None else 1.0
        layout = struct.Struct("<" + "".join(_CODES.get((field.size, field.sign), "") for field in fields))
        in_order = [f.address for f in fields] == sorted(f.address for f in fields)
        self._block = layout if in_order and layout.size == self.end - self.address else None

    def put(self, raw: bytearray, values: tuple[int, ...]) -> None:
        chosen = self._pick(values)
        if self._block is not None:
            self._block.pack_into(raw, self.address, *chosen)
            return
        for field, value in zip(self._fields, chosen, strict=True):
            held = min(max(value, field.low), field.high)
            raw[field.address : field.address + field.size] = field.to_bytes(held)
