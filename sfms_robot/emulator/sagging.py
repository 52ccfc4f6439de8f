"""Where the joints of a head stand that is switched off: gravity has had them since."""

from __future__ import annotations

from math import radians
from typing import Final

from sfms_robot.config import Head, Joint

HANGING: Final = 0.3  # fraction of the way from rest to its lower end, where nothing pulls hard
BEYOND_RAD: Final = radians(2.0)  # how far a stop lies outside the range of the head's file


def sagging_joints(head: Head) -> frozenset[str]:
    """Joints that bear the weight of the head, which falls forward: those that pitch a serial neck."""
    neck = head.kinematics
    if neck is None or neck.kind != "serial" or "pitch" not in neck.axes:
        return frozenset()
    pitch = neck.axes["pitch"]
    return frozenset([pitch] if isinstance(pitch, str) else [pitch.lower, pitch.upper])


def sagged_rad(joint: Joint, sags: bool) -> float:
    """Angle of a joint without torque: on the stop beyond its upper end (nose down), or hanging a little from rest."""
    return joint.max_rad + BEYOND_RAD if sags else joint.rest_rad + HANGING * (joint.min_rad - joint.rest_rad)


def sagged_ticks(angle_rad: float, zero_ticks: float, ticks_per_rad: float, center_ticks: int) -> int:
    """Its servo's position: not held to the joint's limits, but to what a servo about `center_ticks` can read."""
    return round(min(max(zero_ticks + ticks_per_rad * angle_rad, 0.0), 2.0 * center_ticks - 1.0))
