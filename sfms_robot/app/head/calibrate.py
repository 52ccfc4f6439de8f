"""`head calibrate`: joint by joint, where its ends and its rest are and which way it turns.

    who answers -> torque off, moved by hand, or moved by keys -> ends, rest, direction -> a slow check -> saved

All it needs of a terminal is a line out and a line in, so it works over any connection. Every joint is saved when it
is done: a calibration that is stopped goes on there the next time. Only the overlay of this build is written.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, Final, Literal, Protocol

import numpy as np

from sfms_robot.app.calibrated_head import identify
from sfms_robot.app.open_head import HeadOptions, build_bus, build_motion, open_wires
from sfms_robot.app.wiring import SIM
from sfms_robot.config import Head, Joint, load_firmware_map, load_head
from sfms_robot.config.overlay import (
    CalibrateLayer,
    Identity,
    Layered,
    Measured,
    Overlay,
    head_hash,
    layered,
    load_overlay,
    overlay_file,
    save_overlay,
)
from sfms_robot.emulator.launch import Chain
from sfms_robot.errors import BusError, ConfigError, ServoError, TorqueError
from sfms_robot.ports import Bus, Clock
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.families import family_named

LEAST_TRAVEL_DEG: Final = 2.0
ARRIVED_DEG: Final = 3.0  # a held servo sags a little
STEPS_DEG: Final[Mapping[str, float]] = {"+": 1.0, "-": -1.0, "++": 5.0, "--": -5.0}
Point = Literal["min", "max", "rest"]
TITLES: Final[Mapping[Point, str]] = {"min": "LOWER end", "max": "UPPER end", "rest": "REST"}
PACE_DEG_S: Final = 20.0
_PERIOD_S: Final = 0.01
_TRIES: Final = 20
_PULSE_US: Final = (500.0, 2500.0)  # what a hobby servo may be sent, whatever its board can make


class Talk(Protocol):
    """Somebody who reads and answers lines. `ask` raises EOFError or KeyboardInterrupt when they have gone."""

    def say(self, text: str) -> None: ...

    def ask(self, prompt: str) -> str: ...


class Stopped(Exception):  # noqa: N818  (nothing is wrong)
    """Whoever calibrates wants to stop here."""


class Skipped(Exception):  # noqa: N818
    """Not this joint."""


class Again(Exception):  # noqa: N818
    """This joint once more; the text says why."""


@dataclass
class Outcome:
    """What came of it: joints measured now and before, joints left out with the reason, and what the check found.

    `torque_unconfirmed`: joints whose torque came on and could not be confirmed off.
    """

    head: str
    file: Path
    exit: Literal["done", "interrupted"] = "done"
    measured: list[str] = field(default_factory=list)
    before: list[str] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    torque_unconfirmed: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        return {"version": 1, **vars(self), "file": str(self.file)}


def calibrate(name: str, port: str, talk: Talk, joints: Sequence[str] = (), again: bool = False) -> Outcome:
    """Lead through the joints of a head on `port`, or those named.

    Emulated servos (`sim`) are for practice: what is measured there is kept apart and never used. `again`: also joints
    that are measured already. Raises RobotError.
    """
    head = load_head(name)
    with open_wires(head, HeadOptions(name, port)) as where:
        file = overlay_file(head.name, practice=port == SIM)
        return calibrate_on(name, where, RealClock(), talk, file, date.today(), joints, again)


def calibrate_on(
    name: str,
    where: Mapping[str, Chain | str],
    clock: Clock,
    talk: Talk,
    file: Path,
    today: date,
    joints: Sequence[str] = (),
    again: bool = False,
) -> Outcome:
    """As `calibrate`, on buses that are there, into `file`."""
    head, sha256 = load_head(name), head_hash(name)
    for joint in joints:
        if joint not in head.joints:
            raise ConfigError.at(name, "--joint", joint, "is not a joint of this head", head.joints)
    wanted = list(joints or head.joints)
    outcome = Outcome(head.name, file)
    overlay = load_overlay(head, file)
    servos = identify(head, wanted, where, clock)
    try:
        overlay = _of_this_file(overlay, sha256, talk)
        holds = layered(head, overlay, sha256, servos).calibrated
        outcome.before = [joint for joint in wanted if joint in holds and not again]
        todo = [joint for joint in wanted if joint not in outcome.before]
        talk.say(f"{head.name}: {len(outcome.before)} joints are measured, {len(todo)} to go; saved to {file}")
        talk.say("Enter takes what stands first; q stops at any question, and the next time goes on from there.")
        for number, joint in enumerate(todo, 1):
            talk.say(f"\n[{number}/{len(todo)}] {_described(joint, head.joints[joint])}")
            found = _one(head, joint, servos[joint], where, clock, talk, today, outcome)
            if found is not None:
                overlay = _with(overlay, sha256, joint, found)
                save_overlay(overlay, file)
                outcome.measured.append(joint)
                talk.say("  saved")
    except (Stopped, KeyboardInterrupt):
        outcome.exit = "interrupted"
    _check(head, sha256, servos, outcome)
    return outcome


def _one(
    head: Head,
    joint: str,
    identity: Identity | None,
    where: Mapping[str, Chain | str],
    clock: Clock,
    talk: Talk,
    today: date,
    outcome: Outcome,
) -> Measured | None:
    """Measure one joint until it is right; None when it is left out."""
    config = head.joints[joint]
    try:
        if identity is None:
            raise BusError(f"no answer from id {config.id} on bus {config.bus!r}")
        by_hand = _ask_how(talk, jumps(head, joint))
        unconfirmed = outcome.torque_unconfirmed
        with probe(head, joint, where[config.bus], clock, stored=identity.stored, unconfirmed=unconfirmed) as at:
            while True:
                try:
                    return _measure(config, identity, at, by_hand, talk, today)
                except Again as reason:
                    talk.say(f"  {reason}; once more")
    except (Skipped, BusError, ServoError) as reason:
        outcome.skipped[joint] = str(reason)
        talk.say(f"  left out: {reason}")
        return None


def _ask_how(talk: Talk, blind: bool) -> bool:
    """True: by hand."""
    if blind:
        _ask(talk, "  It reports no position and JUMPS when it comes on: keep clear. Enter: by keys, s: skip > ")
        return False
    return _ask(talk, "  Enter: by hand, torque off; k: by keys; s: skip > ") != "k"


def _measure(joint: Joint, identity: Identity, at: Probe, by_hand: bool, talk: Talk, today: date) -> Measured:
    ticks = {point: _point(joint, point, at, by_hand, talk) for point in _points(joint)}
    low, high = ticks["min"], ticks["max"]
    travel_deg = abs(high - low) / at.ticks_per_deg
    if travel_deg < LEAST_TRAVEL_DEG:
        raise Again(f"its ends are only {travel_deg:.1f} deg apart")
    rest = ticks.get("rest", low if joint.rest_deg == joint.min_deg else high)
    if not min(low, high) <= rest <= max(low, high):
        raise Again(f"its rest, {rest} ticks, is not between its ends, {low} and {high}")
    sign: Literal[1, -1] = 1 if high > low else -1
    talk.say(f"  {low}..{rest}..{high} ticks, {travel_deg:.1f} deg (its file: {joint.max_deg - joint.min_deg:.1f})")
    if sign != joint.sign:
        turns = "fall" if sign < 0 else "rise"
        question = f"  Ticks {turns} towards the upper end, other than its file says. Is that so? Enter: yes, n: no > "
        if _ask(talk, question) == "n":
            raise Again("its ends were mixed up")
    _look(low, high, rest, at, talk)
    found = {"date": today, "min_ticks": low, "center_ticks": rest, "max_ticks": high, "sign": sign}
    return Measured(**identity.model_dump(), **found)


def _points(joint: Joint) -> tuple[Point, ...]:
    """A joint that rests at an end has no rest of its own to show."""
    return ("min", "max") if joint.rest_deg in (joint.min_deg, joint.max_deg) else ("min", "max", "rest")


def _point(joint: Joint, point: Point, at: Probe, by_hand: bool, talk: Talk) -> int:
    where = f"  {TITLES[point]} ({getattr(joint, f'{point}_deg'):g} deg in its file)"
    if by_hand:
        at.limp()
        _ask(talk, f"{where}: move it there by hand, not into its stop. Enter records > ")
        return at.ticks()
    while True:
        key = _ask(talk, f"{where}, now at {at.ticks()} ticks: + - (1 deg) ++ -- (5 deg) or degrees; Enter records > ")
        if not key:
            return at.ticks()
        try:
            at.by(STEPS_DEG[key] if key in STEPS_DEG else float(key))
        except (ValueError, OverflowError):
            talk.say(f"  {key!r} is not a step (+, -, ++, --, a number of degrees, Enter)")


def _look(low: int, high: int, rest: int, at: Probe, talk: Talk) -> None:
    """Go to the ends and to rest slowly, and ask whether that was right."""
    if _ask(talk, "  Enter: check it, slowly to both ends and to rest; n: without a check > ") == "n":
        return
    for ticks in (low, high, rest):
        at.go(ticks)
        off_deg = abs(at.ticks() - ticks) / at.ticks_per_deg
        if off_deg > ARRIVED_DEG:
            talk.say(
                f"  at {at.ticks()} ticks in place of {ticks}: it is {off_deg:.1f} deg off, is something in its way?"
            )
    if _ask(talk, "  Was that right? Enter: yes, n: measure again > ") == "n":
        raise Again("it was not right")


def _ask(talk: Talk, prompt: str) -> str:
    try:
        answer = talk.ask(prompt).strip().lower()
    except (EOFError, KeyboardInterrupt):
        raise Stopped from None
    if answer == "q":
        raise Stopped
    if answer == "s":
        raise Skipped("skipped")
    return answer


def _described(name: str, joint: Joint) -> str:
    note = f" ({joint.note})" if joint.note else ""
    return f"{name}{note}: {joint.model} id {joint.id} on bus {joint.bus}"


def _of_this_file(overlay: Overlay, sha256: str, talk: Talk) -> Overlay:
    """Measurements of an older head file are kept only if somebody says so."""
    old = overlay.calibrate
    if old is None or old.head_sha256 == sha256 or not old.joints:
        return overlay
    try:
        kept = (
            _ask(talk, "The head's file has changed since. Enter: measure again; k: keep what was measured > ") == "k"
        )
    except Skipped:
        kept = False
    joints = old.joints if kept else {}
    return overlay.model_copy(update={"calibrate": CalibrateLayer(head_sha256=sha256, joints=joints)})


def _with(overlay: Overlay, sha256: str, joint: str, found: Measured) -> Overlay:
    joints = overlay.calibrate.joints if overlay.calibrate is not None else {}
    layer = CalibrateLayer(head_sha256=sha256, joints={**joints, joint: found})
    overlay = overlay.model_copy(update={"calibrate": layer})
    return overlay.recorded(sha256, joint, found.stored) if overlay.stored is not None else overlay


def _check(head: Head, sha256: str, servos: Mapping[str, Identity | None], outcome: Outcome) -> None:
    """Read back what was written, lay it over the head, and build the head's motion from it."""
    try:
        layers: Layered = layered(head, load_overlay(head, outcome.file), sha256, servos)
        build_motion(layers.head, max(bus.rate_hz for bus in head.buses.values()))
    except ConfigError as error:
        outcome.problems.append(str(error))
        return
    outcome.problems += [f"{joint}: {problem}" for joint, problem in layers.refused.items()]
    outcome.missing = [joint for joint in head.joints if joint not in layers.calibrated]


# --- one joint on its own, in servo ticks ---------------------------------------------------------------------------


class Probe:
    """A joint whose bus is open: where it stands, limp, and by keys.

    The bus is opened with this joint alone and with the whole travel of its servo as its range, for its range has yet
    to be found. It moves only on request, at a slow and steady pace.

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
