"""What a head's file asks of its servos for the sake of gentleness, and whether they can do it."""

from __future__ import annotations

from collections.abc import Mapping

from sfms_robot.config import FirmwareMap, Head, Joint
from sfms_robot.config.register_rules import check_registers
from sfms_robot.errors import ConfigError
from sfms_robot.servo.policy import tells_current, torque_register


def check_safety(head: Head, joints: Mapping[str, Joint], maps: Mapping[str, FirmwareMap]) -> None:
    """Of joints, and the maps of their models. A rule that nobody keeps is worse than none.

    Raises ConfigError for a limit that a joint's servo cannot keep, or a register that a run must not write.
    """
    for name, joint in joints.items():
        _limits(head, name, maps[joint.model])
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
