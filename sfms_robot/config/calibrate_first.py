"""Calibrate first: how a head whose zeros and ranges nobody has measured may move.

Servo horns sit differently on every build, so a face that moves as its file says may drive a lip into the teeth. Until
a joint is calibrated it keeps to a fifth of its travel around rest, and to less than a third of its speed.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from sfms_robot.config.head import Head
from sfms_robot.config.joint import Joint, LimitClass

TRAVEL: Final = 0.2
PACE: Final = 0.3
_SUFFIX: Final = "_calibrate_first"


def held_back(head: Head, joints: Collection[str] | None = None) -> Head:
    """The head with `joints` (all of them by default) at 20 % of their travel and 0.3 of their limits."""
    names = set(head.joints if joints is None else joints)
    classes = {head.joints[name].limits for name in head.joints if name in names}
    slow = {name + _SUFFIX: _slower(head.limits[name]) for name in classes}
    held = {name: _held(joint) if name in names else joint for name, joint in head.joints.items()}
    return head.model_copy(update={"limits": {**head.limits, **slow}, "joints": held})


def _slower(limit: LimitClass) -> LimitClass:
    return LimitClass(
        speed_deg_s=PACE * limit.speed_deg_s,
        acceleration_deg_s2=PACE * limit.acceleration_deg_s2,
        jerk_deg_s3=PACE * limit.jerk_deg_s3,
    )


def _held(joint: Joint) -> Joint:
    rest = joint.rest_deg
    ends = {"min_deg": rest + TRAVEL * (joint.min_deg - rest), "max_deg": rest + TRAVEL * (joint.max_deg - rest)}
    return joint.model_copy(update={**ends, "limits": joint.limits + _SUFFIX})
