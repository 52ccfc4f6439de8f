"""A place seen by a camera, as a place seen from the head, and back.

The frame of the head's base has its origin in the middle of the head at home, and stays while the neck moves. A camera
on the head goes with the pose that the neck shows, so turning the neck does not move the person.
"""

from __future__ import annotations

import numpy as np

from sfms_robot.config import CameraMount
from sfms_robot.frames import Doubles, Floats
from sfms_robot.retarget.kinematics.rotations import rotation


class Camera:
    """Places (..., 3) [m] in the camera's frame (x out of its lens, y left, z up) <-> in that of the base.

    `pose` (6,): what the neck shows at that instant; a camera on the base does not ask for it.
    """

    def __init__(self, mount: CameraMount) -> None:
        self.on_head = mount.on == "head"
        self._at_m = np.array(mount.at_m)
        self._turned = rotation(np.radians(mount.rpy_deg))

    def to_base(self, place_m: Floats | Doubles, pose: Doubles) -> Doubles:
        mounted: Doubles = np.asarray(place_m, np.float64) @ self._turned.T + self._at_m
        if not self.on_head:
            return mounted
        moved: Doubles = mounted @ rotation(pose[:3]).T + pose[3:]
        return moved

    def from_base(self, place_m: Floats | Doubles, pose: Doubles) -> Doubles:
        mounted = np.asarray(place_m, np.float64)
        if self.on_head:
            mounted = (mounted - pose[3:]) @ rotation(pose[:3])
        seen: Doubles = (mounted - self._at_m) @ self._turned
        return seen


def direction_to(place_m: Doubles) -> Doubles:
    """Place (..., 3) -> yaw and pitch (..., 2) [rad] of who looks there from the origin: + left, + down."""
    x, y, z = np.moveaxis(place_m, -1, 0)
    return np.stack([np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y))], axis=-1)
