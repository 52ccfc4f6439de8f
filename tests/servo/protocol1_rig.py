"""Buses of the FF FF family on emulated servos in the same process, in virtual time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sfms_robot.config import Faults, Safety, load_firmware_map
from sfms_robot.emulator.protocol1_chain import Protocol1Chain
from sfms_robot.emulator.protocol1_servo import Protocol1Servo
from sfms_robot.errors import BusError
from sfms_robot.servo.chain.dynamixel1_bus import Dynamixel1Bus
from sfms_robot.servo.chain.feetech_bus import FeetechBus
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Table

LIMIT_RAD = 1.0


@dataclass
class Time:
    """Virtual time: moves when told."""

    t: float = 0.0

    def now_s(self) -> float:
        return self.t

    def wait_until(self, time_s: float) -> None:
        self.t = max(self.t, time_s)


@dataclass
class Wire:
    """`Port` whose other end is a device in this process.

    `unplugged`: the device is gone. `late`: answers to the next so many requests come only with those to a later one.
    `hears_itself`: a half-duplex adapter that echoes what it sends.
    """

    device: Protocol1Chain
    clock: Time
    baud: int
    name: str = "wire"
    unplugged: bool = False
    late: int = 0
    hears_itself: bool = False
    sent: bytearray = field(default_factory=bytearray)
    requests: int = 0
    _inbox: bytearray = field(default_factory=bytearray)
    _held: bytearray = field(default_factory=bytearray)

    def write(self, data: bytes) -> None:
        if self.unplugged:
            raise BusError(f"{self.name}: the device is gone")
        self.sent += data
        self.requests += 1
        if self.hears_itself:
            self._inbox += data
        answer = self.device.receive(data, self.baud, self.clock.t)
        if self.late:
            self.late -= 1
            self._held += answer
        else:
            self._inbox += self._held + answer
            self._held.clear()

    def read(self, n: int, deadline_s: float) -> bytes:
        if self.unplugged:
            raise BusError(f"{self.name}: the device is gone")
        data = bytes(self._inbox[:n])
        del self._inbox[:n]
        return data

    def discard_input(self) -> None:
        self._inbox.clear()

    def now_s(self) -> float:
        return self.clock.t

    def wait_until(self, time_s: float) -> None:
        self.clock.wait_until(time_s)

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        self._inbox.clear()


class Straight:
    """The middle of the servo is 0 rad; `Conversion` for models of one kind."""

    def __init__(self, table: Table, limit_rad: float = LIMIT_RAD):
        self.center, self.rad = table.center_ticks, 2 * np.pi / table.ticks_per_revolution
        self.limit_rad = limit_rad

    def to_ticks(self, angles_rad):
        return np.rint(self.center + np.clip(angles_rad, -self.limit_rad, self.limit_rad) / self.rad).astype(np.int64)

    def to_rad(self, ticks):
        return (ticks - self.center) * self.rad


@dataclass
class Rig:
    device: Protocol1Chain
    clock: Time
    wire: Wire
    bus: Dynamixel1Bus | FeetechBus
    conversion: Straight
    rejoined: set[str] = field(default_factory=set)
    goals: np.ndarray | None = None

    def servo(self, servo_id: int) -> Protocol1Servo:
        servo = self.device.servo(servo_id)
        assert servo is not None
        return servo

    def torques(self) -> list[int]:
        return [self.register(servo.id, "torque_enable") for servo in self.device.servos]

    def register(self, servo_id: int, name: str) -> int:
        servo = self.servo(servo_id)
        register = servo.table[name]
        return register.from_bytes(servo.read(register.address, register.size, self.clock.t)[1])

    def set(self, servo_id: int, name: str, value: int) -> None:
        servo = self.servo(servo_id)
        servo.write(servo.table[name].address, servo.table[name].to_bytes(value), self.clock.t)

    def hold(self) -> np.ndarray:
        self.bus.connect()
        return self.bus.enable(self.bus.joints)

    def ticks(self, goals_rad, n: int, each: Callable[[], None] = lambda: None):
        """`n` ticks of 10 ms: write, then poll; the last readings. A joint that rejoins begins where it stands."""
        wanted = np.asarray(goals_rad, dtype=float)
        goals = wanted.copy() if self.goals is None else self.goals
        for _ in range(n):
            self.clock.t += 0.01
            away = np.array([joint in self.rejoined for joint in self.bus.joints])
            goals = np.where(away, goals + np.clip(wanted - goals, -0.01, 0.01), wanted)
            self.bus.write(goals, self.clock.t)
            readings = self.bus.poll(self.clock.t)
            for i, (joint, reading) in enumerate(readings.items()):
                if reading.rejoined:
                    self.rejoined.add(joint)
                    goals[i] = reading.position_rad
            each()
        self.goals = goals
        return readings


def rig_of(
    model: str | Sequence[str],
    starts: Sequence[int],
    expected: Sequence[int] = (),
    baud: int = 1_000_000,
    named: str | None = None,
    servo_baud: int | None = None,
    safety: Safety | None = None,
    faults: Faults | None = None,
) -> Rig:
    """Servos 1, 2, ... that stand at `starts`. `expected`, `named`: ids and model that the head names."""
    models = [model] * len(starts) if isinstance(model, str) else list(model)
    tables = {each: Table.of(load_firmware_map(each)) for each in models}
    rows = [
        {"id": i + 1, "model": each, "baud": servo_baud or baud, "start_ticks": ticks, "firmware": 3}
        for i, (each, ticks) in enumerate(zip(models, starts, strict=True))
    ]
    device = Protocol1Chain.from_rows(rows, tables)
    clock = Time()
    wire = Wire(device, clock, baud)
    conversion = Straight(tables[models[0]])
    ids = list(expected) or [row["id"] for row in rows]
    maps = [load_firmware_map(named or models[min(i, len(models) - 1)]) for i in range(len(ids))]
    servos = [
        BusServo(f"joint{servo_id}", servo_id, each, -LIMIT_RAD, LIMIT_RAD, safety or Safety())
        for servo_id, each in zip(ids, maps, strict=True)
    ]
    kind = FeetechBus if tables[models[0]].family == "feetech" else Dynamixel1Bus

    def open_port():
        if wire.unplugged:
            raise BusError("wire: no such device")
        return wire

    return Rig(device, clock, wire, kind("face", servos, conversion, open_port, baud, faults=faults), conversion)
