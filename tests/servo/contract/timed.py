"""A bus of any chain family on a port where silence costs time: the clock moves by what travels and is waited for."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from families import FAMILIES, LIMIT_RAD, Family

from sfms_robot.config import Bus as BusConfig
from sfms_robot.config import Faults, Safety, load_firmware_map
from sfms_robot.emulator.device import Device, replies_of
from sfms_robot.emulator.dynamixel2_chain import Dynamixel2Chain
from sfms_robot.emulator.protocol1_chain import Protocol1Chain
from sfms_robot.servo.chain.chain_bus import ChainBus
from sfms_robot.servo.families import family_named
from sfms_robot.servo.policy import BusServo

CHAINS = [name for name, family in FAMILIES.items() if not family_named(family.bus).board]
READ_DEADLINE_S = 0.003


@dataclass
class Time:
    t: float = 0.0

    def now_s(self) -> float:
        return self.t


@dataclass
class TimedPort:
    """`servo.port.Port` onto a device in this process. Bytes take their time on the wire, and so does waiting.

    Attributes:
        mute: ids that hear and obey, and do not answer; on a chain those behind them do not either.
        lose: whether an answer of an id is lost on its way.
        deaf: what the host sends is lost.
        sent: (when, bytes) of everything written.
    """

    device: Device
    clock: Time
    baud: int
    name: str = "timed"
    mute: set[int] = field(default_factory=set)
    lose: Callable[[int], bool] = lambda servo: False
    deaf: bool = False
    sent: list[tuple[float, bytes]] = field(default_factory=list)
    _coming: deque[tuple[float, bytes]] = field(default_factory=deque)

    def write(self, data: bytes) -> None:
        self.clock.t += len(data) * 10 / self.baud
        self.sent.append((self.clock.t, bytes(data)))
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
            self.clock.t = max(self.clock.t, deadline_s)
            return b""
        due_s, data = self._coming.popleft()
        self.clock.t = max(self.clock.t, due_s)
        return data

    def discard_input(self) -> None:
        while self._coming and self._coming[0][0] <= self.clock.t:
            self._coming.popleft()

    def now_s(self) -> float:
        return self.clock.t

    def wait_until(self, time_s: float) -> None:
        self.clock.t = max(self.clock.t, time_s)

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        self._coming.clear()


@dataclass
class Timed:
    """`period_s` between ticks, as far as the bus leaves time."""

    family: Family
    bus: ChainBus
    port: TimedPort
    clock: Time
    count: int
    period_s: float = 0.01
    polls_s: list[float] = field(default_factory=list)
    loop_origin_s: float = 0.0

    @property
    def ids(self) -> list[int]:
        return list(range(1, self.count + 1))

    def hold(self) -> np.ndarray:
        self.bus.connect()
        return self.bus.enable(self.bus.joints)

    def tick(self, goals_rad):
        """Write, then poll; how long the poll took is kept."""
        due_s = (math.floor(self.clock.t / self.period_s) + 1) * self.period_s
        self.clock.t = max(self.clock.t, due_s)
        self.bus.write(np.asarray(goals_rad, float), self.clock.t - self.loop_origin_s)
        began_s = self.clock.t
        readings = self.bus.poll(self.clock.t - self.loop_origin_s)
        self.polls_s.append(self.clock.t - began_s)
        return readings

    def ticks(self, goals_rad, n: int):
        for _ in range(n):
            readings = self.tick(goals_rad)
        return readings

    def register(self, servo_id: int, role: str) -> int:
        servo = self.port.device.servo(servo_id)
        here = servo.table.role(role)
        return here.from_bytes(servo.read(here.address, here.size, self.clock.t)[1])

    def torques(self) -> list[int]:
        return [self.register(servo, "torque_enable") for servo in self.ids]


def timed(
    name: str,
    count: int = 28,
    clock: Time | None = None,
    safety: Safety | None = None,
    faults: Faults | None = None,
    baud: int = 1_000_000,
    model: str | None = None,
    **config,
) -> Timed:
    """`count` servos with ids from 1 on, standing in the middle."""
    family = FAMILIES[name].on(f"{model}:1") if model else FAMILIES[name]
    table, clock = family.table, clock or Time()
    row = {"model": table.model, "baud": baud, "start_ticks": table.center_ticks, "firmware": 53, "registers": {}}
    rows = [{**row, "id": i, "supply_v": None} for i in range(1, count + 1)]
    kind = Dynamixel2Chain if table.protocol == 2 else Protocol1Chain
    port = TimedPort(kind.from_rows(rows, {table.model: table}), clock, baud)
    firmware_map = load_firmware_map(family.model)
    servos = [
        BusServo(f"joint{i}", i, firmware_map, -LIMIT_RAD, LIMIT_RAD, safety or Safety()) for i in range(1, count + 1)
    ]
    options = BusConfig(family="dynamixel", baud=baud, **config)
    bus = family.bus_class()(
        "face", servos, family.conversion, lambda: port, baud, READ_DEADLINE_S, config=options, faults=faults
    )
    return Timed(family, bus, port, clock, count, 1 / options.rate_hz)
