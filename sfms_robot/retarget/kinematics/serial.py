"""A neck of one, two or three axes in series, in closed form.

R = R(first axis) R(second) R(third), from the base to the head. Three axes take any rotation. Two take what is left of
it when the missing axis is put last and dropped: a pan-tilt neck keeps the direction of the face and loses the roll.
One takes the turn about it that leaves least. Then each axis goes to its joint, to two joints in series (`shared`), or
pitch and roll together to a differential. Translation is not for such a neck: all of it is residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Final

import numpy as np

from sfms_robot.config.kinematics import SerialNeck, Split
from sfms_robot.frames import Doubles
from sfms_robot.retarget.kinematics.neck import Range, Ranges, Solved, checked, low_pass
from sfms_robot.signals import rotations

EXACT_RAD: Final = 1e-9
EXACT_M: Final = 1e-9
_POSE_ORDER: Final = (2, 1, 0)  # R = Rz(yaw) Ry(pitch) Rx(roll)


class Serial:
    """Implements `neck.Neck`. The memory is the low-passed angle of each axis, (number of axes,)."""

    turns_body = False

    def __init__(self, config: SerialNeck, ranges: Ranges) -> None:
        self.joints: Sequence[str] = config.joints()
        self.axes: Sequence[str] = config.order
        self._config = config
        self._ranges = {name: ranges[name] for name in self.joints}
        self._column = {name: column for column, name in enumerate(self.joints)}
        self._axes = tuple(rotations.AXIS[name] for name in config.order)
        places = [config.axes.get(name) for name in config.order]
        self._places: Sequence[str | Split | None] = places  # per axis its joint, or two; None: the differential's
        single = [(column, place) for column, place in enumerate(places) if isinstance(place, str)]
        self._single_axes = np.array([column for column, _ in single], dtype=np.intp)
        self._single_joints = np.array([self._column[name] for _, name in single], dtype=np.intp)
        self._single_low, self._single_high = np.array([ranges[name] for _, name in single]).reshape(-1, 2).T
        self._splits = [(column, place) for column, place in enumerate(places) if isinstance(place, Split)]

    def solve(self, poses: Doubles, body_yaw_rad: Doubles | None = None) -> Solved:
        if body_yaw_rad is not None:
            raise ValueError("this neck has no body yaw")
        poses = checked(poses)
        angles = self._axis_angles(poses)
        return self._solved(poses, angles, angles)

    def start(self) -> Doubles:
        return np.zeros(len(self._axes))

    def step(self, pose: Doubles, dt_s: float, memory: Doubles) -> tuple[Doubles, Doubles]:
        wanted = checked(pose)
        angles, slow = self._axis_angles(wanted), memory.copy()
        for column, place in self._splits:
            if place.crossover_hz is not None:
                slow[column] = low_pass(angles[column], memory[column], place.crossover_hz, dt_s)
        return self._joint_angles(angles, slow), slow

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        out = np.zeros((*angles_rad.shape[:-1], 6))
        out[..., :3] = rotations.euler(self._rotation(angles_rad), (2, 1, 0))[..., ::-1]
        return out

    def _axis_angles(self, poses: Doubles) -> Doubles:
        """Poses (..., 6) -> the angle of each axis (..., k), whatever the joints can do."""
        if self._axes in (_POSE_ORDER, _POSE_ORDER[:2]):
            return poses[..., self._axes]  # the pose is written in these very angles
        rotation = rotations.rotation(poses[..., :3])
        if len(self._axes) == 1:
            return rotations.twist(rotation, self._axes[0])[..., None]
        missing = tuple(axis for axis in range(3) if axis not in self._axes)
        a, b, c = (*self._axes, *missing)
        return rotations.euler(rotation, (a, b, c))[..., : len(self._axes)]

    def _solved(self, poses: Doubles, angles: Doubles, slow: Doubles) -> Solved:
        joints = self._joint_angles(angles, slow)
        rotation, shown = self._rotation(joints), np.zeros_like(poses)
        missing_rad = rotations.angle_between(rotations.rotation(poses[..., :3]), rotation)
        missing_m = np.asarray(np.linalg.norm(poses[..., 3:], axis=-1))
        reached = (missing_rad <= EXACT_RAD) & (missing_m <= EXACT_M)
        exact = np.asarray(missing_rad <= EXACT_RAD)[..., None]
        shown[..., :3] = np.where(exact, poses[..., :3], rotations.euler(rotation, (2, 1, 0))[..., ::-1])
        return Solved(joints, np.asarray(reached), missing_rad, missing_m, shown)

    def _joint_angles(self, angles: Doubles, slow: Doubles) -> Doubles:
        """Axis angles and their low-passed ones (..., k) -> joints (..., J) inside their ranges."""
        out = np.zeros((*angles.shape[:-1], len(self.joints)))
        alone = np.minimum(np.maximum(angles[..., self._single_axes], self._single_low), self._single_high)
        out[..., self._single_joints] = alone
        for column, place in self._splits:
            angle = angles[..., column]
            low = slow[..., column] if place.lower_share is None else place.lower_share * angle
            parts = shared(angle, low, self._ranges[place.lower], self._ranges[place.upper])
            for joint, part in zip((place.lower, place.upper), parts, strict=True):
                out[..., self._column[joint]] = part
        if (pair := self._config.differential) is not None:
            order = self._config.order
            pitch, roll = angles[..., order.index("pitch")], angles[..., order.index("roll")]
            servos = servo_angles(pitch, roll, pair.pitch_gain, pair.roll_gain)
            low, high = np.array([self._ranges[pair.left], self._ranges[pair.right]]).T
            columns = [self._column[pair.left], self._column[pair.right]]
            out[..., columns] = shrunk(servos, low, high)
        return out

    def _rotation(self, joints: Doubles) -> Doubles:
        """Joints (..., J) -> R (..., 3, 3)."""
        turns = []
        for name, axis, place in zip(self._config.order, self._axes, self._places, strict=True):
            if isinstance(place, str):
                angle = joints[..., self._column[place]]
            elif place is not None:
                angle = joints[..., self._column[place.lower]] + joints[..., self._column[place.upper]]
            else:
                pair = self._config.differential
                assert pair is not None  # an axis without a joint has the differential
                servos = joints[..., [self._column[pair.left], self._column[pair.right]]]
                both = axis_angles(servos, pair.pitch_gain, pair.roll_gain)
                angle = both[("pitch", "roll").index(name)]
            turns.append(rotations.about(axis, angle))
        return reduce(np.matmul, turns)


def shared(total_rad: Doubles, lower_rad: Doubles, lower: Range, upper: Range) -> tuple[Doubles, Doubles]:
    """Return both joints' angles inside their ranges, from the total (...) and the lower joint's part (...).

    What one joint cannot take the other does, so the sum is the total wherever both together can.
    """
    below = np.clip(lower_rad, *lower)
    above = np.clip(total_rad - below, *upper)
    return np.clip(total_rad - above, *lower), above


def servo_angles(pitch_rad: Doubles, roll_rad: Doubles, pitch_gain: float, roll_gain: float) -> Doubles:
    """Return left and right (..., 2) of a differential, from pitch and roll (...).

    left = a pitch + b roll, right = a pitch - b roll.
    """
    pitch, roll = pitch_gain * pitch_rad, roll_gain * roll_rad
    return np.stack([pitch + roll, pitch - roll], axis=-1)


def axis_angles(servos_rad: Doubles, pitch_gain: float, roll_gain: float) -> tuple[Doubles, Doubles]:
    """Return pitch and roll (...) of a differential, from left and right (..., 2)."""
    left, right = servos_rad[..., 0], servos_rad[..., 1]
    return (left + right) / (2 * pitch_gain), (left - right) / (2 * roll_gain)


def shrunk(servos_rad: Doubles, low_rad: Doubles, high_rad: Doubles) -> Doubles:
    """Return both servos (..., 2) shrunk by one factor until both are in range (2,), which holds 0.

    One factor keeps pitch : roll as asked, where clipping each servo would turn a nod into a tilt.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        over = np.where(servos_rad > high_rad, high_rad / servos_rad, 1.0)
        under = np.where(servos_rad < low_rad, low_rad / servos_rad, 1.0)
    factor = np.minimum(over, under).min(axis=-1, keepdims=True)
    out: Doubles = np.clip(servos_rad * factor, low_rad, high_rad)
    return out
