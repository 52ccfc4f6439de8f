"""How many bytes one tick puts on the wire, how long they take, and how often a second that can be done.

    tick = 10 bits x bytes / baud + return delay of every answer + latency of the adapter of every request answered

Protocol 2.0 writes all goals with one packet and reads everybody with one request; with fast sync read the answers
come as one packet. Servos that cannot be read together are asked one by one, and each question costs the adapter's
latency again: that is what makes factory settings slow. Boards for hobby servos are written to, and tell nothing.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Self

from sfms_robot.config.wire_time import BITS, FRAMINGS, Way


@dataclass(frozen=True)
class Tick:
    """Cost of one tick, rounded. `ms` holds wire, servos and adapter; `hz` is how often that fits into a second."""

    bytes: int
    ms: float
    hz: float

    @classmethod
    def of(cls, size: int, ms: float) -> Self:
        """Return the tick of so many bytes."""
        return cls(size, round(ms, 3), round(1e3 / ms, 1))


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Wire budget of a bus at one baud; data per servo and tick in bytes.

    Attributes:
        write_only: goals alone.
        plain: goals, and everybody read: one sync read, or one by one where the family has none; None of a board.
        fast: goals, and everybody read by one fast sync read; None where there is no such thing.
    """

    servos: int
    baud: int
    return_delay_us: float
    latency_ms: float
    write_bytes_per_servo: int
    read_bytes_per_servo: int
    write_only: Tick
    plain: Tick | None
    fast: Tick | None

    @property
    def usual(self) -> Tick:
        """What a run does every tick."""
        return self.plain or self.write_only

    def plain_data(self) -> dict[str, Any]:
        """Return it for a report."""
        return asdict(self)


def wire_budget(
    family: str,
    servos: int,
    baud: int,
    return_delay_us: float,
    latency_ms: float,
    read_bytes: int,
    write_bytes: int = 4,
    together: bool = True,
) -> Budget:
    """The budget of `servos` servos; `together` is False where they cannot answer one sync read.

    Args:
        return_delay_us: what a servo waits before it answers.
        latency_ms: what the adapter waits before it hands bytes to the host.
        read_bytes, write_bytes: data per servo and tick.
    """
    framing = FRAMINGS[family]
    goals = framing.goals(servos, write_bytes)
    way: Way = "together" if together and family != "dynamixel1" else "one by one"  # AX cannot be read together

    def tick(size: int, answers: int, waits: int) -> Tick:
        return Tick.of(size, size * 1e3 * BITS / baud + answers * return_delay_us / 1e3 + waits * latency_ms)

    return Budget(
        servos=servos,
        baud=baud,
        return_delay_us=return_delay_us,
        latency_ms=latency_ms,
        write_bytes_per_servo=write_bytes,
        read_bytes_per_servo=read_bytes,
        write_only=tick(goals, 0, 0),
        plain=tick(goals + framing.reads(servos, read_bytes, way), servos, 1 if way == "together" else servos),
        fast=tick(goals + framing.reads(servos, read_bytes, "fast"), 1, 1) if together and framing.fast else None,
    )


def board_budget(family: str, channels: int, baud: int, crc: bool = False) -> Budget:
    """Return the budget of a board of hobby servos, every channel written every tick, with a CRC each or without."""
    size = FRAMINGS[family].goals(channels) + crc * channels
    return Budget(
        servos=channels,
        baud=baud,
        return_delay_us=0.0,
        latency_ms=0.0,
        write_bytes_per_servo=size // channels,
        read_bytes_per_servo=0,
        write_only=Tick.of(size, size * 1e3 * BITS / baud),
        plain=None,
        fast=None,
    )
