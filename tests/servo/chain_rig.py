"""Buses of chains of servos that are emulated in this process, in virtual time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from emulated_devices import device_of, servos_of
from emulated_port import BAUD, EchoingPort, EmulatedPort, Straight, bus_servo

from sfms_robot.config import BusConfig, Faults, FirmwareMap, Safety, load_firmware_map
from sfms_robot.servo.chain.bus import ChainBus
from sfms_robot.servo.families import families
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table

LIMIT_RAD = 1.0


def bus_of(
    maps: Sequence[FirmwareMap],
    ids: Sequence[int],
    open_port: Callable[[], Port],
    limit_rad: float = LIMIT_RAD,
    conversion: Any = None,
    safety: Safety | None = None,
    faults: Faults | None = None,
    baud: int = BAUD,
    read_deadline_s: float = 0.003,
    **config,
) -> Any:
    """A bus of the joints joint1, ... as a head names them; `config` as in a head's file."""
    servos = [
        bus_servo(f"joint{i}", i, each, limit_rad, safety=safety or Safety()) for i, each in zip(ids, maps, strict=True)
    ]
    of = maps[0].family, maps[0].protocol
    name, family = next((name, each) for name, each in families().items() if each.maps == of)
    conversion = conversion or Straight(maps[0], limit_rad)
    options = BusConfig(family=name, baud=baud, **config)
    # Hobby servos jump to their first pose.
    more = {"confirmed": True} if family.board else {"faults": faults or Faults()}
    return family.build("face", servos, conversion, open_port, baud, read_deadline_s, config=options, **more)


def limits_of(table: Table) -> tuple[str, str]:
    """Registers of the lower and the upper end."""
    old = "cw_angle_limit" in table.fields
    return ("cw_angle_limit", "ccw_angle_limit") if old else ("min_position_limit", "max_position_limit")


@dataclass
class ServoRig:
    """Emulated servos in this process and the port to them; looked at and changed beside the wire."""

    port: EmulatedPort

    @property
    def device(self):
        return self.port.device

    @property
    def clock(self):
        return self.port.clock

    def servo(self, servo_id: int) -> Any:
        return self.device.servo(servo_id)

    def register(self, servo_id: int, name: str) -> int:
        """By its role, or its name."""
        field = self._field(servo_id, name)
        return field.from_bytes(self.servo(servo_id).read(field.address, field.size, self.clock.t)[1])

    def set(self, servo_id: int, name: str, value: int) -> None:
        field = self._field(servo_id, name)
        self.servo(servo_id).write(field.address, field.to_bytes(value), self.clock.t)

    def _field(self, servo_id: int, name: str):
        table = self.servo(servo_id).table
        return table.role(name) or table[name]

    def kill(self, *servo_ids: int) -> None:
        """Their cables are out."""
        for servo_id in servo_ids:
            self.servo(servo_id).dead = True

    def revive(self, *servo_ids: int) -> None:
        for servo_id in servo_ids:
            self.servo(servo_id).dead = False

    def torques(self) -> list[int]:
        return [self.register(servo.id, "torque_enable") for servo in self.device.servos]

    def state(self, servo_id: int) -> dict[str, Any]:
        return self.servo(servo_id).state(self.clock.t)

    def fault(self, servo_id: int, bits: int) -> None:
        self.servo(servo_id).fail(bits, self.clock.t)

    def supply(self, volts: float) -> None:
        for servo in self.device.servos:
            servo.set_supply(volts, self.clock.t)


@dataclass
class BusRig(ServoRig):
    bus: ChainBus

    @property
    def conversion(self):
        return self.bus._conversion

    def hold(self) -> np.ndarray:
        self.bus.connect()
        return self.bus.enable(self.bus.joints)

    def ticks(self, goals_rad, n: int, period_s: float = 0.01):
        """`n` ticks: write, then poll; the last readings."""
        for _ in range(n):
            self.clock.t += period_s
            self.bus.write(np.asarray(goals_rad, dtype=float), self.clock.t)
            readings = self.bus.poll(self.clock.t)
        return readings

    def until(self, goals_rad, done: Callable[[Any], bool], limit_s: float):
        """Ticks until `done(readings)`; the seconds it took, and the readings."""
        began_s = self.clock.t
        while self.clock.t - began_s < limit_s:
            readings = self.ticks(goals_rad, 1)
            if done(readings):
                return self.clock.t - began_s, readings
        raise AssertionError(f"not within {limit_s} s")


def plugged(servos, ids: Sequence[int] = (), maps: Sequence[FirmwareMap] = (), **more) -> BusRig:
    """These servos and their bus, whose ports can be opened again. `ids` and `maps`: as the head names them."""
    ids = ids or [servo.id for servo in servos]
    port = EmulatedPort(device_of(*servos))
    maps = maps or [load_firmware_map("xl330-m288")] * len(ids)
    return BusRig(port, bus_of(maps, ids, lambda: replace(port, closed=False), **more))


def rig_of(model: str | Sequence[str], starts: Sequence[int], baud: int = BAUD, **more) -> BusRig:
    """Servos 1, 2, ... that stand at `starts`, on an adapter that may hear itself. `more`: as for `bus_of`."""
    models = [model] * len(starts) if isinstance(model, str) else list(model)
    rows = enumerate(zip(models, starts, strict=True), 1)
    servos = [each for i, (name, ticks) in rows for each in servos_of(name, i, start_ticks=ticks, baud=baud)]
    port = EchoingPort(device_of(*servos), baud, name="wire")
    maps = [load_firmware_map(model) for model in models]
    return BusRig(port, bus_of(maps, [servo.id for servo in servos], lambda: port, baud=baud, **more))
