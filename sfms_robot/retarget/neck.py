"""The solution that every neck gives, and a neck of one, two or three axes in series, in closed form.

R = R(first axis) R(second) R(third), from the base to the head. Three axes take any rotation. Two take the rest of it
when the missing axis is put last and dropped: a pan-tilt neck keeps the direction of the face and loses the roll. One
takes the turn about it that leaves least. Then each axis goes to its joint, to two joints in series (`shared`), or
pitch and roll together to a differential. Translation is not for such a neck: all of it is residual.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Final

import numpy as np

from sfms_robot.config.kinematics import SerialNeck, Split
from sfms_robot.frames import Bools, Doubles
from sfms_robot.signals import rotations

EXACT_RAD: Final = 1e-9
EXACT_M: Final = 1e-9
_POSE_ORDER: Final = (2, 1, 0)  # R = Rz(yaw) Ry(pitch) Rx(roll)

Range = tuple[float, float]  # min, max [rad]
Ranges = Mapping[str, Range]


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Joints for one pose or many.

    Attributes:
        angles_rad: (..., J) in the neck's joint order, always inside the joints' ranges.
        reached: (...) True if these joints give the requested pose.
        residual_rad: (...) the turn that is missing.
        residual_m: (...) the shift that is missing.
        shown: (..., 6) the pose that these joints give, always finite; a turn that is reached is equal to the requested
            one, to the bit.
    """

    angles_rad: Doubles
    reached: Bools
    residual_rad: Doubles
    residual_m: Doubles
    shown: Doubles


def low_pass(angle_rad: float, before_rad: float, cutoff_hz: float, dt_s: float) -> float:
    """Return one step of a one-pole low-pass, exact for an angle that holds still during `dt_s`."""
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
        """Solve poses (..., 6), each held for ever. Without `body_yaw_rad` (...) the neck's own rule turns the body.

        Raises ValueError where a pose is not finite, or a body yaw is given to a neck without one.
        """
        if body_yaw_rad is not None:
            raise ValueError("this neck has no body yaw")
        poses = checked(poses)
        angles = self._axis_angles(poses)
        joints = self._joint_angles(angles, angles)
        rotation, shown = self._rotation(joints), np.zeros_like(poses)
        missing_rad = rotations.angle_between(rotations.rotation(poses[..., :3]), rotation)
        missing_m = np.asarray(np.linalg.norm(poses[..., 3:], axis=-1))
        exact = np.asarray(missing_rad <= EXACT_RAD)
        shown[..., :3] = np.where(exact[..., None], poses[..., :3], rotations.angles_of(rotation))
        reached = np.asarray(exact & (missing_m <= EXACT_M))
        return Solved(angles_rad=joints, reached=reached, residual_rad=missing_rad, residual_m=missing_m, shown=shown)

    def start(self) -> Doubles:
        """Return the memory of a neck that stands at home."""
        return np.zeros(len(self._axes))

    def step(self, pose: Doubles, dt_s: float, memory: Doubles) -> tuple[Doubles, Doubles]:
        """Return the joints (J,) for one pose (6,) after `dt_s`, and the memory after it."""
        wanted = checked(pose)
        angles, slow = self._axis_angles(wanted), memory.copy()
        for column, place in self._splits:
            if place.crossover_hz is not None:
                slow[column] = low_pass(angles[column], memory[column], place.crossover_hz, dt_s)
        return self._joint_angles(angles, slow), slow

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        """Return the poses (..., 6) of joint angles (..., J); a search begins at `start` (..., 6)."""
        out = np.zeros((*angles_rad.shape[:-1], 6))
        out[..., :3] = rotations.angles_of(self._rotation(angles_rad))
        return out

    def _axis_angles(self, poses: Doubles) -> Doubles:
        """Return the angle of each axis (..., k) for poses (..., 6), without the limits of the joints."""
        if self._axes in (_POSE_ORDER, _POSE_ORDER[:2]):
            return poses[..., self._axes]  # the pose is written in these very angles
        rotation = rotations.rotation(poses[..., :3])
        if len(self._axes) == 1:
            return rotations.twist(rotation, self._axes[0])[..., None]
        missing = tuple(axis for axis in range(3) if axis not in self._axes)
        a, b, c = (*self._axes, *missing)
        return rotations.euler(rotation, (a, b, c))[..., : len(self._axes)]

    def _joint_angles(self, angles: Doubles, slow: Doubles) -> Doubles:
        """Return joints (..., J) inside their ranges for axis angles and their low-passed ones (..., k)."""
        out = np.zeros((*angles.shape[:-1], len(self.joints)))
        alone = np.minimum(np.maximum(angles[..., self._single_axes], self._single_low), self._single_high)
        out[..., self._single_joints] = alone
        for column, place in self._splits:
            angle = angles[..., column]
            low = slow[..., column] if place.lower_share is None else place.lower_share * angle
            parts = shared(angle, low, self._ranges[place.lower], self._ranges[place.upper])
            for joint, part in zip((place.lower, place.upper), parts, strict=True):
                out[..., self._column[joint]] = part
        if (pair := self._config.differential) is not None:  # left, right = pitch_gain pitch +- roll_gain roll
            order = self._config.order
            pitch = pair.pitch_gain * angles[..., order.index("pitch")]
            roll = pair.roll_gain * angles[..., order.index("roll")]
            low, high = np.array([self._ranges[pair.left], self._ranges[pair.right]]).T
            columns = [self._column[pair.left], self._column[pair.right]]
            out[..., columns] = shrunk(np.stack([pitch + roll, pitch - roll], axis=-1), low, high)
        return out

    def _rotation(self, joints: Doubles) -> Doubles:
        """Return R (..., 3, 3) of joints (..., J)."""
        turns = []
        for name, axis, place in zip(self._config.order, self._axes, self._places, strict=True):
            if isinstance(place, str):
                angle = joints[..., self._column[place]]
            elif place is not None:
                angle = joints[..., self._column[place.lower]] + joints[..., self._column[place.upper]]
            else:
                pair = self._config.differential
                assert pair is not None  # an axis without a joint has the differential
                left, right = joints[..., self._column[pair.left]], joints[..., self._column[pair.right]]
                pitches = name == "pitch"
                angle = (left + right) / (2 * pair.pitch_gain) if pitches else (left - right) / (2 * pair.roll_gain)
            turns.append(rotations.about(axis, angle))
        return reduce(np.matmul, turns)


def shared(total_rad: Doubles, lower_rad: Doubles, lower: Range, upper: Range) -> tuple[Doubles, Doubles]:
    """Return both joints' angles inside their ranges, from the total (...) and the lower joint's part (...).

    The part beyond the range of one joint goes to the other, so the sum is the total wherever both together can.
    """
    below = np.clip(lower_rad, *lower)
    above = np.clip(total_rad - below, *upper)
    return np.clip(total_rad - above, *lower), above


def shrunk(servos_rad: Doubles, low_rad: Doubles, high_rad: Doubles) -> Doubles:
    """Return both servos (..., 2) shrunk by one factor until both are in range (2,), which holds 0.

    One factor keeps the ratio of pitch and roll, where clipping each servo would turn a nod into a tilt.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        over = np.where(servos_rad > high_rad, high_rad / servos_rad, 1.0)
        under = np.where(servos_rad < low_rad, low_rad / servos_rad, 1.0)
    factor = np.minimum(over, under).min(axis=-1, keepdims=True)
    out: Doubles = np.clip(servos_rad * factor, low_rad, high_rad)
    return out
