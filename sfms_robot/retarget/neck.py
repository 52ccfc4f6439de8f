"""The result that every neck returns, and a neck of one, two or three axes in series, in closed form.

R = R(first axis) R(second) R(third), from the base to the head. Three axes reach any rotation. For two axes, the
missing axis is put last and dropped: a pan-tilt neck keeps the direction of the face and loses the roll. One axis makes
the turn about it that leaves the smallest rest. Then each axis goes to its joint, to two joints in series (`shared`),
or pitch and roll together to a differential. Such a neck cannot translate: all translation is residual.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Final

import numpy as np

from sfms_robot.config.kinematics import SerialNeck
from sfms_robot.frames import Bools, Doubles
from sfms_robot.ranges import Range
from sfms_robot.signals import rotations

EXACT_RAD: Final = 1e-9
EXACT_M: Final = 1e-9
_POSE_ORDER: Final = (2, 1, 0)  # R = Rz(yaw) Ry(pitch) Rx(roll)

Ranges = Mapping[str, tuple[float, float]]  # min, max [rad] by joint


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Joints for one pose or many.

    Attributes:
        wanted: (..., 6) the requested pose.
        angles_rad: (..., J) in the neck's joint order, always inside the joints' ranges.
        reached: (...) True if these joints give the requested pose.
        shown: (..., 6) the pose that these joints give, always finite; a turn that is reached is equal to the requested
            one, bit for bit.
    """

    wanted: Doubles
    angles_rad: Doubles
    reached: Bools
    shown: Doubles

    @property
    def residual_rad(self) -> Doubles:
        """The turn (...) that is missing."""
        turns = [rotations.rotation(pose[..., :3]) for pose in (self.wanted, self.shown)]
        return rotations.angle_between(*turns)

    @property
    def residual_m(self) -> Doubles:
        """The shift (...) that is missing."""
        return np.asarray(np.linalg.norm(self.wanted[..., 3:] - self.shown[..., 3:], axis=-1))


def low_pass(angle_rad: float, before_rad: float, cutoff_hz: float, dt_s: float) -> float:
    """Return one step of a one-pole low-pass, exact for an angle that is constant during `dt_s`."""
    return float(before_rad + (1.0 - np.exp(-2.0 * np.pi * cutoff_hz * dt_s)) * (angle_rad - before_rad))


def checked(poses: Doubles) -> Doubles:
    """Return the poses as float64 (..., 6). Raises ValueError for another shape or a value that is not finite."""
    out = np.asarray(poses, dtype=np.float64)
    if out.shape[-1:] != (6,):
        raise ValueError(f"a pose is (..., 6), not {out.shape}")
    if np.count_nonzero(np.isfinite(out)) < out.size:
        raise ValueError("a pose is not finite")
    return out


class Serial:
    """A serial neck, with the methods of every neck. The memory is the low-passed angle of each axis, (axes,).

    Attributes:
        joints: names.
        axes: the pose channels that it can show.
        turns_body: True if one of the joints turns the body below the head.
    """

    turns_body = False

    def __init__(self, config: SerialNeck, ranges: Ranges) -> None:
        self.joints = config.joints()
        self.axes = config.order
        self._axes = tuple(rotations.AXIS[name] for name in config.order)
        self._range = Range(*np.array([ranges[name] for name in self.joints]).T)
        column = {name: column for column, name in enumerate(self.joints)}
        self._splits = []  # row of an axis with two joints, its section, and range and columns of the joints
        # Angles of the axes (..., k) @ goals = angles of the joints (..., J), without limits; `_turns` is the reverse.
        goals = np.zeros((len(self._axes), len(self.joints)))
        for row, place in enumerate(map(config.axes.get, config.order)):
            if isinstance(place, str):
                goals[row, column[place]] = 1.0
            elif place is not None:
                both = [column[place.lower], column[place.upper]]
                goals[row, both] = 0.5
                self._splits.append((row, place, Range(self._range.low[both], self._range.high[both]), both))
        self._pair: list[int] = []  # columns of the differential's joints
        if (pair := config.differential) is not None:
            self._pair = [column[pair.left], column[pair.right]]
            self._pair_range = Range(self._range.low[self._pair], self._range.high[self._pair])
            goals[config.order.index("pitch"), self._pair] = pair.pitch_gain
            goals[config.order.index("roll"), self._pair] = pair.roll_gain, -pair.roll_gain
        self._goals, self._turns = goals, np.linalg.pinv(goals)

    def solve(self, poses: Doubles, body_yaw_rad: Doubles | None = None) -> Solved:
        """Solve poses (..., 6), each held for ever. Without `body_yaw_rad` (...) the neck's own rule turns the body.

        Raises ValueError if a pose is not finite, or a body yaw is given to a neck without one.
        """
        if body_yaw_rad is not None:
            raise ValueError("this neck has no body yaw")
        poses = checked(poses)
        angles = self._axis_angles(poses)
        joints = self._joint_angles(angles, angles)
        rotation, shown = self._rotation(joints), np.zeros_like(poses)
        exact = rotations.angle_between(rotations.rotation(poses[..., :3]), rotation) <= EXACT_RAD
        shown[..., :3] = np.where(exact[..., None], poses[..., :3], rotations.angles_of(rotation))
        reached = np.asarray(exact & (np.linalg.norm(poses[..., 3:], axis=-1) <= EXACT_M))
        return Solved(wanted=poses, angles_rad=joints, reached=reached, shown=shown)

    def start(self) -> Doubles:
        """Return the memory of a neck that stands at home."""
        return np.zeros(len(self._axes))

    def step(self, pose: Doubles, dt_s: float, memory: Doubles) -> tuple[Doubles, Doubles]:
        """Return the joints (J,) for one pose (6,) after `dt_s`, and the memory after it."""
        angles, slow = self._axis_angles(checked(pose)), memory.copy()
        for row, place, *_ in self._splits:
            if place.crossover_hz is not None:
                slow[row] = low_pass(angles[row], memory[row], place.crossover_hz, dt_s)
        return self._joint_angles(angles, slow), slow

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        """Return the poses (..., 6) of joint angles (..., J); a search begins at `start` (..., 6)."""
        out = np.zeros((*angles_rad.shape[:-1], 6))
        out[..., :3] = rotations.angles_of(self._rotation(angles_rad))
        return out

    def _axis_angles(self, poses: Doubles) -> Doubles:
        """Return the angle of each axis (..., k) for poses (..., 6), without the limits of the joints."""
        if self._axes in (_POSE_ORDER, _POSE_ORDER[:2]):
            return poses[..., self._axes]  # the pose is written in exactly these angles
        rotation = rotations.rotation(poses[..., :3])
        if len(self._axes) == 1:
            return rotations.twist(rotation, self._axes[0])[..., None]
        missing = tuple(axis for axis in range(3) if axis not in self._axes)
        a, b, c = (*self._axes, *missing)
        return rotations.euler(rotation, (a, b, c))[..., : len(self._axes)]

    def _joint_angles(self, angles: Doubles, slow: Doubles) -> Doubles:
        """Return joints (..., J) inside their ranges for axis angles and low-passed axis angles (..., k)."""
        out: Doubles = angles @ self._goals
        for row, place, ends, (below, above) in self._splits:
            angle = angles[..., row]
            lower = slow[..., row] if place.lower_share is None else place.lower_share * angle
            out[..., below], out[..., above] = shared(angle, lower, ends)
        if self._pair:
            out[..., self._pair] = shrunk(out[..., self._pair], self._pair_range)
        return self._range.nearest(out)

    def _rotation(self, joints: Doubles) -> Doubles:
        """Return R (..., 3, 3) of joints (..., J)."""
        angles = joints @ self._turns
        return reduce(np.matmul, [rotations.about(axis, angles[..., row]) for row, axis in enumerate(self._axes)])


def shared(total_rad: Doubles, lower_rad: Doubles, ends: Range) -> tuple[Doubles, Doubles]:
    """Return both joints' angles inside their ranges (2,), from the total (...) and the lower joint's part (...).

    The part beyond the range of one joint goes to the other, so the sum is the total if both together can reach it.
    """
    (lowest, least), (highest, most) = ends.low, ends.high
    above = np.clip(total_rad - np.clip(lower_rad, lowest, highest), least, most)
    return np.clip(total_rad - above, lowest, highest), above


def shrunk(servos_rad: Doubles, ends: Range) -> Doubles:
    """Return both servos (..., 2) shrunk by one factor until both are in range (2,), which holds 0.

    One factor keeps the ratio of pitch and roll, where clipping each servo would turn a nod into a tilt.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        over = np.where(servos_rad > ends.high, ends.high / servos_rad, 1.0)
        under = np.where(servos_rad < ends.low, ends.low / servos_rad, 1.0)
    return ends.nearest(servos_rad * np.minimum(over, under).min(axis=-1, keepdims=True))
