"""What every neck gives, whatever its mechanism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles

Range = tuple[float, float]  # min, max [rad]
Ranges = Mapping[str, Range]


@dataclass(frozen=True)
class Solved:
    """Joints for one pose or many.

    Attributes:
        angles_rad: (..., J) in the neck's joint order, always inside the joints' ranges.
        reached: (...) whether these joints give the very pose that was asked.
        residual_rad: (...) the turn that is missing.
        residual_m: (...) the shift that is missing.
        shown: (..., 6) the pose that these joints give, always finite; a turn that is reached is the one that was
            asked, to the bit.
    """

    angles_rad: Doubles
    reached: NDArray[np.bool_]
    residual_rad: Doubles
    residual_m: Doubles
    shown: Doubles


class Neck(Protocol):
    """Poses -> joint angles. What a neck remembers (low-passed angles) is a value handed through."""

    @property
    def joints(self) -> Sequence[str]: ...

    @property
    def axes(self) -> Sequence[str]:
        """The pose channels that it can show."""

    @property
    def turns_body(self) -> bool:
        """Whether one of the joints turns the body below the head."""

    def solve(self, poses: Doubles, body_yaw_rad: Doubles | None = None) -> Solved:
        """Poses (..., 6), each held for ever. Without `body_yaw_rad` (...) the neck's own rule turns the body.

        Raises ValueError where a pose is not finite, or a body yaw is given to a neck without one.
        """

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        """Joint angles (..., J) -> poses (..., 6), beginning the search, where there is one, at `start` (..., 6)."""

    def start(self) -> Doubles:
        """Memory of a neck that stands at home."""

    def step(self, pose: Doubles, dt_s: float, memory: Doubles) -> tuple[Doubles, Doubles]:
        """The joints (J,) for one pose (6,) after `dt_s`, and the memory after it."""


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
