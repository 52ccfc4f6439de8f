"""Emulated servos of every family, driven as by the loop in virtual time, and a judge that bypasses the bus."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Final, NamedTuple

import numpy as np

from sfms_robot.app.open_head import build_bus, bus_servos
from sfms_robot.app.wiring import calibration_of, emulated, port_of
from sfms_robot.config import Head, load_firmware_map
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.lab import Figures
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.ports import Bus
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.servo.families import family_named
from sfms_robot.servo.port import Port

RATE_HZ: Final = 100.0
LIMIT_DEG: Final = 40.0
RECOVERY_S: Final = 2.0  # longest allowed time to recover after the end of the fault
_DEADLINE_S: Final = 0.003
_WAVE_RAD, _WAVE_S = 0.4, 4.0
_STALE_TICKS: Final = 3  # allowed difference: rounding, and the movement of the servo while it answers
_FRESH_S: Final = 0.3
_FOLLOWS_RAD: Final = 0.15


class ServoFamily(NamedTuple):
    """A bus with servos of one model. `checksum`: The checksum of its packets; "" if the protocol has none."""

    bus: str
    model: str
    ids: Sequence[int] = (1, 2, 3, 4)
    baud: int = 1_000_000
    checksum: str = "8-bit sum"


FAMILIES: Final = {
    "dynamixel2": ServoFamily("dynamixel2", "xl330-m288", checksum="CRC-16"),
    "dynamixel1": ServoFamily("dynamixel1", "ax-12a"),
    "dynamixel1-mx": ServoFamily("dynamixel1", "mx-28-1.0"),
    "sts": ServoFamily("feetech", "sts3215"),
    "scs": ServoFamily("feetech", "scs0009"),
    "maestro": ServoFamily("maestro", "maestro-24", (0, 1, 2, 5), 115_200, ""),
    "maestro-crc": ServoFamily("maestro", "maestro-24", (0, 1, 2, 5), 115_200, "CRC-7"),
    "ssc32": ServoFamily("ssc32", "ssc-32", (0, 1, 2, 5), 115_200, ""),
}


def head_of(family: str, reconnect_s: float | None = None) -> Head:
    """Return a head with four joints of a family on the bus `main`.

    With `reconnect_s` the joints are on two buses, `main` and `other`, which fail after this time without any answer.
    Raises ConfigError for an unknown family.
    """
    if family not in FAMILIES:
        raise ConfigError.at("campaign", "family", family, "is not a family", FAMILIES)
    kind, model, ids, baud, checksum = FAMILIES[family]
    center = load_firmware_map(model).center_ticks
    bus: Figures = {"family": kind, "baud": baud, "rate_hz": RATE_HZ, "crc": checksum == "CRC-7"}
    names = ["main"] * len(ids)
    if reconnect_s is not None:
        bus["reconnect_s"] = reconnect_s
        names[2:] = ["other", "other"]
    joint = {"model": model, "zero_ticks": center, "limits": "all"}
    reach = {"min_deg": -LIMIT_DEG, "max_deg": LIMIT_DEG}
    plain: Figures = {
        "name": "campaign",
        "description": f"four {model}",
        "buses": dict.fromkeys(names, bus),
        "limits": {"all": {"speed_deg_s": 120, "acceleration_deg_s2": 1500, "jerk_deg_s3": 90000}},
        "joints": {f"joint{i}": {**joint, **reach, "id": i, "bus": on} for i, on in zip(ids, names, strict=True)},
    }
    return Head.model_validate(plain)


class Rig:
    """Emulated servos of one family and their bus, driven by the steps of the loop."""

    def __init__(self, head: Head, chains: Mapping[str, Chain], clock: VirtualClock, bus: Bus) -> None:
        self.chains, self.clock, self.bus = chains, clock, bus
        self.ids = [joint.id for joint in head.joints.values()]
        self._wires = [chains[joint.bus] for joint in head.joints.values()]
        self.conversion = calibration_of(head.joints)
        self._limiter = JerkLimiter(JointLimits.of(head), 1.0 / RATE_HZ)
        [model] = {joint.model for joint in head.joints.values()}
        self.tick_us = load_firmware_map(model).tick_us or 0.0  # of a board, which reports no positions; else 0

    def hold(self) -> None:
        self.bus.connect()
        held = self.bus.enable(self.bus.joints)
        self._state = self._limiter.start(held)
        self._centre = np.clip(held, -0.1, 0.1)
        self._began_s = self.clock.now_s()
        self.goals: Doubles = held

    def tick(self) -> Mapping[str, Reading]:
        """Do one turn of the loop: limiter, write, poll; a joint that rejoined continues from its position."""
        self.clock.wait_until(self.clock.now_s() + 1.0 / RATE_HZ)
        now_s = self.clock.now_s()
        turn = 2 * math.pi / _WAVE_S
        phase = turn * (now_s - self._began_s)
        way = np.where(np.arange(len(self.ids)) % 2, -1.0, 1.0) * _WAVE_RAD
        angle = self._centre + way * math.sin(phase)  # a wave around the held angles, clipped to +-0.1 rad
        wave = np.array([angle, way * turn * math.cos(phase), -way * turn * turn * math.sin(phase)])
        self.goals, self._state = self._limiter.step(wave, self._state)
        self.bus.write(self.goals, now_s)
        readings = self.bus.poll(now_s)
        back = np.array([reading.rejoined for reading in readings.values()])
        if back.any():
            stands = [
                g if r.position_rad is None else r.position_rad
                for g, r in zip(self.goals, readings.values(), strict=True)
            ]
            self._state = self._limiter.restart(back, np.array(stands), self._state)
        return readings

    def try_bad_goals(self, withheld: bool) -> None:
        """Send bad goals for the last joint. Raises AssertionError if the bus accepts one.

        Goals out of range are left out while a fault or the return of a joint may hold the joint's goals back.
        """
        bad_rad = [math.nan, math.inf]
        if not withheld and self.states()[-1]["goal"] == self.conversion.to_ticks(self.goals)[-1]:
            beyond_rad = math.radians(LIMIT_DEG) + 0.5
            bad_rad += [beyond_rad, -beyond_rad]
        for bad in bad_rad:
            with suppress(ValueError):
                self.bus.write(np.array([*self.goals[:-1], bad]), self.clock.now_s())
                raise AssertionError(f"a goal of {bad:g} rad is not refused")

    def states(self) -> list[Figures]:
        """Return the current state of every servo, read without the bus."""
        for chain in self.chains.values():
            chain.time_is(self.clock.now_s())
        return [chain.state(servo) for chain, servo in zip(self._wires, self.ids, strict=True)]


class Judge:
    """A judge of the servos after every tick; joints in `away` are lost for good and need not recover.

    A joint that was found outside its range may move anywhere between that place and its range, but not out again.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.away: frozenset[int] = frozenset()
        found = np.rint([state["position"] for state in rig.states()])
        self._low = np.minimum(rig.conversion.low_ticks, found)
        self._high = np.maximum(rig.conversion.high_ticks, found)
        self._shafts: list[Doubles] = []
        self._slack_rad = _STALE_TICKS / np.abs(rig.conversion.ticks_per_rad)
        self.outside = self.stale = 0
        self.pulses_us: list[float] = []
        self.well_since_s: float | None = None
        self.named: list[str] = []

    def see(self, readings: Mapping[str, Reading]) -> None:
        rig, states = self._rig, self._rig.states()
        shafts = rig.conversion.to_rad(np.array([state["position"] for state in states]))
        self._shafts.append(shafts)
        for index, state in enumerate(states):
            if state["torque"] and (goal := state["goal"]) is not None:
                self.outside += not self._low[index] <= goal <= self._high[index]
                self._low[index] = max(self._low[index], min(goal, rig.conversion.low_ticks[index]))
                self._high[index] = min(self._high[index], max(goal, rig.conversion.high_ticks[index]))
                if rig.tick_us:
                    self.pulses_us.append(state["pulse"] * rig.tick_us)
        for index, reading in enumerate(readings.values()):
            if reading.position_rad is not None and math.isfinite(reading.age_s):
                back = round(reading.age_s * RATE_HZ)
                if back < len(self._shafts):  # else the reading is from before the first tick
                    was_rad = self._shafts[-1 - back][index]  # at the time of the reading
                    self.stale += bool(abs(reading.position_rad - was_rad) > self._slack_rad[index])
        seen = [(i, joint, r) for i, (joint, r) in enumerate(readings.items()) if i not in self.away]
        self.named = [f"{joint}: {r.fault}" for _, joint, r in seen if r.fault is not None]
        follows = np.abs(shafts - rig.goals) < _FOLLOWS_RAD
        fine = [
            r.fault is not None  # disabled, with a stated reason
            or ((rig.tick_us or r.age_s < _FRESH_S) and states[i]["torque"] and follows[i])
            for i, _, r in seen
        ]
        if not all(fine):
            self.well_since_s = None
        elif self.well_since_s is None:
            self.well_since_s = rig.clock.now_s()

    def recovered_s(self, end_s: float) -> float | None:
        """Return the time from `end_s`, the end of the fault, until all joints were well for good; None if never."""
        return None if self.well_since_s is None else max(0.0, self.well_since_s - end_s)


@contextmanager
def plugged_in(
    head: Head,
    servos: Mapping[str, Sequence[EmulatedServo]] | None = None,
    wrap: Callable[[Port], Port] | None = None,
) -> Iterator[Rig]:
    """Emulate a head's servos, or the `servos` given by bus; `wrap` wraps the port of a head with a single bus."""
    clock = VirtualClock()
    with ExitStack() as stack:
        plugged = (emulated(head) if servos is None else servos).items()
        chains = {name: stack.enter_context(launch(each, virtual=True)) for name, each in plugged}
        if wrap is None:
            bus = build_bus(head, chains, clock, confirmed=True)
        else:
            [(name, config)] = head.buses.items()
            open_port, family = port_of(chains[name], config, clock), family_named(config.family)
            more: dict[str, Any] = {"confirmed": True} if family.board else {"faults": head.faults}
            bus = family.build(
                name,
                bus_servos(head, head.joints),
                calibration_of(head.joints),
                lambda: wrap(open_port()),
                config.baud,
                _DEADLINE_S,
                config=config,
                **more,
            )
        try:
            yield Rig(head, chains, clock, bus)
        finally:
            bus.stop("release")
            bus.close()
