"""Every kind of fault on every family of servos, in virtual time: what the bus lets through, and what comes back.

One run: four emulated servos follow a slow wave under the limiter, as in the loop. After a while a fault sets in; when
it has passed they get time to come back. Judged from outside, by what the emulated servos hold and where they stand:

    escaped       an exception left the bus
    outside       goals outside the limits of a joint that a servo held, and bad goals that were not refused
    stale         readings that tell another position than the servo had at the time they name
    recovered_s   from the end of the fault until every joint is read, has torque and follows its goal, for good
    named         joints that stay out, with their fault named: protection that is latched, or a servo left alone

A run is the same every time: time is virtual, and the dice are seeded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.app.session import build_bus
from sfms_robot.app.wiring import emulated
from sfms_robot.config import Head, load_firmware_map
from sfms_robot.emulator.faults import KINDS
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.ports import Bus
from sfms_robot.runtime.clock import VirtualClock

TICKS: Final = 1000
RATE_HZ: Final = 100.0
LIMIT_DEG: Final = 40.0
RECOVERY_S: Final = 2.0  # after the fault is over
_WAVE_RAD, _WAVE_S = 0.4, 4.0
_QUIET, _FAULTY = 0.1, 0.5  # share of the ticks before the fault, and with it
_BAD_GOALS_EVERY: Final = 50
_STALE_TICKS: Final = 3  # rounding, and what the servo moves while it answers
_FRESH_S: Final = 0.3
_FOLLOWS_RAD: Final = 0.15

# Family -> (bus family, model, ids, baud).
FAMILIES: Final[Mapping[str, tuple[str, str, Sequence[int], int]]] = {
    "dynamixel2": ("dynamixel", "xl330-m288", (1, 2, 3, 4), 1_000_000),
    "dynamixel1": ("dynamixel1", "ax-12a", (1, 2, 3, 4), 1_000_000),
    "dynamixel1-mx": ("dynamixel1", "mx-28-1.0", (1, 2, 3, 4), 1_000_000),
    "sts": ("feetech", "sts3215", (1, 2, 3, 4), 1_000_000),
    "scs": ("feetech", "scs0009", (1, 2, 3, 4), 1_000_000),
    "maestro": ("maestro", "maestro-24", (0, 1, 2, 5), 115_200),
    "ssc32": ("ssc32", "ssc-32", (0, 1, 2, 5), 115_200),
}
# Kind -> ids (all of the wire where there are none) and value.
SPECS: Final[Mapping[str, str]] = {
    "drop": "drop{two}{when}=0.3",
    "delay": "delay{two}{when}=0.03",
    "corrupt": "corrupt{two}{when}=0.3",
    "duplicate": "duplicate{two}{when}=0.5",
    "truncate": "truncate{two}{when}=0.3",
    "echo": "echo{when}",
    "noise": "noise{when}=0.5",
    "silent": "silent{one}{when}",
    "stuck": "stuck{one}{when}",
    "overload": "overload{one}{when}",
    "overheat": "overheat{one}{when}",
    "load": "load{two}{when}=0.1",
    "voltage": "voltage{when}=20",
    "brownout": "brownout{when}",
    "hangup": "hangup{when}",
}
LATCHED: Final = frozenset({"overload", "overheat", "voltage", "stuck"})  # a servo's protection holds on to these
LIMP_S: Final = {"stuck": 3.0}  # a joint that was pinched stays limp so long before it comes back


@dataclass(frozen=True)
class Outcome:
    """What came of one fault on one family; see the head of this file. `possible`: this family can have that fault."""

    family: str
    fault: str
    ticks: int
    possible: bool = True
    escaped: str | None = None
    outside: int = 0
    stale: int = 0
    recovered_s: float | None = None
    named: Sequence[str] = ()

    @property
    def as_stated(self) -> bool:
        """Whether every joint came back in time, or stays out for a reason that is stated."""
        reasons = all("left alone" in each or self.fault in LATCHED for each in self.named)
        within_s = RECOVERY_S + LIMP_S.get(self.fault, 0.0)
        return self.recovered_s is not None and self.recovered_s <= within_s and reasons

    @property
    def passed(self) -> bool:
        return not self.possible or (self.escaped is None and not self.outside and not self.stale and self.as_stated)


def head_of(family: str) -> Head:
    """Four joints of a family. Raises ConfigError for an unknown one."""
    if family not in FAMILIES:
        raise ConfigError.at("campaign", "family", family, "is not a family", FAMILIES)
    kind, model, ids, baud = FAMILIES[family]
    center = load_firmware_map(model).center_ticks
    joint = {"bus": "main", "model": model, "zero_ticks": center, "limits": "all"}
    reach = {"min_deg": -LIMIT_DEG, "max_deg": LIMIT_DEG}
    plain: dict[str, Any] = {
        "name": "campaign",
        "description": f"four {model}",
        "buses": {"main": {"family": kind, "baud": baud, "rate_hz": RATE_HZ}},
        "limits": {"all": {"speed_deg_s": 120, "acceleration_deg_s2": 1500, "jerk_deg_s3": 90000}},
        "joints": {f"joint{i}": {**joint, **reach, "id": i} for i in ids},
    }
    return Head.model_validate(plain)


class Rig:
    """Emulated servos of one family, their bus, and the way of the loop to it."""

    def __init__(self, head: Head, chain: Chain, clock: VirtualClock, bus: Bus) -> None:
        self.chain, self.clock, self.bus = chain, clock, bus
        self.ids = [joint.id for joint in head.joints.values()]
        turns = np.array([load_firmware_map(j.model).ticks_per_revolution for j in head.joints.values()])
        self.conversion = Calibration(head.joints, turns)
        self._limiter = JerkLimiter(JointLimits.of(head), 1.0 / RATE_HZ)
        self.tells_position = all("position" in told for told in self.bus.capabilities.values())

    def hold(self) -> None:
        self.bus.connect()
        held = self.bus.enable(self.bus.joints)
        self._state = self._limiter.start(held)
        self._centre = np.clip(held, -0.1, 0.1)
        self._began_s = self.clock.now_s()
        self.goals: Doubles = held

    def tick(self) -> Mapping[str, Reading]:
        """One turn of the loop: limiter, write, poll; who came back is led from where it stands."""
        self.clock.wait_until(self.clock.now_s() + 1.0 / RATE_HZ)
        now_s = self.clock.now_s()
        self.goals, self._state = self._limiter.step(self._wave(now_s - self._began_s), self._state)
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

    def _wave(self, time_s: float) -> Doubles:
        """Reference (3, J): angle, speed, acceleration of a wave that begins at rest where the joints are held."""
        turn = 2 * math.pi / _WAVE_S
        phase = turn * time_s
        way = np.where(np.arange(len(self.ids)) % 2, -1.0, 1.0) * _WAVE_RAD
        angle = self._centre + way * math.sin(phase)
        return np.array([angle, way * turn * math.cos(phase), -way * turn * turn * math.sin(phase)])

    def refuses(self) -> int:
        """Bad goals that are not refused."""
        accepted = 0
        for bad in (math.nan, math.inf, math.radians(LIMIT_DEG) + 0.5, -math.radians(LIMIT_DEG) - 0.5):
            goals = self.goals.copy()
            goals[-1] = bad
            try:
                self.bus.write(goals, self.clock.now_s())
            except ValueError:
                continue
            accepted += 1
        return accepted

    def states(self) -> list[dict[str, Any]]:
        """What an onlooker sees of every servo now."""
        self.chain.time_is(self.clock.now_s())
        return [self.chain.state(servo) for servo in self.ids]


class Judge:
    """Looks at the servos after every tick."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._shafts: list[Doubles] = []
        self._slack_rad = _STALE_TICKS / np.abs(rig.conversion.ticks_per_rad)
        self.outside = self.stale = 0
        self.well_since_s: float | None = None
        self.named: list[str] = []

    def see(self, readings: Mapping[str, Reading]) -> None:
        rig, states = self._rig, self._rig.states()
        shafts = rig.conversion.to_rad(np.array([state["position"] for state in states]))
        self._shafts.append(shafts)
        low, high = rig.conversion.low_ticks, rig.conversion.high_ticks
        for index, state in enumerate(states):
            if state["torque"] and state["goal"] is not None:
                self.outside += not low[index] <= state["goal"] <= high[index]
        for index, reading in enumerate(readings.values()):
            self.stale += self._misdated(index, reading)
        self.named = [f"{joint}: {r.fault}" for joint, r in readings.items() if r.fault is not None]
        fine = [self._well(i, r, states[i], shafts[i]) for i, r in enumerate(readings.values())]
        if not all(fine):
            self.well_since_s = None
        elif self.well_since_s is None:
            self.well_since_s = rig.clock.now_s()

    def _misdated(self, index: int, reading: Reading) -> bool:
        """Whether the servo stood elsewhere at the time that the reading names."""
        if reading.position_rad is None or not math.isfinite(reading.age_s):
            return False
        back = round(reading.age_s * RATE_HZ)
        if back >= len(self._shafts):
            return False  # from before the first tick
        return bool(abs(reading.position_rad - self._shafts[-1 - back][index]) > self._slack_rad[index])

    def _well(self, index: int, reading: Reading, state: Mapping[str, Any], shaft_rad: float) -> bool:
        if reading.fault is not None:
            return True  # out of the game, and says why
        told = not self._rig.tells_position or reading.age_s < _FRESH_S
        return told and state["torque"] and abs(shaft_rad - self._rig.goals[index]) < _FOLLOWS_RAD


def one(family: str, fault: str, ticks: int = TICKS) -> Outcome:
    """`ticks` of one family with one kind of fault."""
    head = head_of(family)
    with launch(emulated(head)["main"], virtual=True) as chain:
        clock = VirtualClock()
        rig = Rig(head, chain, clock, build_bus(head, {"main": chain}, clock, confirmed=True))
        try:
            rig.hold()
            return _ride(rig, family, fault, ticks)
        finally:
            rig.bus.stop("release")
            rig.bus.close()


def _ride(rig: Rig, family: str, fault: str, ticks: int) -> Outcome:
    judge = Judge(rig)
    start_s = rig.clock.now_s() + _QUIET * ticks / RATE_HZ
    end_s = start_s + _FAULTY * ticks / RATE_HZ
    try:
        rig.chain.inject(_spec(fault, rig.ids, start_s, end_s))
    except BusError as error:
        if "concerns no servo" not in str(error):
            raise
        return Outcome(family, fault, 0, possible=False)
    accepted = 0
    for tick in range(ticks):
        try:
            judge.see(rig.tick())
            if tick % _BAD_GOALS_EVERY == 0:
                accepted += rig.refuses()
        except Exception as error:  # what escapes is what is looked for
            escaped = f"{type(error).__name__}: {error}"
            return Outcome(family, fault, tick, True, escaped, judge.outside + accepted, judge.stale)
    since_s = judge.well_since_s
    recovered_s = None if since_s is None else max(0.0, since_s - end_s)
    return Outcome(family, fault, ticks, True, None, judge.outside + accepted, judge.stale, recovered_s, judge.named)


def _spec(fault: str, ids: Sequence[int], start_s: float, end_s: float) -> str:
    when = f"@{start_s:g}-{end_s:g}"
    return SPECS[fault].format(one=f":{ids[1]}", two=f":{ids[1]},{ids[2]}", when=when)


def run_campaign(
    families: Iterable[str] = tuple(FAMILIES),
    faults: Iterable[str] = tuple(KINDS),
    ticks: int = TICKS,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Outcome]:
    """Every fault on every family."""
    faults = list(faults)
    out = []
    for family in families:
        for fault in faults:
            progress(f"{family}: {fault}")
            out.append(one(family, fault, ticks))
    return out


def table(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row per run, as printed."""
    return [
        {
            "family": each.family,
            "fault": each.fault,
            "escaped": each.escaped or 0,
            "outside": each.outside,
            "stale": each.stale,
            "back s": None if each.recovered_s is None else round(each.recovered_s, 2),
            "out": len(each.named),
            "passed": ("yes" if each.passed else "NO") if each.possible else "-",
        }
        for each in outcomes
    ]
