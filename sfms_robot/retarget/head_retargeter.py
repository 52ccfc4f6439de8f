"""Joint angles of a head from motion: the mapping moves the face, the neck's kinematics follow the pose.

    face channels -> mapping -> joints
    pose channels -> neck    -> the neck's joints, all for one instant, because its joints move the head together

A head without kinematics has the mapping alone. The memory of the neck (low-passed angles) is a value that the loop
passes from tick to tick.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfms_robot.config import Head, Joint
from sfms_robot.config.kinematics import Kinematics, SerialNeck
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS, Doubles, Floats
from sfms_robot.retarget.channel_mapping import ChannelMapping, Knobs
from sfms_robot.retarget.neck import Serial
from sfms_robot.retarget.stewart import Stewart

Neck = Serial | Stewart

_POSE = len(POSE_CHANNELS)
_LARGE = np.array([0.5, 0.6, 1.0, 0.05, 0.05, 0.05])  # roll, pitch, yaw [rad], place [m]: style has no effect there
_HOME_RAD = np.radians(0.1)  # largest distance of a joint from its rest with the neck at home


def build_neck(config: Kinematics, joints: Mapping[str, Joint]) -> Neck:
    """Return a head's neck from its section and joints. Raises ConfigError if its home is out of reach."""
    ranges = {name: (joints[name].min_rad, joints[name].max_rad) for name in config.joints()}
    return Serial(config, ranges) if isinstance(config, SerialNeck) else Stewart(config, ranges)


class HeadRetargeter:
    """The retargeter of one head at ticks of `dt_s` (`ports.Retargeter`).

    Attributes:
        joints: names, in the order of the head's file.
        neck_columns: indices of the neck's joints, in the neck's own order.
        blind_channels: channels that neither the mapping nor the neck shows.
        dead_joints: joints without a drive, outside the neck.

    Raises ConfigError if the neck's home is out of reach, or is not the rest of its joints.
    """

    def __init__(self, head: Head, dt_s: float = 0.01) -> None:
        self.mapping = ChannelMapping(head)
        self.joints = self.mapping.joints
        self.neck = build_neck(head.kinematics, head.joints) if head.kinematics else None
        self.blind_channels = self.mapping.blind_channels
        self.dead_joints = self.mapping.dead_joints
        self.neck_columns = np.zeros(0, dtype=np.intp)
        self._dt_s = dt_s
        if self.neck is None:
            return
        self.neck_columns = np.array([self.joints.index(name) for name in self.neck.joints], dtype=np.intp)
        self.blind_channels = tuple(name for name in self.blind_channels if name not in self.neck.axes)
        self.dead_joints = tuple(name for name in self.dead_joints if name not in self.neck.joints)
        home = self.neck.solve(np.zeros(_POSE)).angles_rad
        for name, angle in zip(self.neck.joints, home, strict=True):
            if abs(angle - head.joints[name].rest_rad) > _HOME_RAD:
                problem = f"is not where the neck stands at home, {np.degrees(angle):.3f}"
                raise ConfigError.at(head.name, f"joints.{name}.rest_deg", head.joints[name].rest_deg, problem)

    def start(self) -> Doubles:
        """Return the memory of a head at rest."""
        return self.neck.start() if self.neck else np.zeros(0)

    def step(self, motion: Floats, memory: Doubles, knobs: Knobs | None = None) -> tuple[Doubles, Doubles]:
        """Return angles (J,) for motion (58,) of all joints or (J, 58), row j for joint j, and the next memory.

        The pose is that of the row of the neck's first joint; the knobs of that joint's region change it. Raises
        ValueError if the motion is not finite.
        """
        angles = self.mapping.angles(motion, knobs)
        if self.neck is None:
            return angles, memory
        angles[self.neck_columns], memory = self.neck.step(self._pose(motion, knobs), self._dt_s, memory)
        return angles, memory

    def angles(self, motion: Floats, knobs: Knobs | None = None) -> Doubles:
        """Return angles as `step` does, for a face that is held for ever, or for many faces (..., J, 58)."""
        angles = self.mapping.angles(motion, knobs)
        if self.neck is not None:
            angles[..., self.neck_columns] = self.neck.solve(self._pose(motion, knobs)).angles_rad
        return angles

    def shown_pose(self, motion: Floats, knobs: Knobs | None = None) -> Doubles:
        """Return the poses (..., 6) that the neck shows for motion (..., 58), after the knobs and within its ranges.

        Always finite. Without kinematics a channel that no joint follows is 0, the others are unchanged.
        Raises ValueError if a pose is not finite.
        """
        if self.neck is None:
            blind = [name in self.blind_channels for name in POSE_CHANNELS]
            return np.where(blind, 0.0, motion[..., :_POSE].astype(np.float64))
        return self.neck.solve(self._turned(motion, knobs)).shown

    def _pose(self, motion: Floats, knobs: Knobs | None) -> Doubles:
        return self._turned(motion if motion.ndim == 1 else motion[..., self.neck_columns[0], :], knobs)

    def _turned(self, motion: Floats, knobs: Knobs | None) -> Doubles:
        """Return the poses (..., 6) of motion (..., 58), changed by the knobs of the neck's region."""
        first, knobs = self.neck_columns[0], knobs or self.mapping.file_knobs
        pose = motion[..., :_POSE].astype(np.float64)
        if knobs.style[first] != 1.0:  # the same formula as for the mapping's joints
            pose *= 1.0 + (knobs.style[first] - 1.0) * (1.0 - np.minimum(np.abs(pose) / _LARGE, 1.0))
        pose *= knobs.intensity[first]
        return pose
