"""What a head's file asks of its servos for the sake of gentleness, and as to their turns, and whether they can."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfms_robot.config import FirmwareMap, Head, Joint
from sfms_robot.config.safety_rules import check_registers
from sfms_robot.errors import ConfigError
from sfms_robot.motion.calibration import Calibration
from sfms_robot.servo.policy import tells_current, torque_register
from sfms_robot.servo.stored_settings import JointNeeds, home_ticks


def check_safety(head: Head, joints: Mapping[str, Joint], maps: Mapping[str, FirmwareMap]) -> None:
    """Of joints, and the maps of their models. A rule that nobody keeps is worse than none.

    Raises ConfigError for a limit that a joint's servo cannot keep, a register that a run must not write, or more
    turns than it makes.
    """
    for name, joint in joints.items():
        _limits(head, name, maps[joint.model])
        _turns(head, name, maps[joint.model])
    check_registers(head.name, {name: (head.safety_of(name), maps[joint.model]) for name, joint in joints.items()})


def _limits(head: Head, name: str, table: FirmwareMap) -> None:
    safety, joint = head.safety_of(name), head.joints[name]
    can_limit, can_tell = torque_register(table) is not None, tells_current(table)
    instead = "; torque_limit_percent limits its torque" if can_limit else ""
    impossible: dict[str, tuple[float | None, str]] = {}
    if "goal_current" not in table.registers:
        impossible["current_limit_mA"] = safety.current_limit_mA, f"cannot limit its current{instead}"
    if not can_limit:
        impossible["torque_limit_percent"] = safety.torque_limit_percent, "has no torque limit"
    if not can_tell:
        for key in ("pinch", "strain"):
            rule = getattr(safety, key)
            impossible[key] = rule and rule.current_mA, "does not tell its current in mA"
    for key, (value, why) in impossible.items():
        if value is None:
            continue
        if joint.safety is not None and key in joint.safety.model_fields_set:
            raise ConfigError.at(
                head.name, f"joints.{name}.safety.{key}", value, f"cannot be kept: {joint.model} {why}"
            )
        except_here = f"for {name}: {joint.model} {why} (joints.{name}.safety.{key}: null leaves it out)"
        raise ConfigError.at(head.name, f"safety.{key}", value, f"cannot be kept {except_here}")


def _turns(head: Head, name: str, table: FirmwareMap) -> None:
    """A geared joint may need more than one turn of its servo, and only some models count them."""
    joint, turn = head.joints[name], table.ticks_per_revolution
    ticks = Calibration({name: joint}, np.array([turn]))
    low, high = int(ticks.low_ticks[0]), int(ticks.high_ticks[0])
    if 0 <= low and high <= turn - 1:
        return
    goal = table.registers.get("goal_position")
    if goal is None or not (goal.low <= low and high <= goal.high):
        reach = "one turn" if goal is None or goal.low >= 0 else f"{goal.low}..{goal.high} ticks"
        raise ConfigError.at(
            head.name, f"joints.{name}.ratio", joint.ratio,
            f"needs {low}..{high} ticks of {joint.model}, which makes {reach}: change ratio or range, or take a servo "
            "with extended position control",
        )  # fmt: skip
    first, last = home_ticks(turn, JointNeeds(low, high))
    if first > last:
        raise ConfigError.at(
            head.name, f"joints.{name}.zero_ticks", joint.zero_ticks,
            f"leaves no place where {low}..{high} ticks can be told apart after power-up: bring the middle of the "
            f"range near {table.center_ticks} ticks, or make it less than two turns",
        )  # fmt: skip
