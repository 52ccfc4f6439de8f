"""A platform on six cranks and rods (6-RSS): one servo turns each crank, a rod joins crank tip and head.

With q the rod's head end in the frame of the servo (x, y in the plane of the crank, z its axis), crank length c and
rod length l, the tip (c cos a, c sin a, 0) is on the rod's sphere where

    a = atan2(qy, qx) + s acos(k),    k = (|q|^2 + c^2 - l^2) / (2 c sqrt(qx^2 + qy^2)),

s = +-1 being the side the crank is mounted on. No solution where |k| > 1: the rod is too short or too long.
q is linear in (R, t), so all legs of many poses are one matrix product. The other way round there is no closed form:
damped Newton on the six rod lengths, from a pose nearby.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfms_robot.config.kinematics import StewartPlatform
from sfms_robot.frames import Doubles
from sfms_robot.signals import rotations

MAX_STEPS = 60
SHORTEST_STEP = 1e-3
CLOSE_ENOUGH_M = 1e-15  # rod lengths' error at which Newton stops at once; rounding often stops it before
ARRIVED_M = 1e-12
FOLLOW_STEPS = 16


@dataclass(frozen=True)
class Platform:
    """Geometry of six legs, poses seen from the body that carries the servos.

    Attributes:
        linear: (18, 12) from R row by row and t to the rod ends in the servos' frames, leg by leg.
        constant: (18,) the same of the home pose's height and the servos' places.
        turn: (6, 3, 3) rotation body -> servo.
        rod_arms_m: (6, 3) rod ends in the head's frame.
        side: (6,) branch sign s.
        crank_m, rod_m: lengths.
    """

    linear: Doubles
    constant: Doubles
    turn: Doubles
    rod_arms_m: Doubles
    side: Doubles
    crank_m: float
    rod_m: float

    @classmethod
    def of(cls, config: StewartPlatform) -> Platform:
        servo = np.array([leg.servo_from_body for leg in config.legs])  # (6, 3, 4)
        ends = np.array([leg.rod_end_m for leg in config.legs])  # (6, 3)
        turn, place = servo[..., :3], servo[..., 3]
        by_rotation = np.einsum("lij,lk->lijk", turn, ends).reshape(18, 9)
        linear = np.concatenate([by_rotation, turn.reshape(18, 3)], axis=1)
        constant = (place + turn[..., 2] * config.home_height_m).reshape(18)
        side = np.array([float(leg.side) for leg in config.legs])
        return cls(linear, constant, turn, ends, side, config.crank_m, config.rod_m)

    def rod_ends_m(self, rotation: Doubles, place_m: Doubles) -> Doubles:
        """R (..., 3, 3) and t (..., 3) -> q (..., 6, 3)."""
        shape = place_m.shape[:-1]
        stacked = np.concatenate([rotation.reshape(*shape, 9), place_m], axis=-1)
        ends: Doubles = (stacked @ self.linear.T + self.constant).reshape(*shape, 6, 3)
        return ends

    def inverse(self, poses: Doubles, dead_centre: float = 1.0) -> Doubles:
        """Poses (..., 6) -> crank angles (..., 6) [rad] within -pi..pi; NaN for a leg that does not reach.

        At |k| = 1 crank and rod lie in line and the crank turns ever faster with the head: a `dead_centre` below 1
        keeps away from there.
        """
        q = self.rod_ends_m(rotations.rotation(poses[..., :3]), poses[..., 3:])
        flat = np.hypot(q[..., 0], q[..., 1])
        k = ((q * q).sum(-1) + (self.crank_m**2 - self.rod_m**2)) / (2 * self.crank_m * flat)
        turn = np.arccos(np.where(np.abs(k) <= dead_centre, k, np.nan))
        return rotations.wrapped(np.arctan2(q[..., 1], q[..., 0]) + self.side * turn)

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        """Crank angles (..., 6) -> poses (..., 6), from a pose (..., 6) nearby: the last one, or home.

        Several poses fit the same cranks: where Newton arrives at one with a loose direction in between, it follows
        the cranks in small steps from `start` instead. A row is NaN where its angles are not finite, no pose has
        them, or `start` is no pose of this platform.
        """
        angles = np.reshape(angles_rad, (-1, 6))
        begin = np.broadcast_to(start, angles_rad.shape).reshape(-1, 6)
        before = self.inverse(begin)
        out = np.full(angles.shape, np.nan)
        sound = np.isfinite(angles).all(axis=-1) & np.isfinite(before).all(axis=-1)
        out[sound] = self._forward(angles[sound], begin[sound], before[sound])
        return out.reshape(angles_rad.shape)

    def _forward(self, angles: Doubles, begin: Doubles, before: Doubles) -> Doubles:
        """Crank angles (n, 6) -> poses (n, 6), from poses (n, 6) with cranks at `before` (n, 6)."""
        found, off_m = self._newton(angles, begin)
        same_side = self.stiffness(found, angles) * self.stiffness(begin, before) > 0
        astray = np.flatnonzero((off_m > ARRIVED_M) | ~same_side)
        if astray.size:
            here, left_m = begin[astray], off_m[astray]
            for share in np.arange(1, FOLLOW_STEPS + 1) / FOLLOW_STEPS:
                here, left_m = self._newton(before[astray] + share * (angles[astray] - before[astray]), here)
            found[astray], off_m[astray] = here, left_m
        found[off_m > ARRIVED_M] = np.nan
        return found

    def stiffness(self, poses: Doubles, angles_rad: Doubles) -> Doubles:
        """Determinant (...) of rod lengths against motion of the head; a head with a loose direction has 0.

        Beyond 0, with the other sign, lie poses that these cranks also fit but can only reach by falling through.
        """
        flat, cranks = poses.reshape(-1, 6), angles_rad.reshape(-1, 6)
        rotation = rotations.rotation(flat[:, :3])
        _, toward = self._errors(rotation, flat[:, 3:], self._tips(cranks))
        determinant: Doubles = np.linalg.det(self._jacobian(rotation, toward))
        return determinant.reshape(poses.shape[:-1])

    def _tips(self, angles: Doubles) -> Doubles:
        return self.crank_m * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)

    def _errors(self, rotation: Doubles, place: Doubles, tips: Doubles) -> tuple[Doubles, Doubles]:
        """How much each rod is too long (n, 6) [m], to first order, and the vectors tip -> rod end (n, 6, 3)."""
        toward = self.rod_ends_m(rotation, place) - tips
        return ((toward * toward).sum(-1) - self.rod_m**2) / (2 * self.rod_m), toward

    def _jacobian(self, rotation: Doubles, toward: Doubles) -> Doubles:
        """Change of the errors (n, 6, 6) with a rotation vector, then a shift, of the head."""
        arm = self.rod_arms_m @ np.swapaxes(rotation, -1, -2)
        pull = np.einsum("nli,lij->nlj", toward, self.turn) / self.rod_m  # the rods' directions, seen from the body
        jacobian = np.empty((len(toward), 6, 6))
        for axis in range(3):  # w x arm . pull = w . (arm x pull)
            first, second = (axis + 1) % 3, (axis + 2) % 3
            jacobian[..., axis] = arm[..., first] * pull[..., second] - arm[..., second] * pull[..., first]
        jacobian[..., 3:] = pull
        return jacobian

    def _newton(self, angles: Doubles, start: Doubles) -> tuple[Doubles, Doubles]:
        """Poses (n, 6) with these crank angles (n, 6), and how far off each is at the end (n,) [m]."""
        rotation, place = rotations.rotation(start[:, :3]), start[:, 3:].copy()
        tips = self._tips(angles)
        error, toward = self._errors(rotation, place, tips)
        for _ in range(MAX_STEPS):
            busy = np.flatnonzero(_size(error) > CLOSE_ENOUGH_M)
            if not busy.size:
                break
            step = _solve(self._jacobian(rotation[busy], toward[busy]), -error[busy])
            length, better = np.ones(len(busy)), np.zeros(len(busy), dtype=bool)
            while not better.all() and length.min() > SHORTEST_STEP:  # damping: half as far where it got no better
                part = step * length[:, None]
                turned, moved = rotations.from_vector(part[:, :3]) @ rotation[busy], place[busy] + part[:, 3:]
                new_error, new_toward = self._errors(turned, moved, tips[busy])
                better = _size(new_error) < _size(error[busy])
                length = np.where(better, length, length / 2)
            kept = busy[better]
            if not kept.size:
                break
            rotation[kept], place[kept] = turned[better], moved[better]
            error[kept], toward[kept] = new_error[better], new_toward[better]
        return np.concatenate([rotations.euler(rotation, (2, 1, 0))[:, ::-1], place], axis=-1), _size(error)


def _size(error: Doubles) -> Doubles:
    return np.asarray(np.linalg.norm(error, axis=-1))


def _solve(matrices: Doubles, right: Doubles) -> Doubles:
    """Newton steps (n, 6); least squares, which a singular start survives, only where one is needed."""
    column = right[..., None]
    try:
        steps = np.linalg.solve(matrices, column)
    except np.linalg.LinAlgError:
        steps = np.asarray(np.linalg.pinv(matrices) @ column)
    return np.asarray(steps[..., 0], dtype=np.float64)
