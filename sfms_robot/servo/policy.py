"""What a joint's servo is allowed, and what its troubles lead to: faults and loads judged without a wire.

A servo reports faults as bits, told by the alert bit of every answer. Not all of them are trouble: a head that runs
at 7.2 V has the voltage alert set for good. So a fault may be masked, or count only when what is measured lies
outside a threshold of the head's own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from sfms_robot.config import Faults, FirmwareMap, LoadRule, Safety
from sfms_robot.config.firmware import Role

PINCH_SHARE: Final = 0.6  # of the servo's own current limit
PINCH_S: Final = 0.5


@dataclass(frozen=True)
class BusServo:
    """One servo of a bus and the joint it moves; the limits are those of the joint.

    Attributes:
        doctor: command that mends what the servo stores against the head's file.
    """

    joint: str
    id: int
    map: FirmwareMap
    min_rad: float
    max_rad: float
    safety: Safety = field(default_factory=Safety)
    doctor: str = "sfms-robot doctor --port PORT --head HEAD --fix"


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
