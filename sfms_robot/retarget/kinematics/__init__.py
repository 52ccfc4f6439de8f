"""Poses -> the joints of a neck: serial axes, a split axis, a differential pair, a six-legged platform."""

from __future__ import annotations

from collections.abc import Mapping
from typing import assert_never

from sfms_robot.config.joint import Joint
from sfms_robot.config.kinematics import Kinematics, SerialNeck, StewartPlatform
from sfms_robot.retarget.kinematics.neck import Neck, Solved
from sfms_robot.retarget.kinematics.platform import Stewart
from sfms_robot.retarget.kinematics.serial import Serial

__all__ = ["Neck", "Serial", "Solved", "Stewart", "build_neck"]


def build_neck(config: Kinematics, joints: Mapping[str, Joint]) -> Neck:
    """A head's neck from its section and joints. Raises ConfigError where its home is out of reach."""
    ranges = {name: (joints[name].min_rad, joints[name].max_rad) for name in config.joints()}
    if isinstance(config, SerialNeck):
        return Serial(config, ranges)
    if isinstance(config, StewartPlatform):
        return Stewart(config, ranges)
    assert_never(config)
