"""A neck that is a Stewart platform, on a body that may turn.

The body takes the yaw that is more than the platform should have, or the slow part of it; the platform gets the rest,
shrunk toward its home where it is out of reach. In reach is a pose that keeps the lean limits of the head, has all
cranks inside their ranges and off their dead centres, and leaves the head stiff: beyond a pose where the legs leave
one direction loose, the same cranks would fit but the head could only have fallen there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config.kinematics import StewartPlatform
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS, Doubles
from sfms_robot.retarget.kinematics.neck import Ranges, Solved, checked, low_pass
from sfms_robot.retarget.kinematics.stewart import Platform
from sfms_robot.signals import rotations

MIN_STIFFNESS: Final = 0.02  # share of the stiffness (determinant) at home
DEAD_CENTRE: Final = 0.999  # a crank turns at most some 22 times as fast as in the middle of its stroke
ROUNDING_RAD: Final = 1e-9  # so that a pose right at a limit is still within it, seen from a turned body
HOME: Final = np.zeros(6)
BLOCK: Final = 500  # poses at a time, for the memory that their pieces take
PIECES: Final = 32
PASSES: Final = 6  # to a billionth of the way: 32 ** 6 = 2 ** 30

Reachable = Callable[[Doubles], NDArray[np.bool_]]  # poses (n, 6) -> (n,)


class Stewart:
    """Implements `neck.Neck`. The memory is the low-passed yaw, (1,)."""

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
            shown = ", ".join(f"{name} {angle:.1f}" for name, angle in zip(self._legs, np.degrees(home), strict=True))
            raise ConfigError(f"kinematics: home is out of reach: its cranks would stand at {shown} deg")
        self._home_stiffness = float(self.geometry.stiffness(HOME, home))

    @property
    def turns_body(self) -> bool:
        return self._body is not None

    @property
    def _legs(self) -> Sequence[str]:
        return self.joints[-6:]

    def reachable(self, poses: Doubles) -> NDArray[np.bool_]:
        """Which of the poses (n, 6), seen from the body, the platform can take -> (n,)."""
        cranks = self.geometry.inverse(poses, DEAD_CENTRE)
        inside = (cranks >= self._low) & (cranks <= self._high)  # False for NaN
        fine = inside.all(axis=-1) & (np.abs(poses) <= self._lean).all(axis=-1)
        stiff = self.geometry.stiffness(poses[fine], cranks[fine])
        fine[fine] = stiff / self._home_stiffness >= MIN_STIFFNESS
        return np.asarray(fine)

    def solve(self, poses: Doubles, body_yaw_rad: Doubles | None = None) -> Solved:
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
        """The body's part (...) of the yaw (...): the slow one, and in any case what is beyond the platform's part."""
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
        return Solved(angles, reached, missing_rad.reshape(shape), missing_m.reshape(shape), shown)


def nearest(poses: Doubles, reachable: Reachable) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return the nearest poses (n, 6) that can be reached, straight back toward home, and which were reached (n,).

    Home, the zero pose, is inside the reach. Along the straight line home -> wanted pose (in roll, pitch, yaw, x, y, z)
    the border is the first place where the reach ends; it is found by cutting the line into pieces and keeping the
    first one that leaves. The answer depends on the wanted pose alone and changes continuously with it as long as the
    reach is star-shaped about home, so a pose that moves smoothly in and out of reach gives a smooth one, with nothing
    to remember. A pose that can be reached comes back as it is, even where the line to it leaves the reach for a while.
    """
    reached = reachable(poses)
    out = poses.copy()
    beyond = np.flatnonzero(~reached)
    for first in range(0, beyond.size, BLOCK):
        some = beyond[first : first + BLOCK]
        out[some] *= _share(poses[some], reachable)[:, None]
    return out, reached


def _share(poses: Doubles, reachable: Reachable) -> Doubles:
    """Return how much (n,) of each pose (n, 6) lies before the border, 0..1."""
    start, width = np.zeros(len(poses)), 1.0
    ends = np.arange(1, PIECES + 1) / PIECES
    for _ in range(PASSES):
        shares = start[:, None] + width * ends  # (n, pieces)
        inside = reachable((shares[..., None] * poses[:, None]).reshape(-1, 6)).reshape(shares.shape)
        whole = np.where(inside.all(axis=1), PIECES - 1, np.argmin(inside, axis=1))  # pieces before the leaving one
        width /= PIECES
        start = start + width * whole
    return start
