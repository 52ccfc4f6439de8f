"""A bus of real code on emulated servos in another process, in virtual time."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest
from chain_rig import bus_of
from emulated_port import BAUD
from virtual_time import Time

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.servo.chain.protocol2 import Dynamixel2Bus, Dynamixel2Link
from sfms_robot.servo.port import VirtualTimePort


@dataclass
class Rig:
    chain: Chain
    clock: Time
    count: int
    baud: int
    bus: Dynamixel2Bus | None = None

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

    def until_all_back(self, goals_rad, limit_s: float):
        """Ticks until every joint has rejoined."""
        back: set[str] = set()

        def all_back(readings) -> bool:
            back.update(joint for joint, r in readings.items() if r.rejoined)
            return len(back) == self.count

        self.until(goals_rad, all_back, limit_s)


@contextmanager
def rig_of(
    servos: Sequence[EmulatedServo], expected: Sequence[int] = (), firmware_map=None, baud: int = BAUD, **more
) -> Iterator[Rig]:
    """`expected`, `firmware_map`: ids and model that the head names; those plugged in unless told otherwise.

    `more`: as for `bus_of`.
    """
    ids = expected or [servo.id for servo in servos]
    maps = [firmware_map or load_firmware_map("xl330-m288")] * len(ids)
    with launch(servos, virtual=True) as chain:
        rig = Rig(chain, Time(), len(ids), baud)
        rig.bus = bus_of(maps, ids, rig.port, baud=baud, **more)
        try:
            yield rig
        finally:
            rig.bus.close()


@pytest.fixture
def make_rig():
    return rig_of


@pytest.fixture
def rig() -> Iterator[Rig]:
    """Four servos that stand here and there."""
    starts = [1900, 2048, 2300, 2100]
    with rig_of([EmulatedServo(i + 1, start_ticks=ticks) for i, ticks in enumerate(starts)]) as rig:
        yield rig
