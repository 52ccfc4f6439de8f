"""A board of hobby servos that is emulated in this process, and its bus."""

import numpy as np
from emulated_devices import device_of, servos_of
from emulated_port import EmulatedPort, Straight, bus_servo
from virtual_time import Time

from sfms_robot.config import BusConfig, Safety, load_firmware_map
from sfms_robot.servo.families import family_named

LIMIT_RAD = 0.7


class Bench:
    """One board with servos on `channels`, and its bus. `stiff`: channels whose joints hold at the end.

    `crc`: what the head's file says of the board's "Enable CRC", and what it really is.
    """

    def __init__(
        self,
        model="maestro-24",
        channels=(0, 1, 2, 5),
        baud=115200,
        limit_rad=LIMIT_RAD,
        stiff=(),
        crc=(False, False),
        **more,
    ):
        firmware_map = load_firmware_map(model)
        self.clock, self.ports = Time(), []
        self.board = device_of(*servos_of(model, *channels, baud=baud, registers={"crc": 1} if crc[1] else {}))
        safety = {True: Safety(stop="hold"), False: Safety()}
        servos = [bus_servo(f"joint{i}", i, firmware_map, limit_rad, safety=safety[i in stiff]) for i in channels]

        def open_port():
            self.ports.append(self.new_port(self.board, baud, self.clock))
            return self.ports[-1]

        config = BusConfig(family=firmware_map.family, baud=baud, crc=crc[0])
        conversion, more = Straight(firmware_map, limit_rad), {"confirmed": True, "config": config} | more
        self.bus = family_named(firmware_map.family).build("face", servos, conversion, open_port, baud, 0.0, **more)

    def new_port(self, *rest):
        return EmulatedPort(*rest)

    @property
    def port(self):
        return self.ports[-1]

    def hold(self):
        self.bus.connect()
        return self.bus.enable(self.bus.joints)

    def ticks(self, goals_rad, n, period_s=0.1):
        """Write, then poll; the last readings. Without goals nothing is written."""
        for _ in range(n):
            self.clock.t += period_s
            if goals_rad is not None:
                self.bus.write(np.asarray(goals_rad, dtype=float), self.clock.t)
            readings = self.bus.poll(self.clock.t)
        return readings

    def kill(self):
        """The board is unplugged."""
        for channel in self.board.servos:
            channel.dead = True

    def revive(self):
        for channel in self.board.servos:
            channel.dead = False

    def pulses(self):
        return {channel.id: channel.pulse for channel in self.board.servos}

    def on(self):
        return [channel for channel, pulse in self.pulses().items() if pulse]
