"""A neck that is a Stewart platform on six cranks and rods (6-RSS), on a body that may turn.

One servo turns each crank, a rod joins crank tip and head. With q the rod's head end in the frame of the servo (x, y in
the plane of the crank, z its axis), crank length c and rod length l, the tip (c cos a, c sin a, 0) is on the rod's
sphere where

    a = atan2(qy, qx) + s acos(k),    k = (|q|^2 + c^2 - l^2) / (2 c sqrt(qx^2 + qy^2)),

s = +-1 being the side the crank is mounted on. There is no solution where |k| > 1: the rod is too short or too long.
q is linear in (R, t), so all legs of many poses are one matrix product. The other direction has no closed form: the six
rod lengths are solved for the pose, starting from a pose nearby (scipy).

The body takes the yaw beyond the platform's part, or the slow part of it. The platform gets the rest, shrunk toward its
home where it is out of reach. A pose is in reach if it keeps the lean limits of the head, has all cranks inside their
ranges and off their dead centres, and leaves the head stiff. Beyond a pose where the legs leave one direction loose,
the same crank angles would fit, but the head could only get there by falling.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.config.kinematics import StewartPlatform
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS, Bools, Doubles
from sfms_robot.ranges import Range
from sfms_robot.retarget.neck import Ranges, Solved, checked, low_pass
from sfms_robot.signals import rotations

TOLERANCE: Final = 1e-14  # tolerance of the search for a pose
ARRIVED_M: Final = 1e-12  # error of the rods' lengths
FOLLOW_RAD: Final = 0.25  # the most that a crank turns between two poses of a search
MIN_STIFFNESS: Final = 0.02  # share of the stiffness (determinant) at home
DEAD_CENTRE: Final = 0.999  # a crank turns at most some 22 times as fast as in the middle of its stroke
ROUNDING_RAD: Final = 1e-9  # slack, so that a pose exactly at a limit is within it, seen from a turned body
HOME: Final = np.zeros(6)
BLOCK: Final = 500  # poses at a time, to limit the memory for their pieces
PIECES: Final = 32
PASSES: Final = 6  # to a billionth of the way: 32 ** 6 = 2 ** 30


@dataclass(frozen=True, kw_only=True)
class Platform:
    """Geometry of six legs, poses seen from the body that carries the servos.

    Attributes:
        linear: (18, 12) matrix from R row by row and t to the rod ends in the servos' frames, leg by leg.
        constant: (18,) the rod ends' constant part, from the home pose's height and the servos' places.
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
        return cls(
            linear=np.concatenate([by_rotation, turn.reshape(18, 3)], axis=1),
            constant=(place + turn[..., 2] * config.home_height_m).reshape(18),
            turn=turn,
            rod_arms_m=ends,
            side=np.array([float(leg.side) for leg in config.legs]),
            crank_m=config.crank_m,
            rod_m=config.rod_m,
        )

    def rod_ends_m(self, rotation: Doubles, place_m: Doubles) -> Doubles:
        """Return q (..., 6, 3) of R (..., 3, 3) and t (..., 3)."""
        shape = place_m.shape[:-1]
        stacked = np.concatenate([rotation.reshape(*shape, 9), place_m], axis=-1)
        return (stacked @ self.linear.T + self.constant).reshape(*shape, 6, 3)

    def inverse(self, poses: Doubles, dead_centre: float = 1.0) -> Doubles:
        """Return crank angles (..., 6) [rad] within -pi..pi of poses (..., 6); NaN for a leg that does not reach.

        Toward |k| = 1, where crank and rod lie in line, the crank turns ever faster with the head. A `dead_centre`
        below 1 excludes these poses.
        """
        q = self.rod_ends_m(rotations.rotation(poses[..., :3]), poses[..., 3:])
        flat = np.hypot(q[..., 0], q[..., 1])
        k = ((q * q).sum(-1) + (self.crank_m**2 - self.rod_m**2)) / (2 * self.crank_m * flat)
        turn = np.arccos(np.where(np.abs(k) <= dead_centre, k, np.nan))
        return rotations.wrapped(np.arctan2(q[..., 1], q[..., 0]) + self.side * turn)

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        """Return the poses (..., 6) of crank angles (..., 6); `start` (..., 6): a pose nearby, the last one or home.

        A row is NaN if its angles are not finite, no pose has them, or `start` is not a pose of this platform. Takes a
        millisecond per pose.
        """
        begin, out = np.broadcast_to(start, angles_rad.shape), np.full(angles_rad.shape, np.nan)
        for row in np.ndindex(angles_rad.shape[:-1]):
            out[row] = self._pose(angles_rad[row], begin[row])
        return out

    def _pose(self, angles: Doubles, begin: Doubles) -> Doubles:
        """Return the pose (6,) of crank angles (6,).

        Several poses fit the same cranks. The search therefore follows the cranks from `begin` in small steps. The
        result is NaN if it passed a pose with a loose direction.
        """
        from scipy.optimize import root  # only pictures of a head need it

        before = self.inverse(begin)
        if not np.isfinite([angles, before]).all():
            return np.full(6, np.nan)
        steps = max(int(np.ceil(np.abs(angles - before).max() / FOLLOW_RAD)), 1)
        pose = begin
        for cranks in before + np.arange(1, steps + 1)[:, None] / steps * (angles - before):
            found = root(self._excess_m, pose, (self._tips(cranks),), tol=TOLERANCE)
            pose = np.asarray(found.x)
        same_side = self.stiffness(pose, angles) * self.stiffness(begin, before) > 0
        return pose if same_side and np.abs(found.fun).max() < ARRIVED_M else np.full(6, np.nan)

    def _excess_m(self, pose: Doubles, tips: Doubles) -> Doubles:
        """Return the excess length (6,) of each rod, to first order."""
        toward = self.rod_ends_m(rotations.rotation(pose[:3]), pose[3:]) - tips
        return np.asarray(((toward * toward).sum(-1) - self.rod_m**2) / (2 * self.rod_m))

    def stiffness(self, poses: Doubles, angles_rad: Doubles) -> Doubles:
        """Return the determinant (...) of rod lengths against motion of the head; 0 for a head with a loose direction.

        Poses beyond, with the other sign, also fit these cranks, but the head can reach them only by falling through.
        """
        rotation = rotations.rotation(poses[..., :3])
        # The change of the rods' lengths with a rotation vector w, then a shift, of the head: (w x arm) . pull =
        # w . (arm x pull), pull being the direction of a rod, seen from the body.
        toward = self.rod_ends_m(rotation, poses[..., 3:]) - self._tips(angles_rad)
        arm = self.rod_arms_m @ np.swapaxes(rotation, -1, -2)
        pull = np.einsum("...li,lij->...lj", toward, self.turn) / self.rod_m
        return np.asarray(np.linalg.det(np.concatenate([np.cross(arm, pull), pull], axis=-1)))

    def _tips(self, angles: Doubles) -> Doubles:
        return self.crank_m * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)


class Stewart:
    """A Stewart platform, with the methods of every neck (`neck.Serial`). The memory is the low-passed yaw, (1,)."""

    axes = POSE_CHANNELS

    def __init__(self, config: StewartPlatform, ranges: Ranges) -> None:
        self.joints = config.joints()
        self.geometry = Platform.of(config)
        self._body = config.body_yaw
        self._range = Range(*np.array([ranges[leg.joint] for leg in config.legs]).T)
        self._body_range = ranges[self._body.joint] if self._body else (0.0, 0.0)
        limits = config.limits
        self._lean = (
            np.array([*np.radians([limits.roll_deg, limits.pitch_deg, limits.yaw_deg]), *[np.inf] * 3]) + ROUNDING_RAD
        )
        home = self.geometry.inverse(HOME, DEAD_CENTRE)
        if not self._range.holds(home).all():
            shown = ", ".join(
                f"{name} {angle:.1f}" for name, angle in zip(self.joints[-6:], np.degrees(home), strict=True)
            )
            raise ConfigError(f"kinematics: home is out of reach: its cranks would stand at {shown} deg")
        self._home_stiffness = float(self.geometry.stiffness(HOME, home))

    @property
    def turns_body(self) -> bool:
        return self._body is not None

    def reachable(self, poses: Doubles) -> Bools:
        """Return True (n,) for the poses (n, 6), seen from the body, that the platform can reach."""
        cranks = self.geometry.inverse(poses, DEAD_CENTRE)
        fine = np.asarray(self._range.holds(cranks).all(axis=-1) & (np.abs(poses) <= self._lean).all(axis=-1))
        fine[fine] = self.geometry.stiffness(poses[fine], cranks[fine]) / self._home_stiffness >= MIN_STIFFNESS
        return fine

    def solve(self, poses: Doubles, body_yaw_rad: Doubles | None = None) -> Solved:
        """Solve poses (..., 6), see `neck.Serial.solve`."""
        poses = checked(poses)
        if body_yaw_rad is None:
            body = self._body_yaw(poses[..., 2], poses[..., 2])
        elif self._body is None:
            raise ValueError("this neck has no body yaw")
        else:
            body = np.clip(body_yaw_rad, *self._body_range)
        return self._solved(poses, body)

    def start(self) -> Doubles:
        return np.zeros(1)

    def step(self, pose: Doubles, dt_s: float, memory: Doubles) -> tuple[Doubles, Doubles]:
        wanted, slow = checked(pose), memory
        if self._body is not None and self._body.low_pass_hz is not None:
            slow = np.array([low_pass(float(wanted[2]), float(memory[0]), self._body.low_pass_hz, dt_s)])
        return self._solved(wanted, self._body_yaw(wanted[2], slow[0])).angles_rad, slow

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        body = angles_rad[..., 0] if self.turns_body else np.zeros(angles_rad.shape[:-1])
        return rotations.seen_from(-body, self.geometry.forward(angles_rad[..., -6:], rotations.seen_from(body, start)))

    def _body_yaw(self, yaw_rad: Doubles, slow_rad: Doubles) -> Doubles:
        """Return the body's part (...) of the yaw (...): the slow part, and always what exceeds the platform's part."""
        if self._body is None:
            return np.zeros_like(yaw_rad)
        beyond = np.radians(self._body.beyond_deg)
        wanted = slow_rad if self._body.low_pass_hz is not None else np.zeros_like(yaw_rad)
        return np.clip(np.clip(wanted, yaw_rad - beyond, yaw_rad + beyond), *self._body_range)

    def _solved(self, poses: Doubles, body: Doubles) -> Solved:
        shape = poses.shape[:-1]
        wanted = rotations.seen_from(body, poses).reshape(-1, 6)
        given, reached = self.nearest(wanted)
        # By rounding, a crank may exceed its range at a border pose.
        angles = self._range.nearest(self.geometry.inverse(given)).reshape(*shape, 6)
        if self.turns_body:
            angles = np.concatenate([np.broadcast_to(body, shape)[..., None], angles], axis=-1)
        reached = reached.reshape(shape)
        shown = np.where(reached[..., None], poses, rotations.seen_from(-body, given.reshape(poses.shape)))
        return Solved(wanted=poses, angles_rad=angles, reached=reached, shown=shown)

    def nearest(self, poses: Doubles) -> tuple[Doubles, Bools]:
        """Return the nearest poses (n, 6) that can be reached, straight back toward home, and which were reached (n,).

        Home, the zero pose, is inside the reach. Along the straight line home -> wanted pose (in roll, pitch, yaw, x,
        y, z) the border is the first place where the reach ends; it is found by cutting the line into pieces and
        keeping the first one that leaves. The answer depends on the wanted pose alone and changes continuously with it
        as long as the reach is star-shaped about home, so a pose that moves smoothly in and out of reach gives a smooth
        one, without any memory. A pose in reach is returned unchanged, even where the line to it leaves the reach for a
        while.
        """
        reached = self.reachable(poses)
        out = poses.copy()
        beyond = np.flatnonzero(~reached)
        for first in range(0, beyond.size, BLOCK):
            some = beyond[first : first + BLOCK]
            out[some] *= self._share(poses[some])[:, None]
        return out, reached

    def _share(self, poses: Doubles) -> Doubles:
        """Return the share (n,) of each pose (n, 6) that lies before the border, 0..1."""
        start, width = np.zeros(len(poses)), 1.0
        ends = np.arange(1, PIECES + 1) / PIECES
        for _ in range(PASSES):
            shares = start[:, None] + width * ends  # (n, pieces)
            inside = self.reachable((shares[..., None] * poses[:, None]).reshape(-1, 6)).reshape(shares.shape)
            whole = np.where(inside.all(axis=1), PIECES - 1, np.argmin(inside, axis=1))  # pieces before the leaving one
            width /= PIECES
            start = start + width * whole
        return start
