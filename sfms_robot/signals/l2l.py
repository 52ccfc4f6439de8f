"""How Learning2Listen prepares its data, and how FaceVerse turns angles into a rotation. Float64.

Sources: evonneng/learning2listen @ a0825d58 and LizhenWangT/FaceVerse @ a012b634 (BSD-2-Clause): definitions only.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfms_robot.frames import Doubles

STD_EPS: Final = 1e-10
BILATERAL_RADIUS: Final = 2  # cv2's d = 5
BILATERAL_SIGMA: Final = 20.0  # both of value and of place


def l2l_mean_std(x: ArrayLike) -> tuple[Doubles, Doubles]:
    """Clips (N, T, D) -> mean and "std" (1, 1, D) that L2L standardises with.

    The std is that over clips of the stds over time, which makes standardised errors several times larger than one
    would think.
    """
    clips = np.asarray(x, dtype=np.float64)
    if clips.ndim != 3:
        raise ValueError(f"clips are (N, T, D), got shape {clips.shape}")
    mean: Doubles = clips.mean(axis=1).mean(axis=0)[None, None]
    std: Doubles = clips.std(axis=1).std(axis=0)[None, None] + STD_EPS
    return mean, std


def l2l_bilateral(x: ArrayLike) -> Doubles:
    """Smooth clips (..., T, D) over time as L2L does before anything else: cv2's bilateral filter, d 5, sigmas 20.

    A channel is an image of width 1 with reflected borders, so the circular neighbourhood holds the frame itself five
    times, the next ones three times and the second next once.
    """
    clips = np.asarray(x, dtype=np.float64)
    frames = clips.shape[-2]
    total, weights = np.zeros_like(clips), np.zeros_like(clips)
    for step in range(-BILATERAL_RADIUS, BILATERAL_RADIUS + 1):
        place = _reflected(np.arange(frames) + step, frames)
        neighbour = clips[..., place, :]
        near = np.exp(-((neighbour - clips) ** 2) / (2 * BILATERAL_SIGMA**2))
        for across in range(-BILATERAL_RADIUS, BILATERAL_RADIUS + 1):
            distance2 = step**2 + across**2
            if distance2 <= BILATERAL_RADIUS**2:
                weight = near * np.exp(-distance2 / (2 * BILATERAL_SIGMA**2))
                total += weight * neighbour
                weights += weight
    smooth: Doubles = total / weights
    return smooth


def _reflected(index: NDArray[np.int_], size: int) -> NDArray[np.int_]:
    """Reflect-101: ... 2 1 | 0 1 2 ... n-1 | n-2 ..."""
    if size == 1:
        return np.zeros_like(index)
    period = 2 * (size - 1)
    folded = np.abs(index) % period
    inside: NDArray[np.int_] = np.minimum(folded, period - folded)
    return inside


def faceverse_rotation(euler: ArrayLike) -> Doubles:
    """Angles (..., 3) x, y, z [rad] -> R (..., 3, 3) = Rz Ry Rx. A neutral head has x near pi."""
    x, y, z = np.moveaxis(np.asarray(euler, dtype=np.float64), -1, 0)
    zero, one = np.zeros_like(x), np.ones_like(x)

    def stacked(*rows: tuple[Doubles, ...]) -> Doubles:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    rx = stacked((one, zero, zero), (zero, np.cos(x), -np.sin(x)), (zero, np.sin(x), np.cos(x)))
    ry = stacked((np.cos(y), zero, np.sin(y)), (zero, one, zero), (-np.sin(y), zero, np.cos(y)))
    rz = stacked((np.cos(z), -np.sin(z), zero), (np.sin(z), np.cos(z), zero), (zero, zero, one))
    rotation: Doubles = rz @ ry @ rx
    return rotation
