"""A speaker as some microphone in some room and some face tracker would take them.

None of it is of the person: a listener that was taught with many learns to leave it alone.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, POSE, SHAPES, Floats
from sfms_robot.lab.corpora.compose.voices import Voice, reverberant, room

_CLOSE: Final = 0.4  # share of microphones that hear no room
_GAIN_DB: Final = (-14.0, 8.0)
_TILT: Final = (-0.4, 0.5)
_LOST: Final = 0.4  # share of trackers that lose a face now and then
_LOST_A_MINUTE: Final = 2.0
_LOST_S: Final = (0.3, 3.0)


def heard(speech: Floats, voice: Voice, rng: np.random.Generator) -> Floats:
    """Speech (n,) with room, spectral tilt, gain and noise floor."""
    direct = speech if rng.random() < _CLOSE else reverberant(speech, rng)
    tilt = np.float32(rng.uniform(*_TILT))
    toned = direct - tilt * np.concatenate([[0], direct[:-1]]).astype(np.float32)
    gain = np.float32(10 ** (rng.uniform(*_GAIN_DB) / 20))
    return np.asarray(np.clip(gain * toned + room(len(speech), voice, rng), -1, 1), np.float32)


def seen(motion: Floats, rng: np.random.Generator) -> Floats:
    """A face (N, 58) with a tracker's neutral, scale and noise; rows of NaN where it was lost."""
    frames = len(motion)
    out = motion.copy()
    stands = np.concatenate([np.deg2rad(rng.normal(0, 5, 3)), rng.normal(0, 0.05, 3)])
    shakes = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02]) * np.deg2rad(rng.uniform(0.05, 0.3))  # metres: under 0.1 mm
    out[:, POSE] += stands + shakes * rng.standard_normal((frames, 6))
    shapes = out[:, SHAPES]
    rests = np.maximum(0, rng.normal(0, 0.05, shapes.shape[1]))
    shapes *= rng.uniform(0.85, 1.1)
    shapes += rests + rng.uniform(0.002, 0.012) * rng.standard_normal(shapes.shape)
    np.clip(shapes, 0, 1, out=shapes)
    if rng.random() < _LOST:
        for start in rng.uniform(0, frames, rng.poisson(_LOST_A_MINUTE * frames / FRAME_HZ / 60)):
            out[int(start) : int(start + rng.uniform(*_LOST_S) * FRAME_HZ)] = np.nan
    return out
