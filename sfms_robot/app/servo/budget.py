"""How many bytes one tick puts on the wire, how long they take, and how often a second that can be done.

    tick = 10 bits x bytes / baud + return delay of every answer + latency of the adapter of every request answered

Protocol 2.0 writes all goals with one packet and reads everybody with one request; with fast sync read the answers
come as one packet. Servos that cannot be read together are asked one by one, and each question costs the adapter's
latency again: that is what makes factory settings slow. Boards for hobby servos are written to, and tell nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sfms_robot.config.wire_time import BITS, FRAMINGS, Way


@dataclass(frozen=True)
class Tick:
    """What one tick costs. `ms` holds wire, servos and adapter; `hz` is how often that fits into a second."""

    bytes: int
    ms: float
    hz: float


@dataclass(frozen=True)
class Budget:
    """A bus's wire budget at one baud.

    Attributes:
        write_only: goals alone.
        plain: goals, and everybody read: one sync read, or one by one where the family has none; None of a board.
        fast: goals, and everybody read by one fast sync read; None where there is no such thing.
    """

    servos: int
    baud: int
    return_delay_us: float
    latency_ms: float
    write_bytes: int
    read_bytes: int
    write_only: Tick
    plain: Tick | None
    fast: Tick | None

    @property
    def usual(self) -> Tick:
        """What a run does every tick."""
        return self.plain or self.write_only

    def plain_data(self) -> dict[str, Any]:
        """For a report; figures rounded to what they mean."""
        ticks = {"write_only": self.write_only, "plain": self.plain, "fast": self.fast}
        return {
            "servos": self.servos,
            "baud": self.baud,
            "return_delay_us": self.return_delay_us,
            "latency_ms": self.latency_ms,
            "write_bytes_per_servo": self.write_bytes,
            "read_bytes_per_servo": self.read_bytes,
            **{
                name: None if each is None else {"bytes": each.bytes, "ms": round(each.ms, 3), "hz": round(each.hz, 1)}
                for name, each in ticks.items()
            },
        }


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
        ms = size * 1e3 * BITS / baud + answers * return_delay_us / 1e3 + waits * latency_ms
        return Tick(size, ms, 1e3 / ms)

    plain = tick(goals + framing.reads(servos, read_bytes, way), servos, 1 if way == "together" else servos)
    fast = None
    if together and framing.fast:
        fast = tick(goals + framing.reads(servos, read_bytes, "fast"), 1, 1)
    return Budget(servos, baud, return_delay_us, latency_ms, write_bytes, read_bytes, tick(goals, 0, 0), plain, fast)


def board_budget(family: str, channels: int, baud: int) -> Budget:
    """Return the budget of a board of hobby servos, every channel written every tick."""
    size = FRAMINGS[family].goals(channels)
    ms = size * 1e3 * BITS / baud
    return Budget(channels, baud, 0.0, 0.0, size // channels, 0, Tick(size, ms, 1e3 / ms), None, None)
