"""One joint on its own, in servo ticks: where it stands, limp, and by keys. What a calibration does to a servo.

The joint's bus is opened with this joint alone and with the whole travel of its servo as its range, for what its
range is has yet to be found. It moves only while somebody asks it to, at a slow and steady pace.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final

import numpy as np

from sfms_robot.app.open_head import build_bus
from sfms_robot.config import Head, Joint, load_firmware_map
from sfms_robot.emulator.launch import Chain
from sfms_robot.errors import ServoError, TorqueError
from sfms_robot.ports import Bus, Clock
from sfms_robot.servo.families import family_named

PACE_DEG_S: Final = 20.0
_PERIOD_S: Final = 0.01
_TRIES: Final = 20
_PULSE_US: Final = (500.0, 2500.0)  # what a hobby servo may be sent, whatever its board can make


class Probe:
    """A joint whose bus is open.

    Attributes:
        tells: whether its servo says where it stands.
        lowest, highest: ticks it may be sent to.
    """

    def __init__(self, name: str, joint: Joint, bus: Bus, clock: Clock) -> None:
        self.name = name
        self.tells = "position" in bus.capabilities[name]
        self.lowest, self.highest = _travel_ticks(joint)
        self._joint, self._bus, self._clock = joint, bus, clock
        self._per_rad: float = math.degrees(1.0) * _ticks_per_deg(joint)
        self._goal_rad: float | None = None  # with torque, where it is held

    @property
    def ticks_per_deg(self) -> float:
        """Of the joint, without direction."""
        return abs(self._per_rad) / math.degrees(1.0)

    def ticks(self) -> int:
        """Where it stands; for a servo that does not tell, where it was sent. Raises ServoError."""
        if not self.tells:
            return self._ticks(self._goal_rad if self._goal_rad is not None else self._joint.rest_rad)
        for _ in range(_TRIES):
            reading = self._bus.poll(self._clock.now_s())[self.name]
            if reading.position_rad is not None and reading.age_s < 2 * _PERIOD_S:
                return self._ticks(reading.position_rad)
            self._clock.wait_until(self._clock.now_s() + _PERIOD_S)
        raise ServoError(f"{self.name} (id {self._joint.id}) does not say where it stands")

    def limp(self) -> None:
        """Switch torque off, for a hand to move it. Raises TorqueError where that could not be confirmed."""
        self._bus.stop("release")
        if unconfirmed := self._bus.statistics()["torque_unconfirmed"]:
            raise TorqueError(unconfirmed)
        self._goal_rad = None

    def go(self, ticks: int) -> int:
        """Slowly to `ticks`, torque on from where it stands; held there. Returns the ticks it was sent to."""
        if self._goal_rad is None:
            self._goal_rad = float(self._bus.enable([self.name])[0])
        start_rad, to_rad = self._goal_rad, self._angle(min(max(ticks, self.lowest), self.highest))
        steps = max(1, math.ceil(math.degrees(abs(to_rad - start_rad)) / (PACE_DEG_S * _PERIOD_S)))
        began_s = self._clock.now_s()
        for k in range(1, steps + 1):
            self._goal_rad = start_rad + (to_rad - start_rad) * k / steps
            self._bus.write(np.array([self._goal_rad]), self._clock.now_s())
            self._bus.poll(self._clock.now_s())
            self._clock.wait_until(began_s + k * _PERIOD_S)
        return self._ticks(to_rad)

    def by(self, step_deg: float) -> int:
        """As `go`, from where it is held, so that one that sags under its load still moves. Raises ValueError."""
        here = self.ticks() if self._goal_rad is None else self._ticks(self._goal_rad)
        return self.go(here + round(step_deg * self.ticks_per_deg))

    def _ticks(self, angle_rad: float) -> int:
        return round(self._joint.zero_ticks + self._per_rad * angle_rad)

    def _angle(self, ticks: int) -> float:
        return (ticks - self._joint.zero_ticks) / self._per_rad


@contextmanager
def probe(
    head: Head, name: str, where: Chain | str, clock: Clock, *, stored: Mapping[str, int], unconfirmed: list[str]
) -> Iterator[Probe]:
    """Open the joint's bus; limp again at the end, or named in `unconfirmed`.

    `stored`: zero and direction as its servo stores them; a measurement may begin from any. Raises RobotError for a
    servo that is not what the head says.
    """
    joint, safety = head.joints[name], head.safety_of(name)
    safety = safety.model_copy(update={"stop": "release", "stored": {**safety.stored, **stored}})
    joint = joint.model_copy(update={"safety": safety, **_whole_travel(joint)})
    # A person thinks longer than a watchdog waits.
    config = head.buses[joint.bus].model_copy(update={"watchdog_ms": 0})
    alone = head.model_copy(update={"joints": {name: joint}, "buses": {joint.bus: config}})
    bus = build_bus(alone, {joint.bus: where}, clock, confirmed=True)
    try:
        bus.connect()
        yield Probe(name, joint, bus, clock)
    finally:
        bus.stop("release")
        unconfirmed += bus.statistics()["torque_unconfirmed"]
        bus.close()


def jumps(head: Head, name: str) -> bool:
    """Whether the servo comes on with a jump: one that does not tell where it stands."""
    return family_named(head.buses[head.joints[name].bus].family).board


def _ticks_per_deg(joint: Joint) -> float:
    return joint.sign * joint.ratio * load_firmware_map(joint.model).ticks_per_revolution / 360.0


def _travel_ticks(joint: Joint) -> tuple[int, int]:
    """First and last tick that the servo, or a common one on a board, may be sent to."""
    firmware = load_firmware_map(joint.model)
    if firmware.pulse_us is not None and firmware.tick_us is not None:
        shortest, longest = max(firmware.pulse_us.min, _PULSE_US[0]), min(firmware.pulse_us.max, _PULSE_US[1])
        return math.ceil(shortest / firmware.tick_us), math.floor(longest / firmware.tick_us)
    return 0, int(firmware.ticks_per_revolution) - 1


def _whole_travel(joint: Joint) -> dict[str, float]:
    ends = sorted((ticks - joint.zero_ticks) / _ticks_per_deg(joint) for ticks in _travel_ticks(joint))
    return {"min_deg": min(ends[0], joint.rest_deg), "max_deg": max(ends[1], joint.rest_deg)}
