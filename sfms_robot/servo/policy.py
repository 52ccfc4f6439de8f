"""What a joint's servo is allowed, and what its troubles lead to: faults and loads judged without a wire.

A servo reports faults as bits, told by the alert bit of every answer. Not all of them are trouble: a head that runs
at 7.2 V has the voltage alert set for good. So a fault may be masked, or count only when what is measured lies
outside a threshold of the head's own.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from sfms_robot.config import Faults, FirmwareMap, LoadRule, Safety
from sfms_robot.config.firmware import Role

log = logging.getLogger(__name__)

PINCH_SHARE: Final = 0.6  # of the servo's own current limit
PINCH_S: Final = 0.5
SAID_EVERY_S: Final = 10.0


@dataclass(frozen=True)
class BusServo:
    """One servo of a bus and the joint it moves; the limits are those of the joint."""

    joint: str
    id: int
    map: FirmwareMap
    min_rad: float
    max_rad: float
    safety: Safety = field(default_factory=Safety)


@dataclass(frozen=True)
class Measured:
    """What is known of one servo beside its fault bits; None where it was not read yet."""

    voltage_V: float | None = None
    temperature_C: float | None = None


def counts(name: str, faults: Faults, seen: Measured) -> bool:
    """Whether fault `name` is acted upon. A threshold whose quantity is not known yet does not excuse it."""
    if name in faults.mask:
        return False
    threshold = faults.thresholds.get(name)
    value = {"input voltage": seen.voltage_V, "overheating": seen.temperature_C}.get(name)
    if threshold is None or value is None:
        return True
    low = threshold.min is not None and value < threshold.min
    high = threshold.max is not None and value > threshold.max
    return low or high


class Voice:
    """Says of every servo what is wrong with it, and what is not held against it, once each.

    Attributes:
        said: every fault so far, `joint: fault`, in the order of appearance.
    """

    def __init__(self, servos: Sequence[BusServo], faults: Faults) -> None:
        self._servos = servos
        self._faults = faults
        self._excused: set[str] = set()
        self.said: dict[str, None] = {}

    def counts(self, index: int, name: str, seen: Measured) -> bool:
        """`counts` for servo `index`; a fault that does not is mentioned."""
        if counts(name, self._faults, seen):
            return True
        excuse = f"{self._servos[index].joint}: {name}"
        if excuse not in self._excused:
            self._excused.add(excuse)
            log.info("%s reports %s, which this head's configuration allows", self.about(index), name)
        return False

    def say(self, index: int, fault: str) -> None:
        named = f"{self._servos[index].joint}: {fault}"
        if named not in self.said:
            log.warning("%s: %s", self.about(index), fault)
        self.said[named] = None

    def about(self, index: int) -> str:
        return f"{self._servos[index].joint} (id {self._servos[index].id})"


class Absences:
    """Says which servo falls silent and which is back, each at most once in ten seconds.

    A loose contact comes and goes many times a second. What is held back is counted into the next line, and who stays
    away is told as soon as the ten seconds are over, at the next `gone`.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._said_s: dict[int, float] = {}
        self._held_back: dict[int, int] = {}
        self._away: set[int] = set()  # who was said to be away

    def gone(self, index: int, now_s: float, again: bool = True) -> None:
        """`again` is False when the servo was away already, and still is."""
        if index in self._away:
            return
        if now_s < self._said_s.get(index, -SAID_EVERY_S) + SAID_EVERY_S:
            self._held_back[index] = self._held_back.get(index, 0) + again
            return
        before = self._held_back.pop(index, 0)
        log.warning("%s is silent%s", self._names[index], f" ({before} times since the last word)" if before else "")
        self._said_s[index] = now_s
        self._away.add(index)

    def back(self, index: int) -> None:
        if index in self._away:
            self._away.remove(index)
            log.warning("%s answers again", self._names[index])


def register_of(table: FirmwareMap, role: Role) -> str | None:
    """Name of the register that plays a role; None where the model has none."""
    name = table.roles.get(role, role)
    return name if name in table.registers else None


def tells_current(table: FirmwareMap) -> bool:
    """Whether the model tells its present current in mA."""
    name = register_of(table, "present_current")
    return name is not None and table.registers[name].unit == "mA"


def torque_register(table: FirmwareMap) -> str | None:
    """Name of the register, in percent, that bounds the torque; the PWM where the model has no other.

    Both bound the voltage at the motor, so the torque of a stalled servo falls in proportion.
    """
    for name in (register_of(table, "torque_limit"), "goal_pwm"):
        if name in table.registers and table.registers[name].unit == "percent":
            return name
    return None


def torque_limit(servo: BusServo) -> dict[str, int]:
    """Register and raw value that keep `torque_limit_percent`; empty where the joint has no such limit."""
    percent, name = servo.safety.torque_limit_percent, torque_register(servo.map)
    if percent is None or name is None:
        return {}
    register = servo.map.registers[name]
    return {name: min(register.high, round(percent / register.scale))}


def load_rules(servo: BusServo) -> list[tuple[str, LoadRule]]:
    """The rules of a joint, named; none where its servo cannot tell its current."""
    if not tells_current(servo.map):
        return []
    rules = [("pinched", servo.safety.pinch), ("under load too long", servo.safety.strain)]
    limit = servo.map.registers.get("current_limit")
    if servo.safety.pinch is None and limit is not None and limit.initial:
        own = LoadRule(current_mA=PINCH_SHARE * limit.initial * limit.scale, for_s=PINCH_S, then="limp")
        rules[0] = ("pinched", own)
    return [(name, rule) for name, rule in rules if rule is not None]


class LoadWatch:
    """Since when each rule of each joint is broken. Currents may come at any pace."""

    def __init__(self, servos: Sequence[BusServo]) -> None:
        self._rules = [[(name, rule.current_mA, rule.for_s, rule) for name, rule in load_rules(s)] for s in servos]
        self._since_s: list[dict[str, float]] = [{} for _ in servos]
        self.lowest_mA = [min((current for _, current, _, _ in rules), default=float("inf")) for rules in self._rules]

    def step(self, index: int, current_mA: float, now_s: float) -> tuple[str, LoadRule] | None:
        """Take one current; the rule that is broken for long enough, once."""
        since = self._since_s[index]
        for name, limit_mA, for_s, rule in self._rules[index]:
            if abs(current_mA) <= limit_mA:
                since.pop(name, None)
            elif now_s - since.setdefault(name, now_s) >= for_s:
                since.clear()
                return name, rule
        return None

    def pending(self, index: int) -> bool:
        return bool(self._since_s[index])
