"""Ports whose wire ends at an emulated device in this process, and the simplest conversion."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from virtual_time import Time

from sfms_robot.config import Faults
from sfms_robot.servo.chain.link import TRIES, RegisterLink, finish
from sfms_robot.servo.chain.protocol1 import Dynamixel1Link, FeetechLink, Protocol1Startup
from sfms_robot.servo.chain.protocol2 import Dynamixel2Link, Dynamixel2Startup
from sfms_robot.servo.chain.startup import PATIENCE_S, needs_of, start_up
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Table

BAUD = 1_000_000
SILENCE_S = 0.003


def bus_servo(joint, servo_id, firmware_map, limit_rad=1.0, **more):
    """A servo whose joint moves as far to both sides."""
    limits = {"min_rad": -limit_rad, "max_rad": limit_rad}
    return BusServo(joint=joint, id=servo_id, table=Table.of(firmware_map), **limits, **more)


def startups_on(port, servos, conversion):
    """The startups of these servos over `port`, and what runs them all through."""
    table = servos[0].table
    link, kind = link_on(port, table), Dynamixel2Startup if table.protocol == 2 else Protocol1Startup
    needs = needs_of(servos, conversion, Faults())
    startups = [kind(servo, each, {}) for servo, each in zip(servos, needs, strict=True)]
    for each in startups:
        each.link = link
    return startups, lambda: start_up("face", link, startups, port.baud)


def switched_on(startup):
    """Torque on, as `enable` does it; the position held."""
    with startup.link.patient(PATIENCE_S, TRIES):
        return finish(startup.torque_on(), startup.link.wait)


class Straight:
    """`TickConversion` of servos of one model: their middle is 0 rad, angles outside the limit give its ticks."""

    def __init__(self, table, limit_rad=math.inf, ratio=1.0):
        self.center, self.rad = table.center_ticks, 2 * np.pi / table.ticks_per_revolution / ratio
        self._most = math.floor(limit_rad / self.rad) if math.isfinite(limit_rad) else math.inf

    def to_ticks(self, angles_rad):
        ticks = np.rint(np.asarray(angles_rad) / self.rad)
        return (self.center + np.clip(ticks, -self._most, self._most)).astype(np.int64)

    def to_rad(self, ticks):
        return (np.asarray(ticks) - self.center) * self.rad


@dataclass
class EmulatedPort:
    """`servo.port.Port`: bytes go in, answers come out, nothing waits.

    `sent`: what was written. `waits`: the deadlines of reads that came back empty.
    """

    device: object
    baud: int = BAUD
    clock: Time = field(default_factory=Time)
    name: str = "emulated"
    inbox: bytearray = field(default_factory=bytearray)
    sent: list[bytes] = field(default_factory=list)
    waits: list[float] = field(default_factory=list)
    closed: bool = False

    def write(self, data: bytes) -> None:
        assert not self.closed
        self.sent.append(bytes(data))
        self.inbox += self.device.receive(data, self.baud, self.clock.t)

    def read(self, n: int, deadline_s: float) -> bytes:
        data = bytes(self.inbox[:n])
        del self.inbox[:n]
        if not data:
            self.waits.append(deadline_s)
        return data

    def discard_input(self) -> None:
        self.inbox.clear()

    def now_s(self) -> float:
        return self.clock.now_s()

    def wait_until(self, time_s: float) -> None:
        self.clock.wait_until(time_s)

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        self.inbox.clear()
        self.closed = True


@dataclass
class LossyPort(EmulatedPort):
    """Silence and bytes cost time. `fate` says of each packet what happens to it: "" arrives and is answered,
    "request" is lost on the way there, "answer" on the way back; when it is used up everything arrives.
    """

    name: str = "lossy"
    fate: Iterator[str] = iter(())

    def write(self, data: bytes) -> None:
        self.clock.t += len(data) * 10 / self.baud
        fate = next(self.fate, "")
        if fate == "request":
            self.sent.append(data)
            return
        came = len(self.inbox)
        super().write(data)
        if fate == "answer":
            del self.inbox[came:]

    def read(self, n: int, deadline_s: float) -> bytes:
        data = super().read(n, deadline_s)
        self.clock.wait_until(self.clock.t + len(data) * 10 / self.baud if data else deadline_s)
        return data


@dataclass
class EchoingPort(EmulatedPort):
    """A half-duplex adapter: with `hears_itself` it echoes what it sends."""

    hears_itself: bool = False

    def write(self, data: bytes) -> None:
        if self.hears_itself:
            self.inbox += data
        super().write(data)


class ScriptedPort(EmulatedPort):
    """A port with answers to come, each given whole to one read. `echo`: it hears itself first."""

    def __init__(self, *chunks: bytes, echo: bool = False):
        super().__init__(None, name="script")
        self.chunks, self.echo = list(chunks), echo

    def write(self, data: bytes) -> None:
        self.sent.append(data)
        if self.echo:
            self.chunks.insert(0, data)

    def read(self, n: int, deadline_s: float) -> bytes:
        if self.chunks:
            return self.chunks.pop(0)
        self.clock.wait_until(deadline_s)
        return b""

    def discard_input(self) -> None: ...


def link_on(port: EmulatedPort, table: Table) -> RegisterLink:
    kinds = {("dynamixel", 2): Dynamixel2Link, ("dynamixel", 1): Dynamixel1Link, ("feetech", 1): FeetechLink}
    return kinds[table.family, table.protocol](port, port.baud, SILENCE_S)


class Says:
    """A device that answers anything with the same bytes, then as another one would."""

    def __init__(self, data, other=None):
        self.data, self.other = data, other

    def receive(self, data, baud, now_s):
        return self.data + (self.other.receive(data, baud, now_s) if self.other else b"")
