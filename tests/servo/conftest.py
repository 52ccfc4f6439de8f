"""A bus of real code on emulated servos in another process, in virtual time."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import settings

from sfms_robot.config import Bus, Faults, Safety, load_firmware_map
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.servo.chain.dynamixel2_bus import Dynamixel2Bus
from sfms_robot.servo.chain.dynamixel2_link import Dynamixel2Link
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import VirtualTimePort

settings.register_profile("no_stopwatch", deadline=None)  # a busy computer is not a failure
settings.load_profile("no_stopwatch")

RAD_PER_TICK = 2 * np.pi / 4096


class Linear:
    """Middle of the servo is 0 rad; angles outside +-limit give the ticks of the limit."""

    def __init__(self, limit_rad: float, center_ticks: int = 2048, rad_per_tick: float = RAD_PER_TICK):
        self.limit_rad = limit_rad
        self.center_ticks = center_ticks
        self.rad_per_tick = rad_per_tick

    def to_ticks(self, angles_rad):
        inside = np.clip(angles_rad, -self.limit_rad, self.limit_rad)
        return np.rint(self.center_ticks + inside / self.rad_per_tick).astype(np.int64)

    def to_rad(self, ticks):
        return (ticks - self.center_ticks) * self.rad_per_tick


@dataclass
class Time:
    """Virtual time: moves when told."""

    t: float = 0.0

    def now_s(self) -> float:
        return self.t

    def wait_until(self, time_s: float) -> None:
        self.t = max(self.t, time_s)


@dataclass
class Rig:
    chain: Chain
    clock: Time
    bus: Dynamixel2Bus
    count: int
    baud: int

    def port(self) -> VirtualTimePort:
        return VirtualTimePort(self.chain.device, self.chain.control, self.baud, self.clock)

    @contextmanager
    def link(self) -> Iterator[Dynamixel2Link]:
        """Another host on the same wire; the bus must be closed."""
        link = Dynamixel2Link(self.port(), self.baud, 0.003)
        try:
            yield link
        finally:
            link.port.close()

    def hold(self) -> np.ndarray:
        self.bus.connect()
        return self.bus.enable(self.bus.joints)

    def ticks(self, goals_rad, n: int):
        """`n` ticks of 10 ms: write, then poll; the last readings."""
        for _ in range(n):
            self.clock.t += 0.01
            self.bus.write(np.asarray(goals_rad, dtype=float), self.clock.t)
            readings = self.bus.poll(self.clock.t)
        return readings

    def until(self, goals_rad, done, limit_s: float):
        """Ticks until `done(readings)`; the seconds it took, and the readings."""
        began_s = self.clock.t
        while self.clock.t - began_s < limit_s:
            readings = self.ticks(goals_rad, 1)
            if done(readings):
                return self.clock.t - began_s, readings
        raise AssertionError(f"not within {limit_s} s")


LIMIT_RAD = 1.0


@contextmanager
def rig_of(
    servos: Sequence[EmulatedServo],
    expected: Sequence[int] = (),
    baud: int = 1_000_000,
    firmware_map=None,
    safety: Safety | None = None,
    faults: Faults | None = None,
    **config,
) -> Iterator[Rig]:
    """`expected`, `firmware_map`: ids and model that the head names; those plugged in unless told otherwise.

    `config`: of the bus, as in a head's file.
    """
    table = firmware_map or load_firmware_map("xl330-m288")
    ids = expected or [servo.id for servo in servos]
    with launch(servos, virtual=True) as chain:
        clock = Time()
        bus = Dynamixel2Bus(
            "face",
            [BusServo(f"joint{i}", i, table, -LIMIT_RAD, LIMIT_RAD, safety or Safety()) for i in ids],
            Linear(LIMIT_RAD, table.center_ticks, 2 * np.pi / table.ticks_per_revolution),
            lambda: VirtualTimePort(chain.device, chain.control, baud, clock),
            baud,
            config=Bus(family="dynamixel", baud=baud, **config),
            faults=faults,
        )
        try:
            yield Rig(chain, clock, bus, len(ids), baud)
        finally:
            bus.close()


@pytest.fixture
def make_rig():
    return rig_of


@pytest.fixture
def rig() -> Iterator[Rig]:
    """Four servos that stand here and there."""
    starts = [1900, 2048, 2300, 2100]
    with rig_of([EmulatedServo(i + 1, start_ticks=ticks) for i, ticks in enumerate(starts)]) as rig:
        yield rig


@pytest.fixture
def linear():
    return Linear
