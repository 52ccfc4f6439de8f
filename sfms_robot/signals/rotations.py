"""Rotations and poses, many at once.

A pose is (..., 6) roll, pitch, yaw [rad], x, y, z [m], the order of `frames.POSE_CHANNELS`, measured from the head's
home. Axes are x forward, y left, z up and R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.frames import Doubles, Reals

FROM_CAMERA: Final = [2, 0, 1]  # a camera's axes for our x, y, z: z towards the viewer, x to the picture's right, y up
AXIS: Final = {"roll": 0, "pitch": 1, "yaw": 2}  # the coordinate axis of each rotation


def rotation(rpy_rad: Doubles) -> Doubles:
    """Return R (..., 3, 3) of roll, pitch, yaw (..., 3)."""
    cosine, sine = np.cos(rpy_rad), np.sin(rpy_rad)
    cr, cp, cy = cosine[..., 0], cosine[..., 1], cosine[..., 2]
    sr, sp, sy = sine[..., 0], sine[..., 1], sine[..., 2]
    out = np.empty((*rpy_rad.shape[:-1], 3, 3))
    out[..., 0, 0] = cy * cp
    out[..., 0, 1] = cy * sp * sr - sy * cr
    out[..., 0, 2] = cy * sp * cr + sy * sr
    out[..., 1, 0] = sy * cp
    out[..., 1, 1] = sy * sp * sr + cy * cr
    out[..., 1, 2] = sy * sp * cr - cy * sr
    out[..., 2, 0] = -sp
    out[..., 2, 1] = cp * sr
    out[..., 2, 2] = cp * cr
    return out


def about(axis: int, angle_rad: ArrayLike) -> Doubles:
    """Return the rotation (..., 3, 3) by `angle_rad` (...) about one coordinate axis."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*angle.shape, 3, 3))
    out[..., axis, axis] = 1.0
    out[..., first, first] = out[..., second, second] = np.cos(angle)
    out[..., second, first] = np.sin(angle)
    out[..., first, second] = -out[..., second, first]
    return out


def euler(matrix: Doubles, axes: tuple[int, int, int]) -> Doubles:
    """Return the angles (..., 3) with R(axes[0]) R(axes[1]) R(axes[2]) = matrix, for three different axes.

    The middle angle is within +-pi/2. At exactly +-pi/2 the other two are not defined separately: the last is 0.
    """
    a, b, c = axes
    sign = 1.0 if (b - a) % 3 == 1 else -1.0
    across = np.hypot(matrix[..., a, a], matrix[..., a, b])
    middle = np.arctan2(sign * matrix[..., a, c], across)
    free = across > 1e-9
    first = np.where(
        free,
        np.arctan2(-sign * matrix[..., b, c], matrix[..., c, c]),
        np.arctan2(sign * matrix[..., c, b], matrix[..., b, b]),
    )
    last = np.where(free, np.arctan2(-sign * matrix[..., a, b], matrix[..., a, a]), 0.0)
    return np.stack([first, middle, last], axis=-1)


def angles_of(matrix: Doubles) -> Doubles:
    """Return roll, pitch, yaw (..., 3) of rotations (..., 3, 3); the roll is 0 where the pitch is a quarter turn."""
    return euler(matrix, (2, 1, 0))[..., ::-1]


def camera_angles(matrix: Reals) -> Doubles:
    """Return roll, pitch, yaw (3,) of MediaPipe's transformation matrix (4, 4), face -> camera."""
    return angles_of(matrix[np.ix_(FROM_CAMERA, FROM_CAMERA)].astype(np.float64))


def twist(matrix: Doubles, axis: int) -> Doubles:
    """Return the angle (...) of the turn about `axis` alone that is nearest to `matrix`."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    sine = matrix[..., second, first] - matrix[..., first, second]
    cosine = matrix[..., first, first] + matrix[..., second, second]
    return np.arctan2(sine, cosine)


def from_vector(vector: Doubles) -> Doubles:
    """Return R (..., 3, 3) of a rotation vector (..., 3) [rad] (Rodrigues)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    half_sinc = np.sinc(angle / (2 * np.pi))
    cross = np.zeros((*vector.shape[:-1], 3, 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    cross[..., 2, 1], cross[..., 0, 2], cross[..., 1, 0] = x, y, z
    cross[..., 1, 2], cross[..., 2, 0], cross[..., 0, 1] = -x, -y, -z
    out: Doubles = np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half_sinc**2 * (cross @ cross)
    return out


def angle_between(one: Doubles, other: Doubles) -> Doubles:
    """Return the smallest turn [rad] (...) between two rotations; exact for small ones too."""
    chord = np.linalg.norm(one - other, axis=(-2, -1)) / np.sqrt(8.0)
    angle: Doubles = 2.0 * np.arcsin(np.minimum(chord, 1.0))
    return angle


def wrapped(angle_rad: Doubles) -> Doubles:
    """Return the same angle within -pi..pi."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def seen_from(body_yaw_rad: ArrayLike, poses: Doubles) -> Doubles:
    """Return poses (..., 6) in the frame of a body that is turned by `body_yaw_rad` (...)."""
    body = np.asarray(body_yaw_rad, dtype=np.float64)
    cosine, sine = np.cos(body), np.sin(body)
    out = np.array(np.broadcast_to(poses, (*np.broadcast_shapes(body.shape, poses.shape[:-1]), 6)))
    x, y = poses[..., 3], poses[..., 4]
    out[..., 3] = cosine * x + sine * y
    out[..., 4] = cosine * y - sine * x
    out[..., 2] = wrapped(out[..., 2] - body)
    return out
