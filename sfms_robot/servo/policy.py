"""Limits of a joint's servo, and the rules that decide which faults and loads are acted upon. No I/O.

A servo reports faults as bits. Not all of them matter: a head that runs at 7.2 V has the voltage fault set all the
time. So the head's file may mask a fault, or set a threshold: the fault counts only outside of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from sfms_robot.config import Faults, LoadRule, Safety
from sfms_robot.servo.registers import Field, Table

PINCH_SHARE: Final = 0.6  # share of the servo's own current limit
PINCH_S: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class BusServo:
    """A servo of a bus and the joint it moves; the limits are those of the joint.

    Attributes:
        doctor: command that corrects the stored settings of the servo to match the head's file.
    """

    joint: str
    id: int
    table: Table
    min_rad: float
    max_rad: float
    safety: Safety = field(default_factory=Safety)
    doctor: str = "sfms-robot doctor --port PORT --head HEAD --fix"

    def __str__(self) -> str:
        return f"{self.joint} (id {self.id})"

    @property
    def calibrate(self) -> str:
        """Return the command that measures this joint, with the port and the head of `doctor`."""
        words = self.doctor.replace(" doctor ", " head calibrate ", 1).replace(" --head ", " ", 1)
        return f"{words.removesuffix(' --fix')} --joint {self.joint}"

    @property
    def nearest_to_zero_rad(self) -> float:
        """Return 0 rad, or the end of the range nearest to it."""
        return min(max(0.0, self.min_rad), self.max_rad)


def counts(name: str, faults: Faults, measured: Mapping[str, float | None]) -> bool:
    """Return whether fault `name` is acted upon.

    `measured`: the value that is compared with the threshold, by fault. A fault whose value is not known yet counts.
    """
    threshold, value = faults.thresholds.get(name), measured.get(name)
    if name in faults.mask:
        return False
    if threshold is None or value is None:
        return True
    low = threshold.min is not None and value < threshold.min
    high = threshold.max is not None and value > threshold.max
    return low or high


def tells_current(table: Table) -> bool:
    """Return whether the model reports its present current in mA."""
    field = table.role("present_current")
    return field is not None and field.unit == "mA"


def torque_register(table: Table) -> Field | None:
    """Return the register, in percent, that bounds the torque: `torque_limit`, or `goal_pwm` if the model has no other.

    Both bound the voltage at the motor, so the torque of a stalled servo falls in proportion.
    """
    fields = table.role("torque_limit"), table.fields.get("goal_pwm")
    return next((field for field in fields if field is not None and field.unit == "percent"), None)


def torque_limit(servo: BusServo) -> dict[str, int]:
    """Return the register and the raw value that keep `torque_limit_percent`; empty for a joint without that limit."""
    percent, field = servo.safety.torque_limit_percent, torque_register(servo.table)
    if percent is None or field is None:
        return {}
    return {field.name: min(field.high, round(percent / field.scale))}


def load_rules(servo: BusServo) -> list[tuple[str, LoadRule]]:
    """Return the named load rules of a joint; empty if its servo does not report its current."""
    if not tells_current(servo.table):
        return []
    pinch, limit = servo.safety.pinch, servo.table.fields.get("current_limit")
    if pinch is None and limit is not None and limit.initial:
        pinch = LoadRule(current_mA=PINCH_SHARE * limit.initial * limit.scale, for_s=PINCH_S, then="limp")
    rules = {"pinched": pinch, "under load too long": servo.safety.strain}
    return [(name, rule) for name, rule in rules.items() if rule is not None]
