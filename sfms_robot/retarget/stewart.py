"""A neck that is a Stewart platform on six cranks and rods (6-RSS), on a body that may turn.

One servo turns each crank, a rod joins crank tip and head. With q the rod's head end in the frame of the servo (x, y in
the plane of the crank, z its axis), crank length c and rod length l, the tip (c cos a, c sin a, 0) is on the rod's
sphere where

    a = atan2(qy, qx) + s acos(k),    k = (|q|^2 + c^2 - l^2) / (2 c sqrt(qx^2 + qy^2)),

s = +-1 being the side the crank is mounted on. No solution where |k| > 1: the rod is too short or too long.
q is linear in (R, t), so all legs of many poses are one matrix product. The other way round there is no closed form:
damped Newton on the six rod lengths, from a pose nearby.

The body takes the yaw beyond the platform's part, or the slow part of it; the platform gets the rest, shrunk toward its
home where it is out of reach. In reach is a pose that keeps the lean limits of the head, has all cranks inside their
ranges and off their dead centres, and leaves the head stiff: beyond a pose where the legs leave one direction loose,
the same cranks would fit but the head could only have fallen there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config.kinematics import StewartPlatform
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS, Doubles
from sfms_robot.retarget.neck import Ranges, Solved, checked, low_pass
from sfms_robot.signals import rotations

MAX_STEPS: Final = 60
SHORTEST_STEP: Final = 1e-3
CLOSE_ENOUGH_M: Final = 1e-15  # rod lengths' error at which Newton stops at once; rounding often stops it before
ARRIVED_M: Final = 1e-12
FOLLOW_STEPS: Final = 16
MIN_STIFFNESS: Final = 0.02  # share of the stiffness (determinant) at home
DEAD_CENTRE: Final = 0.999  # a crank turns at most some 22 times as fast as in the middle of its stroke
ROUNDING_RAD: Final = 1e-9  # so that a pose right at a limit is still within it, seen from a turned body
HOME: Final = np.zeros(6)
BLOCK: Final = 500  # poses at a time, for the memory that their pieces take
PIECES: Final = 32
PASSES: Final = 6  # to a billionth of the way: 32 ** 6 = 2 ** 30

Reachable = Callable[[Doubles], NDArray[np.bool_]]  # poses (n, 6) -> (n,)


@dataclass(frozen=True, kw_only=True)
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
        ends: Doubles = (stacked @ self.linear.T + self.constant).reshape(*shape, 6, 3)
        return ends

    def inverse(self, poses: Doubles, dead_centre: float = 1.0) -> Doubles:
        """Return crank angles (..., 6) [rad] within -pi..pi of poses (..., 6); NaN for a leg that does not reach.

        At |k| = 1 crank and rod lie in line and the crank turns ever faster with the head: a `dead_centre` below 1
        keeps away from there.
        """
        q = self.rod_ends_m(rotations.rotation(poses[..., :3]), poses[..., 3:])
        flat = np.hypot(q[..., 0], q[..., 1])
        k = ((q * q).sum(-1) + (self.crank_m**2 - self.rod_m**2)) / (2 * self.crank_m * flat)
        turn = np.arccos(np.where(np.abs(k) <= dead_centre, k, np.nan))
        return rotations.wrapped(np.arctan2(q[..., 1], q[..., 0]) + self.side * turn)

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        """Return the poses (..., 6) of crank angles (..., 6), from a pose (..., 6) nearby: the last one, or home.

        Several poses fit the same cranks: where Newton arrives at one with a loose direction in between, it follows
        the cranks in small steps from `start` instead. A row is NaN where its angles are not finite, no pose has
        them, or `start` is not a pose of this platform.
        """
        angles = np.reshape(angles_rad, (-1, 6))
        begin = np.broadcast_to(start, angles_rad.shape).reshape(-1, 6)
        before = self.inverse(begin)
        out = np.full(angles.shape, np.nan)
        sound = np.isfinite(angles).all(axis=-1) & np.isfinite(before).all(axis=-1)
        out[sound] = self._forward(angles[sound], begin[sound], before[sound])
        return out.reshape(angles_rad.shape)

    def _forward(self, angles: Doubles, begin: Doubles, before: Doubles) -> Doubles:
        """Return the poses (n, 6) of crank angles (n, 6), from poses (n, 6) with cranks at `before` (n, 6)."""
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
        """Return the determinant (...) of rod lengths against motion of the head; 0 for a head with a loose direction.

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
        """Return the excess length (n, 6) [m] of each rod, to first order, and the vectors tip -> rod end (n, 6, 3)."""
        toward = self.rod_ends_m(rotation, place) - tips
        return ((toward * toward).sum(-1) - self.rod_m**2) / (2 * self.rod_m), toward

    def _jacobian(self, rotation: Doubles, toward: Doubles) -> Doubles:
        """Return the change of the errors (n, 6, 6) with a rotation vector, then a shift, of the head."""
        arm = self.rod_arms_m @ np.swapaxes(rotation, -1, -2)
        pull = np.einsum("nli,lij->nlj", toward, self.turn) / self.rod_m  # the rods' directions, seen from the body
        jacobian = np.empty((len(toward), 6, 6))
        for axis in range(3):  # w x arm . pull = w . (arm x pull)
            first, second = (axis + 1) % 3, (axis + 2) % 3
            jacobian[..., axis] = arm[..., first] * pull[..., second] - arm[..., second] * pull[..., first]
        jacobian[..., 3:] = pull
        return jacobian

    def _newton(self, angles: Doubles, start: Doubles) -> tuple[Doubles, Doubles]:
        """Return the poses (n, 6) with these crank angles (n, 6), and the final error of each (n,) [m]."""
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
        return np.concatenate([rotations.angles_of(rotation), place], axis=-1), _size(error)


def _size(error: Doubles) -> Doubles:
    return np.asarray(np.linalg.norm(error, axis=-1))


def _solve(matrices: Doubles, right: Doubles) -> Doubles:
    """Return Newton steps (n, 6); by least squares, which handles a singular start, only where it is needed."""
    column = right[..., None]
    try:
        steps = np.linalg.solve(matrices, column)
    except np.linalg.LinAlgError:
        steps = np.asarray(np.linalg.pinv(matrices) @ column)
    return np.asarray(steps[..., 0], dtype=np.float64)


class Stewart:
    """A Stewart platform, with the methods of every neck (`neck.Serial`). The memory is the low-passed yaw, (1,)."""

    axes: Sequence[str] = POSE_CHANNELS

    def __init__(self, config: StewartPlatform, ranges: Ranges) -> None:
        self.joints: Sequence[str] = config.joints()
        self.geometry = Platform.of(config)
        self._body = config.body_yaw
        self._low, self._high = np.array([ranges[leg.joint] for leg in config.legs]).T
        self._body_range = ranges[self._body.joint] if self._body else (0.0, 0.0)
        limits = config.limits
        self._lean = (
            np.array([*np.radians([limits.roll_deg, limits.pitch_deg, limits.yaw_deg]), *[np.inf] * 3]) + ROUNDING_RAD
        )
        home = self.geometry.inverse(HOME, DEAD_CENTRE)
        if not bool(((home >= self._low) & (home <= self._high)).all()):  # neither for NaN
            shown = ", ".join(
                f"{name} {angle:.1f}" for name, angle in zip(self.joints[-6:], np.degrees(home), strict=True)
            )
            raise ConfigError(f"kinematics: home is out of reach: its cranks would stand at {shown} deg")
        self._home_stiffness = float(self.geometry.stiffness(HOME, home))

    @property
    def turns_body(self) -> bool:
        return self._body is not None

    def reachable(self, poses: Doubles) -> NDArray[np.bool_]:
        """Return True (n,) for the poses (n, 6), seen from the body, that the platform can take."""
        cranks = self.geometry.inverse(poses, DEAD_CENTRE)
        inside = (cranks >= self._low) & (cranks <= self._high)  # False for NaN
        fine = inside.all(axis=-1) & (np.abs(poses) <= self._lean).all(axis=-1)
        stiff = self.geometry.stiffness(poses[fine], cranks[fine])
        fine[fine] = stiff / self._home_stiffness >= MIN_STIFFNESS
        return np.asarray(fine)

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
        legs = angles_rad[..., -6:]
        return rotations.seen_from(-body, self.geometry.forward(legs, rotations.seen_from(body, start)))

    def _body_yaw(self, yaw_rad: Doubles, slow_rad: Doubles) -> Doubles:
        """Return the body's part (...) of the yaw (...): the slow one, and always the part beyond the platform's."""
        if self._body is None:
            return np.zeros_like(yaw_rad)
        beyond = np.radians(self._body.beyond_deg)
        wanted = slow_rad if self._body.low_pass_hz is not None else np.zeros_like(yaw_rad)
        return np.clip(np.clip(wanted, yaw_rad - beyond, yaw_rad + beyond), *self._body_range)

    def _solved(self, poses: Doubles, body: Doubles) -> Solved:
        shape = poses.shape[:-1]
        wanted = rotations.seen_from(body, poses).reshape(-1, 6)
        given, reached = nearest(wanted, self.reachable)
        cranks = np.clip(self.geometry.inverse(given), self._low, self._high)  # a border pose may round past its end
        angles = cranks.reshape(*shape, 6)
        if self.turns_body:
            angles = np.concatenate([np.broadcast_to(body, shape)[..., None], angles], axis=-1)
        missing_rad = rotations.angle_between(rotations.rotation(wanted[:, :3]), rotations.rotation(given[:, :3]))
        missing_m = np.asarray(np.linalg.norm(wanted[:, 3:] - given[:, 3:], axis=-1))
        reached = reached.reshape(shape)
        shown = np.where(reached[..., None], poses, rotations.seen_from(-body, given.reshape(poses.shape)))
        return Solved(
            angles_rad=angles,
            reached=reached,
            residual_rad=missing_rad.reshape(shape),
            residual_m=missing_m.reshape(shape),
            shown=shown,
        )


def nearest(poses: Doubles, reachable: Reachable) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return the nearest poses (n, 6) that can be reached, straight back toward home, and which were reached (n,).

    Home, the zero pose, is inside the reach. Along the straight line home -> wanted pose (in roll, pitch, yaw, x, y, z)
    the border is the first place where the reach ends; it is found by cutting the line into pieces and keeping the
    first one that leaves. The answer depends on the wanted pose alone and changes continuously with it as long as the
    reach is star-shaped about home, so a pose that moves smoothly in and out of reach gives a smooth one, with nothing
    to remember. A pose in reach comes back unchanged, even where the line to it leaves the reach for a while.
    """
    reached = reachable(poses)
    out = poses.copy()
    beyond = np.flatnonzero(~reached)
    for first in range(0, beyond.size, BLOCK):
        some = beyond[first : first + BLOCK]
        out[some] *= _share(poses[some], reachable)[:, None]
    return out, reached


def _share(poses: Doubles, reachable: Reachable) -> Doubles:
    """Return the share (n,) of each pose (n, 6) lies before the border, 0..1."""
    start, width = np.zeros(len(poses)), 1.0
    ends = np.arange(1, PIECES + 1) / PIECES
    for _ in range(PASSES):
        shares = start[:, None] + width * ends  # (n, pieces)
        inside = reachable((shares[..., None] * poses[:, None]).reshape(-1, 6)).reshape(shares.shape)
        whole = np.where(inside.all(axis=1), PIECES - 1, np.argmin(inside, axis=1))  # pieces before the leaving one
        width /= PIECES
        start = start + width * whole
    return start
