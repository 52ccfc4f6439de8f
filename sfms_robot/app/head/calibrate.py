"""`head calibrate`: measure, joint by joint, the ends of its range, its rest and its direction.

    the servo that answers -> torque off and by hand, or by keys -> ends, rest, direction -> a slow check -> saved

It only writes and reads single lines, so it works over any connection. Every joint is saved when it is done, so a
stopped calibration continues there the next time. Only the overlay of this build is written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import BaseModel

from sfms_robot.app.open_head import build_bus, build_motion, doctor_command, fastest_hz, identify
from sfms_robot.app.options import SIM
from sfms_robot.app.servo.move import SPEED_DEG_S
from sfms_robot.app.wiring import Opened, calibration_of, open_wires
from sfms_robot.config import Head, Joint, load_firmware_map, load_head
from sfms_robot.config.overlay import (
    CalibrateLayer,
    Identity,
    Measured,
    check_writable,
    head_hash,
    layered,
    load_overlay,
    overlay_file,
    save_overlay,
)
from sfms_robot.emulator.launch import Chain
from sfms_robot.errors import BusError, ConfigError, RobotError, ServoError, TorqueError
from sfms_robot.ports import Bus, Clock
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.families import family_named
from sfms_robot.servo.policy import BusServo

LEAST_TRAVEL_DEG: Final = 2.0
ARRIVED_DEG: Final = 3.0  # a held servo sags a little
STEPS_DEG: Final[Mapping[str, float]] = {"+": 1.0, "-": -1.0, "++": 5.0, "--": -5.0}
TITLES: Final[Mapping[str, str]] = {"min": "LOWER end", "max": "UPPER end", "rest": "REST"}
_PERIOD_S: Final = 0.01
_TRIES: Final = 20
_PULSE_US: Final = (500.0, 2500.0)  # widest pulses that a hobby servo may be sent, even if its board can generate more


Say = Callable[[str], object]
Ask = Callable[[str], str]  # raises EOFError or KeyboardInterrupt when the user has gone


class SkippedError(ServoError):
    """The user leaves this joint out."""


class AgainError(RobotError):
    """This joint is to be measured again; the text says why."""


class CalibrationOutcome(BaseModel):
    """The result of a calibration, and with `model_dump(mode="json")` its report.

    Attributes:
        measured, before: joints measured now, and earlier.
        skipped: joints left out, with the reason.
        missing: joints without a measurement that holds.
        problems: found when the file was read back.
        torque_unconfirmed: joints whose torque came on and could not be confirmed off.
    """

    version: Literal[1] = 1
    head: str
    file: Path
    exit: Literal["done", "interrupted"] = "done"
    measured: list[str] = []
    before: list[str] = []
    skipped: dict[str, str] = {}
    missing: list[str] = []
    problems: list[str] = []
    torque_unconfirmed: list[str] = []


def calibrate(
    name: str, port: str, say: Say, ask: Ask, joints: Sequence[str] = (), again: bool = False
) -> CalibrationOutcome:
    """Guide the user, by `say` and `ask`, through the joints of a head on `port`, or through the given `joints`.

    Emulated servos (`sim`) are for practice: their measurements are kept apart and never used. `again`: also joints
    that are measured already. Raises RobotError.
    """
    head, guide = load_head(name), Guide(say, ask, date.today(), doctor_command(name, port))
    file = check_writable(overlay_file(head.name, practice=port == SIM))
    with open_wires(head, port) as where:
        return calibrate_on(name, where, RealClock(), guide, file, joints=joints, again=again)


def calibrate_on(
    name: str, where: Opened, clock: Clock, guide: Guide, file: Path, *, joints: Sequence[str] = (), again: bool = False
) -> CalibrationOutcome:
    """Calibrate as `calibrate` does, on the buses at `where`, into `file`."""
    head, sha256 = load_head(name), head_hash(name)
    for joint in joints:
        if joint not in head.joints:
            raise ConfigError.at(name, "--joint", joint, "is not a joint of this head", head.joints)
    wanted = list(joints or head.joints)
    outcome = CalibrationOutcome(head=head.name, file=file)
    overlay = load_overlay(head, file)
    servos, say = identify(head, wanted, where, clock), guide.say
    try:
        if (old := overlay.calibrate) is not None and old.head_sha256 != sha256 and old.joints:
            kept = old.joints if guide.keeps_old() else {}
            overlay = overlay.replaced(calibrate=CalibrateLayer(head_sha256=sha256, joints=kept))
        holds = layered(head, overlay, sha256, servos).calibrated
        outcome.before = [joint for joint in wanted if joint in holds and not again]
        todo = [joint for joint in wanted if joint not in outcome.before]
        say(f"{head.name}: {len(outcome.before)} joints are measured, {len(todo)} to go; saved to {file}")
        say("Enter takes the first choice; q stops at any question, and the next time continues from there.")
        for number, joint in enumerate(todo, 1):
            config = head.joints[joint]
            note = f" ({config.note})" if config.note else ""
            servo = f"{config.model} id {config.id} on bus {config.bus}"
            say(f"\n[{number}/{len(todo)}] {joint}{note}: {servo}")
            try:
                identity = servos[joint]
                if identity is None:
                    raise BusError(f"no answer from id {config.id} on bus {config.bus!r}")
                by_hand = guide.asks_how(family_named(head.buses[config.bus].family).board)
                with probe(
                    head,
                    joint,
                    where[config.bus],
                    clock,
                    stored=identity.stored,
                    unconfirmed=outcome.torque_unconfirmed,
                    doctor=guide.doctor,
                ) as at:
                    found = guide.measure_until_right(config, identity, at, by_hand)
            except (BusError, ServoError) as reason:
                outcome.skipped[joint] = str(reason)
                say(f"  left out: {reason}")
                continue
            measured = {**overlay.measured, joint: found}
            overlay = overlay.replaced(calibrate=CalibrateLayer(head_sha256=sha256, joints=measured))
            if overlay.stored is not None:
                overlay = overlay.recorded(sha256, joint, found.stored)
            save_overlay(overlay, file)
            outcome.measured.append(joint)
            say("  saved")
    except KeyboardInterrupt:
        outcome.exit = "interrupted"
    _check(head, sha256, servos, outcome)
    return outcome


@dataclass(frozen=True)
class Guide:
    """The questions of a calibration. Each raises KeyboardInterrupt for "q" and at the end of the input.

    `doctor`: the command that is named in messages about stored values, see `BusServo`.
    """

    say: Say
    ask: Ask
    today: date
    doctor: str = BusServo.doctor

    def keeps_old(self) -> bool:
        """Ask whether measurements for an older head file are kept."""
        question = "The head's file has changed since. Enter: measure again; k: keep the measurements > "
        with suppress(SkippedError):
            return self._ask(question) == "k"
        return False

    def asks_how(self, blind: bool) -> bool:
        """Ask whether the joint is moved by hand; a joint whose servo reports no position is moved by keys."""
        if blind:
            self._ask("  It reports no position and JUMPS when it comes on: keep clear. Enter: by keys, s: skip > ")
            return False
        return self._ask("  Enter: by hand, torque off; k: by keys; s: skip > ") != "k"

    def measure_until_right(self, joint: Joint, identity: Identity, at: JointProbe, by_hand: bool) -> Measured:
        """Measure a joint until the measurement is plausible. Raises SkippedError, BusError, ServoError."""
        while True:
            try:
                return self._measure(joint, identity, at, by_hand)
            except AgainError as reason:
                self.say(f"  {reason}; once more")

    def _measure(self, joint: Joint, identity: Identity, at: JointProbe, by_hand: bool) -> Measured:
        rests_at_end = joint.rest_deg in (joint.min_deg, joint.max_deg)
        low, high = (self._point(joint, point, at, by_hand) for point in ("min", "max"))
        rest = low if joint.rest_deg == joint.min_deg else high
        if not rests_at_end:
            rest = self._point(joint, "rest", at, by_hand)
        travel_deg = abs(high - low) / at.ticks_per_deg
        if travel_deg < LEAST_TRAVEL_DEG:
            raise AgainError(f"its ends are only {travel_deg:.1f} deg apart")
        if not min(low, high) <= rest <= max(low, high):
            raise AgainError(f"its rest, {rest} ticks, is not between its ends, {low} and {high}")
        sign: Literal[1, -1] = 1 if high > low else -1
        self.say(f"  {low}..{rest}..{high} ticks, {travel_deg:.1f} deg (its file: {joint.max_deg - joint.min_deg:.1f})")
        if sign != joint.sign:
            turns = "fall" if sign < 0 else "rise"
            said = f"  Ticks {turns} towards the upper end, its file has the other sign. Right? Enter: yes, n: no > "
            if self._ask(said) == "n":
                raise AgainError("its ends were mixed up")
        self._check_ends(low, high, rest, at)
        return Measured(
            **identity.model_dump(), date=self.today, min_ticks=low, center_ticks=rest, max_ticks=high, sign=sign
        )

    def _point(self, joint: Joint, point: str, at: JointProbe, by_hand: bool) -> int:
        """Return the ticks at which, according to the user, the joint is at its end or its rest."""
        where = f"  {TITLES[point]} ({getattr(joint, f'{point}_deg'):g} deg in its file)"
        if by_hand:
            at.limp()
            self._ask(f"{where}: move it there by hand, not into its stop. Enter records > ")
            return at.ticks()
        while True:
            keys = "+ - (1 deg) ++ -- (5 deg) or degrees; Enter records > "
            key = self._ask(f"{where}, now at {at.ticks()} ticks: {keys}")
            if not key:
                return at.ticks()
            try:
                at.by(STEPS_DEG[key] if key in STEPS_DEG else float(key))
            except (ValueError, OverflowError):
                self.say(f"  {key!r} is not a step (+, -, ++, --, a number of degrees, Enter)")

    def _check_ends(self, low: int, high: int, rest: int, at: JointProbe) -> None:
        """Move to the ends and to rest slowly, and ask whether that was right. Raises AgainError if not."""
        if self._ask("  Enter: check it, slowly to both ends and to rest; n: without a check > ") == "n":
            return
        for ticks in (low, high, rest):
            at.go(ticks)
            off_deg = abs(at.ticks() - ticks) / at.ticks_per_deg
            if off_deg > ARRIVED_DEG:
                place = f"at {at.ticks()} ticks in place of {ticks}"
                self.say(f"  {place}: it is {off_deg:.1f} deg off, is something in its way?")
        if self._ask("  Was that right? Enter: yes, n: measure again > ") == "n":
            raise AgainError("it was not right")

    def _ask(self, prompt: str) -> str:
        try:
            answer = self.ask(prompt).strip().lower()
        except EOFError:
            answer = "q"
        if answer == "q":
            raise KeyboardInterrupt
        if answer == "s":
            raise SkippedError("skipped")
        return answer


def _check(head: Head, sha256: str, servos: Mapping[str, Identity | None], outcome: CalibrationOutcome) -> None:
    """Read the file back, apply it to the head, and build the head's motion from it."""
    try:
        layers = layered(head, load_overlay(head, outcome.file), sha256, servos)
        build_motion(layers.head, fastest_hz(head))
    except ConfigError as error:
        outcome.problems.append(str(error))
        return
    outcome.problems += [f"{joint}: {problem}" for joint, problem in layers.refused.items()]
    outcome.missing = [joint for joint in head.joints if joint not in layers.calibrated]


# --- one joint alone, in servo ticks --------------------------------------------------------------------------------


class JointProbe:
    """A joint on an open bus.

    The bus is opened with this joint alone and with the whole travel of its servo as its range, since its range is not
    known yet. It moves only on request, at a slow and steady pace.

    Attributes:
        tells: whether its servo reports its position.
        ticks_per_deg: ticks per degree of the joint, without direction.
    """

    def __init__(self, name: str, joint: Joint, bus: Bus, clock: Clock) -> None:
        self.name = name
        self.tells = "position" in bus.capabilities[name]
        self._joint, self._bus, self._clock = joint, bus, clock
        self._calibration = calibration_of({name: joint})
        self.ticks_per_deg = math.radians(abs(float(self._calibration.ticks_per_rad[0])))
        self._goal_rad: float | None = None  # the position at which it is held; None without torque

    def ticks(self) -> int:
        """Return its position, or its goal if the servo reports no position. Raises ServoError."""
        if not self.tells:
            return self._ticks(self._goal_rad if self._goal_rad is not None else self._joint.rest_rad)
        for _ in range(_TRIES):
            reading = self._bus.poll(self._clock.now_s())[self.name]
            if reading.position_rad is not None and reading.age_s < 2 * _PERIOD_S:
                return self._ticks(reading.position_rad)
            self._clock.wait_until(self._clock.now_s() + _PERIOD_S)
        raise ServoError(f"{self.name} (id {self._joint.id}) does not report its position")

    def limp(self) -> None:
        """Switch torque off, so that a hand can move it. Raises TorqueError if that could not be confirmed."""
        self._bus.stop("release")
        if unconfirmed := self._bus.statistics()["torque_unconfirmed"]:
            raise TorqueError(unconfirmed)
        self._goal_rad = None

    def go(self, ticks: int) -> None:
        """Move slowly to `ticks`, torque on from where it stands, and hold. Blocks until then."""
        if self._goal_rad is None:
            self._goal_rad = float(self._bus.enable([self.name])[0])
        inside = np.clip([ticks], self._calibration.low_ticks, self._calibration.high_ticks)
        start_rad, to_rad = self._goal_rad, float(self._calibration.to_rad(inside)[0])
        steps = max(1, math.ceil(math.degrees(abs(to_rad - start_rad)) / (SPEED_DEG_S * _PERIOD_S)))
        began_s = self._clock.now_s()
        for k in range(1, steps + 1):
            self._goal_rad = start_rad + (to_rad - start_rad) * k / steps
            self._bus.write(np.array([self._goal_rad]), self._clock.now_s())
            self._bus.poll(self._clock.now_s())
            self._clock.wait_until(began_s + k * _PERIOD_S)

    def by(self, step_deg: float) -> None:
        """Move as `go` does, by a step from the goal, so that a joint that sags still moves. Raises ValueError."""
        here = self.ticks() if self._goal_rad is None else self._ticks(self._goal_rad)
        self.go(here + round(step_deg * self.ticks_per_deg))

    def _ticks(self, angle_rad: float) -> int:
        return int(self._calibration.to_ticks(np.array([angle_rad]))[0])


@contextmanager
def probe(
    head: Head,
    name: str,
    where: Chain | str,
    clock: Clock,
    *,
    stored: Mapping[str, int],
    unconfirmed: list[str],
    doctor: str,
) -> Iterator[JointProbe]:
    """Open the joint's bus. At the end switch torque off, and add the joint to `unconfirmed` if that is not confirmed.

    `stored`: zero and direction as its servo stores them; a measurement may begin from any values. Raises RobotError
    for a servo that contradicts the head's file.
    """
    joint, safety = head.joints[name], head.safety_of(name)
    safety = safety.replaced(stop="release", stored={**safety.stored, **stored})
    joint = joint.replaced(safety=safety, **_whole_travel(joint))
    # A user takes longer to answer than a watchdog waits.
    config = head.buses[joint.bus].replaced(watchdog_ms=0)
    alone = head.replaced(joints={name: joint}, buses={joint.bus: config})
    bus = build_bus(alone, {joint.bus: where}, clock, confirmed=True, doctor=doctor)
    try:
        bus.connect()
        yield JointProbe(name, joint, bus, clock)
    finally:
        bus.stop("release")
        unconfirmed += bus.statistics()["torque_unconfirmed"]
        bus.close()


def _whole_travel(joint: Joint) -> dict[str, float]:
    """Return the whole range of the servo, or of a common servo on a board, extended to include rest."""
    firmware = load_firmware_map(joint.model)
    ticks = 0, int(firmware.ticks_per_revolution) - 1
    if firmware.pulse_us is not None and firmware.tick_us is not None:
        shortest, longest = max(firmware.pulse_us.min, _PULSE_US[0]), min(firmware.pulse_us.max, _PULSE_US[1])
        ticks = math.ceil(shortest / firmware.tick_us), math.floor(longest / firmware.tick_us)
    per_deg = joint.sign * joint.ratio * firmware.ticks_per_revolution / 360.0
    ends = sorted((tick - joint.zero_ticks) / per_deg for tick in ticks)
    return {"min_deg": min(ends[0], joint.rest_deg), "max_deg": max(ends[1], joint.rest_deg)}
