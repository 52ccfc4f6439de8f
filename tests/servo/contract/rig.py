"""A bus of any family on emulated servos in virtual time, or on real ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from families import FAMILIES, Family

from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.ports import Bus, Clock
from sfms_robot.runtime.clock import RealClock, VirtualClock
from sfms_robot.servo.port import Port, SerialPort, VirtualTimePort, WrappedPort

TICK_S = 0.02
EASE_RAD_S = 0.5  # as slowly as a limiter begins: a joint that rejoins takes goals only where it stands


@dataclass
class Tapped(WrappedPort):
    """A port that notes what goes out."""

    sent: list[bytes]

    def write(self, data: bytes) -> None:
        self.sent.append(bytes(data))
        super().write(data)


@dataclass
class Rig:
    """`chain` is None on real servos."""

    family: Family
    bus: Bus
    clock: Clock
    sent: list[bytes]
    chain: Chain | None
    easing: dict[int, float] = field(default_factory=dict)

    @property
    def ids(self) -> list[int]:
        return list(self.family.ids)

    @property
    def now_s(self) -> float:
        return self.clock.now_s()

    def hold(self) -> np.ndarray:
        self.bus.connect()
        return self.bus.enable(self.bus.joints)

    def ticks(self, goals_rad, n: int, period_s: float = TICK_S):
        """`n` ticks: write, then poll; the last readings. Joints that rejoin are eased in from where they stand."""
        for _ in range(n):
            self.clock.wait_until(self.now_s + period_s)
            self.bus.write(self._eased(np.array(goals_rad, dtype=float), period_s), self.now_s)
            readings = self.bus.poll(self.now_s)
            back = {
                i: r.position_rad for i, r in enumerate(readings.values()) if r.rejoined and r.position_rad is not None
            }
            self.easing.update(back)
        return readings

    def _eased(self, goals_rad: np.ndarray, period_s: float) -> np.ndarray:
        for i, last_rad in list(self.easing.items()):
            gap = goals_rad[i] - last_rad
            if abs(gap) <= EASE_RAD_S * period_s:
                del self.easing[i]
            else:
                goals_rad[i] = self.easing[i] = last_rad + np.copysign(EASE_RAD_S * period_s, gap)
        return goals_rad

    def polls(self, n: int, period_s: float = TICK_S):
        for _ in range(n):
            self.clock.wait_until(self.now_s + period_s)
            readings = self.bus.poll(self.now_s)
        return readings

    def tells(self, what: str) -> bool:
        return all(what in told for told in self.bus.capabilities.values())

    def shafts_rad(self) -> np.ndarray:
        """Where the emulated servos stand, whatever the bus knows of it."""
        self.chain.time_is(self.now_s)
        return self.family.conversion.to_rad([self.chain.state(i)["position"] for i in self.ids])

    def torques(self) -> list[bool]:
        self.chain.time_is(self.now_s)
        return [self.chain.state(i)["torque"] for i in self.ids]


@contextmanager
def emulated(name: str, model: str | None = None, chain: Chain | None = None, start_s: float = 0.0) -> Iterator[Rig]:
    """On servos that have just been switched on (of another `model` if told), or on a `chain` that stands ready."""
    family = FAMILIES[name]
    if chain is None:
        with launch(family.plugged(model), virtual=True) as own, emulated(name, chain=own) as rig:
            yield rig
        return
    clock = VirtualClock()
    clock.wait_until(start_s)
    port = chain.device, chain.control, family.baud, clock
    yield from _rig(family, lambda: VirtualTimePort(*port), clock, chain, 0.003)


@contextmanager
def real(name: str, device: str, servos: str) -> Iterator[Rig]:
    """On real servos; they stay near the middle of their range."""
    family = FAMILIES[name].on(servos) if servos else FAMILIES[name]
    clock = RealClock()
    yield from _rig(family, lambda: SerialPort(device, family.baud, clock), clock, None, 0.02)


def _rig(
    family: Family, open_port: Callable[[], Port], clock: Clock, chain: Chain | None, deadline_s: float
) -> Iterator[Rig]:
    sent: list[bytes] = []
    bus = family.build(lambda: Tapped(open_port(), sent), deadline_s)
    try:
        yield Rig(family, bus, clock, sent, chain)
    finally:
        bus.stop("release")
        bus.close()
