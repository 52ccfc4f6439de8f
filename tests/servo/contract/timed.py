"""A bus of any chain family on a port where silence costs time: the clock moves by what travels and is waited for."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from chain_rig import BusRig, bus_of
from emulated_devices import device_of, servos_of
from emulated_port import EmulatedPort
from families import FAMILIES, LIMIT_RAD, Family
from virtual_time import Time

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.device import replies_of
from sfms_robot.servo.families import family_named

CHAINS = [name for name, family in FAMILIES.items() if not family_named(family.bus).board]
READ_DEADLINE_S = 0.003


@dataclass
class TimedPort(EmulatedPort):
    """Bytes take their time on the wire, and so does waiting.

    Attributes:
        mute: ids that hear and obey, and do not answer; on a chain those behind them do not either.
        lose: whether an answer of an id is lost on its way.
        deaf: what the host sends is lost.
        sent_at_s: when, of everything in `sent`.
    """

    mute: set[int] = field(default_factory=set)
    lose: Callable[[int], bool] = lambda servo: False
    deaf: bool = False
    sent_at_s: list[float] = field(default_factory=list)
    _coming: deque[tuple[float, bytes]] = field(default_factory=deque)

    def write(self, data: bytes) -> None:
        self.clock.t += len(data) * 10 / self.baud
        self.sent.append(bytes(data))
        self.sent_at_s.append(self.clock.t)
        if self.deaf:
            return
        due_s = self.clock.t
        for servos, answer, pause_s in replies_of(self.device, data, self.baud, self.clock.t):
            if self.mute & set(servos):
                if len(servos) > 1:  # a fast read: one packet that stops where somebody is silent
                    whole = (len(answer) - 8) // len(servos)
                    first = min(servos.index(servo) for servo in self.mute if servo in servos)
                    answer = answer[: 8 + first * whole] if first else b""
                    self._coming.append((due_s + len(answer) * 10 / self.baud, answer))
                return
            due_s += pause_s + len(answer) * 10 / self.baud
            if not any(self.lose(servo) for servo in servos):
                self._coming.append((due_s, answer))

    def read(self, n: int, deadline_s: float) -> bytes:
        while self._coming and not self._coming[0][1]:
            self._coming.popleft()
        if not self._coming or self._coming[0][0] > deadline_s:
            self.clock.wait_until(deadline_s)
            return b""
        due_s, data = self._coming.popleft()
        self.clock.wait_until(due_s)
        return data

    def discard_input(self) -> None:
        while self._coming and self._coming[0][0] <= self.clock.t:
            self._coming.popleft()


@dataclass
class Timed(BusRig):
    """`period_s` between ticks, as far as the bus leaves time."""

    port: TimedPort
    family: Family
    count: int
    period_s: float = 0.01
    polls_s: list[float] = field(default_factory=list)
    loop_origin_s: float = 0.0

    @property
    def ids(self) -> list[int]:
        return list(range(1, self.count + 1))

    def tick(self, goals_rad):
        """Write, then poll; how long the poll took is kept."""
        self.clock.wait_until((math.floor(self.clock.t / self.period_s) + 1) * self.period_s)
        self.bus.write(np.asarray(goals_rad, float), self.clock.t - self.loop_origin_s)
        began_s = self.clock.t
        readings = self.bus.poll(self.clock.t - self.loop_origin_s)
        self.polls_s.append(self.clock.t - began_s)
        return readings

    def ticks(self, goals_rad, n: int):
        for _ in range(n):
            readings = self.tick(goals_rad)
        return readings


def timed(name: str, count: int = 28, clock: Time | None = None, **more) -> Timed:
    """`count` servos with ids from 1 on, standing in the middle. `more`: as for `bus_of`."""
    family = FAMILIES[name]
    ids, maps = range(1, count + 1), [load_firmware_map(family.model)] * count
    port = TimedPort(device_of(*servos_of(family.model, *ids)), clock=clock or Time(), name="timed")
    bus = bus_of(maps, ids, lambda: port, LIMIT_RAD, read_deadline_s=READ_DEADLINE_S, **more)
    return Timed(port, bus, family, count, 1 / bus._config.rate_hz)
