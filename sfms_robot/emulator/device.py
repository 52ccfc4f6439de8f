"""Devices on an emulated wire: each receives bytes and answers in packets.

`EmulatedServo` is plain data, so that the process of an emulated chain loads neither configs nor libraries.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol

from sfms_robot.servo.registers import Table

_DEVICES: Final = {  # (family, protocol) -> class; imported only when something of it is plugged in
    ("dynamixel", 2): "sfms_robot.emulator.dynamixel2_chain:Dynamixel2Chain",
    ("dynamixel", 1): "sfms_robot.emulator.protocol1_chain:Protocol1Chain",
    ("feetech", 1): "sfms_robot.emulator.protocol1_chain:Protocol1Chain",
    ("maestro", None): "sfms_robot.emulator.pulse_boards:MaestroBoard",
    ("ssc32", None): "sfms_robot.emulator.pulse_boards:Ssc32Board",
}


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


class Reply(NamedTuple):
    """One packet on the wire: who sends it, and how long the line is quiet before."""

    servos: tuple[int, ...]
    data: bytes
    pause_s: float = 0.0


class Device(Protocol):
    """All that is plugged in of one protocol, or one board. It hears every byte of the wire and keeps its own place.

    It may also have `replies(data, baud, now_s)`, a sequence of `Reply`, which `receive` joins: with it the wire knows
    who says what, and when.
    """

    def receive(self, data: bytes, baud: int | None, now_s: float) -> bytes: ...

    def servo(self, servo_id: int) -> Any:
        """The servo or channel of that id, or None."""

    def advance(self, now_s: float) -> None:
        """Move everything on to `now_s`."""


def plugged(servos: Sequence[EmulatedServo], tables: Mapping[str, Table], chain_break: bool = True) -> list[Device]:
    """Every protocol's servos as one device, and every board; `tables` by model."""
    groups: dict[tuple[str, str], list[EmulatedServo]] = {}
    for servo in servos:
        table = tables[servo.model]
        where = _DEVICES[table.family, table.protocol]
        groups.setdefault((where, "" if table.channels is None else table.model), []).append(servo)
    devices: list[Device] = []
    for (where, board), members in groups.items():
        module, _, name = where.partition(":")
        kind: Any = getattr(importlib.import_module(module), name)
        devices.append(kind(tables[board], members) if board else kind.of(members, tables, chain_break))
    return devices


def servos_of(device: Device) -> Iterator[Any]:
    """Every servo or channel of a device."""
    for servo_id in range(256):
        servo = device.servo(servo_id)
        if servo is not None:
            yield servo


def replies_of(device: Device, data: bytes, baud: int | None, now_s: float) -> Sequence[Reply]:
    """What a device answers, packet by packet as far as it tells them apart."""
    replies = getattr(device, "replies", None)
    if replies is not None:
        told: Sequence[Reply] = replies(data, baud, now_s)
        return told
    answer = device.receive(data, baud, now_s)
    return [Reply((), answer)] if answer else ()
