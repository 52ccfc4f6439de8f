"""A bus of any chain family on a port where silence costs time: the clock moves by what travels and is waited for."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from chain_rig import BusRig, bus_of
from emulated_devices import device_of, servos_of
from emulated_port import BAUD, EmulatedPort
from families import FAMILIES, LIMIT_RAD, Family
from virtual_time import Time

from sfms_robot.config import load_firmware_map
from sfms_robot.servo.families import family_named

CHAINS = [name for name, family in FAMILIES.items() if not family_named(family.bus).board]
READ_DEADLINE_S = 0.003
FRAME_S = 0.001  # of a USB adapter


@dataclass
class TimedPort(EmulatedPort):
    """Bytes take their time on the wire, and so does waiting. What has come is handed over every `FRAME_S`.

    Attributes:
        mute: ids that hear and obey, and do not answer; on a chain those behind them do not either.
        lose: whether an answer of an id is lost on its way.
        deaf: what the host sends is lost.
        held_s: how long the adapter holds an answer back.
        sent_at_s: when, of everything in `sent`.
    """

    mute: set[int] = field(default_factory=set)
    lose: Callable[[int], bool] = lambda servo: False
    deaf: bool = False
    held_s: float = 0.0
    sent_at_s: list[float] = field(default_factory=list)
    _coming: deque[tuple[float, bytes]] = field(default_factory=deque)

    def write(self, data: bytes) -> None:
        self.clock.t += len(data) * 10 / self.baud
        self.sent.append(bytes(data))
        self.sent_at_s.append(self.clock.t)
        if self.deaf:
            return
        due_s = self.clock.t + self.held_s
        for servos, answer, pause_s in self.device.replies(data, self.baud, self.clock.t):
            if self.mute & set(servos):
                if len(servos) > 1:  # a fast read: one packet that stops where somebody is silent
                    whole = (len(answer) - 8) // len(servos)
                    first = min(servos.index(servo) for servo in self.mute if servo in servos)
                    answer = answer[: 8 + first * whole] if first else b""
                    self._comes(answer, due_s)
                return
            due_s += pause_s
            if not any(self.lose(servo) for servo in servos):
                self._comes(answer, due_s)
            due_s += len(answer) * 10 / self.baud

    def _comes(self, answer, begins_s):
        byte_s = 10 / self.baud
        size = max(1, math.floor(FRAME_S / byte_s))
        for first in range(0, len(answer), size):
            part = answer[first : first + size]
            self._coming.append((begins_s + (first + len(part)) * byte_s, part))

    def read(self, n: int, deadline_s: float) -> bytes:
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
        self.clock.wait_until((math.floor(self.clock.t / self.period_s + 1e-6) + 1) * self.period_s)
        self.bus.write(np.asarray(goals_rad, float), self.clock.t - self.loop_origin_s)
        began_s = self.clock.t
        readings = self.bus.poll(self.clock.t - self.loop_origin_s)
        self.polls_s.append(self.clock.t - began_s)
        return readings

    def ticks(self, goals_rad, n: int):
        for _ in range(n):
            readings = self.tick(goals_rad)
        return readings

    def ticks_for(self, duration_s: float, goals_rad):
        """As many as a time has room for."""
        end_s = self.clock.t + duration_s
        while self.clock.t < end_s:
            readings = self.tick(goals_rad)
        return readings


def timed(name: str, count: int = 28, clock: Time | None = None, held_s: float = 0.0, **more) -> Timed:
    """`count` servos with ids from 1 on, standing in the middle. `more`: as for `bus_of`."""
    family = FAMILIES[name]
    ids, maps = range(1, count + 1), [load_firmware_map(family.model)] * count
    baud = more.get("baud", BAUD)
    servos = servos_of(family.model, *ids, baud=baud)
    port = TimedPort(device_of(*servos), baud, clock or Time(), "timed", held_s=held_s)
    bus = bus_of(maps, ids, lambda: port, LIMIT_RAD, read_deadline_s=READ_DEADLINE_S, **more)
    return Timed(port, bus, family, count, 1 / bus._config.rate_hz)
