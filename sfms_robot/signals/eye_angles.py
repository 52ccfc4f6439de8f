"""Eye channels as angles and back.

An eye's direction is (yaw, pitch): yaw + to the head's left, pitch + down, as the head's own yaw and pitch.
"""

from __future__ import annotations

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, Doubles, Floats

_LEFT = tuple(CHANNEL_INDEX[f"eyeLook{way}Left"] for way in ("Out", "In", "Down", "Up"))
_RIGHT = tuple(CHANNEL_INDEX[f"eyeLook{way}Right"] for way in ("In", "Out", "Down", "Up"))
_PLUS = np.array([_LEFT[0], _LEFT[2], _RIGHT[0], _RIGHT[2]])
_MINUS = np.array([_LEFT[1], _LEFT[3], _RIGHT[1], _RIGHT[3]])


def directions(motion: Floats, full_rad: Doubles) -> Doubles:
    """Motion (..., 58) -> (..., 2, 2): left and right eye, yaw and pitch [rad]; a channel of 1 is `full_rad` (2,)."""
    turned = motion.take(_PLUS, axis=-1).astype(np.float64) - motion.take(_MINUS, axis=-1)
    return turned.reshape(*motion.shape[:-1], 2, 2) * full_rad


def turn(motion: Floats, directions_rad: Doubles, full_rad: Doubles) -> None:
    """Write directions (..., 2, 2) into `motion` (..., 58), as far as the channels go."""
    share = (directions_rad / full_rad).reshape(*motion.shape[:-1], 4)
    motion[..., _PLUS] = np.minimum(np.maximum(share, 0.0), 1.0)
    motion[..., _MINUS] = np.minimum(np.maximum(-share, 0.0), 1.0)
