"""What is plugged in: plain data, so that the process of an emulated chain loads neither configs nor libraries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class EmulatedServo:
    """What is plugged in, or on a board one of its channels.

    `start_ticks`: what its position reads when the host comes, torque off: outside its limits, or beyond one turn where
    somebody has turned it by hand since it was switched on. `registers`: what somebody stored in it before, by name
    (homing offset, position limits, shutdown, ...). `supply_v` None: a voltage that it is content with.
    """

    id: int
    model: str = "xl330-m288"
    baud: int = 1_000_000
    start_ticks: int = 2048
    firmware: int = 53
    registers: Mapping[str, int] = field(default_factory=dict)
    supply_v: float | None = None
