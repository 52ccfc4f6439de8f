"""A bus of Dynamixel 2.0 servos that are emulated in this process, behind an adapter that can be unplugged."""

from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest
from chain_rig import ServoRig, bus_of
from emulated_devices import device_of
from emulated_port import BAUD, EmulatedPort
from virtual_time import Time

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.emulated_wire import EmulatedServo
from sfms_robot.errors import BusError, PortError
from sfms_robot.servo.chain.protocol2 import Dynamixel2Link


@dataclass
class Plugged(EmulatedPort):
    """A port that is gone for good when its adapter is unplugged."""

    gone: bool = False

    def write(self, data):
        if self.gone:
            raise BusError("gone")
        super().write(data)

    def read(self, n, deadline_s):
        if self.gone:
            raise BusError("gone")
        return super().read(n, deadline_s)


class Rig(ServoRig):
    """`bus` names ids and model as the head does; those plugged in may be others."""

    def __init__(self, servos, expected=(), firmware_map=None, **more):
        ids = expected or [servo.id for servo in servos]
        maps = [firmware_map or load_firmware_map("xl330-m288")] * len(ids)
        self.count, self.unplugged = len(ids), False
        super().__init__(Plugged(device_of(*servos), clock=Time()))
        self.bus = bus_of(maps, ids, self.open_port, **more)

    def open_port(self):
        if self.unplugged:
            raise PortError("emulated: no such device")
        self.port = Plugged(self.device, clock=self.clock)
        return self.port

    @contextmanager
    def link(self):
        """Another host on the same wire; the bus must be closed."""
        yield Dynamixel2Link(self.open_port(), BAUD, 0.003)

    def hang_up(self):
        self.unplugged = self.port.gone = True

    def come_back(self):
        self.unplugged = False

    def state(self, servo_id):
        return self.servo(servo_id).state(self.clock.t)

    def fault(self, servo_id, bits):
        self.servo(servo_id).fail(bits, self.clock.t)

    def supply(self, volts):
        for servo in self.device.servos:
            servo.set_supply(volts, self.clock.t)

    def hold(self):
        self.bus.connect()
        return self.bus.enable(self.bus.joints)

    def ticks(self, goals_rad, n):
        """`n` ticks of 10 ms: write, then poll; the last readings."""
        for _ in range(n):
            self.clock.t += 0.01
            self.bus.write(np.asarray(goals_rad, dtype=float), self.clock.t)
            readings = self.bus.poll(self.clock.t)
        return readings

    def until(self, goals_rad, done, limit_s):
        """Ticks until `done(readings)`; the seconds it took, and the readings."""
        began_s = self.clock.t
        while self.clock.t - began_s < limit_s:
            readings = self.ticks(goals_rad, 1)
            if done(readings):
                return self.clock.t - began_s, readings
        raise AssertionError(f"not within {limit_s} s")


@pytest.fixture
def make_rig():
    return Rig


@pytest.fixture
def rig():
    """Four servos that stand here and there."""
    return Rig([EmulatedServo(i + 1, start_ticks=ticks) for i, ticks in enumerate((1900, 2048, 2300, 2100))])
