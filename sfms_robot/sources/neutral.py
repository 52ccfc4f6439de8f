"""What a person's face is at rest, learned while they are seen, and what they do apart from that.

A camera looks from the side or from below, and no face rests at zero. So the pose a person holds most is straight
ahead, and a blendshape counts from its resting level on: (v - rest) / (1 - rest).

Rest is a quantile of the last two minutes, one sample every half second: the median of pose and gaze, which go both
ways, a low quantile of all other shapes, which only go up. From the first face on there is one, of what was seen so
far. So:

- a camera's angle and a face's offset are gone 3 s after the first face, and 80 s after the camera was moved;
- what lasts less than half of what is remembered (pose, gaze) or four fifths of it (the others) stays what it is: a
  minute once two have been seen;
- a face that was away for 10 s may come back as somebody else: learning begins anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import BLENDSHAPES, CHANNELS, MOTION_DIM, POSE, SHAPES, Doubles, Floats
from sfms_robot.signals.rotations import rotation
from sfms_robot.signals.spaces import angles_of

REMEMBERED_S: Final = 120.0
AWAY_S: Final = 10.0
_SAMPLE_S: Final = 0.5
_SAMPLES: Final = int(REMEMBERED_S / _SAMPLE_S)
_EASE_S: Final = 0.5  # time constant with which rest follows its estimate: a face never jumps
_SHAPE_QUANTILE: Final = 0.2
_HIGHEST_REST: Final = 0.5  # a shape held above this is an expression, however long it lasts
_MEDIANS: Final = [i for i, name in enumerate(CHANNELS) if name not in BLENDSHAPES or name.startswith("eyeLook")]


@dataclass(frozen=True)
class Neutral:
    """What is remembered of one person. A value: `step` gives a new one.

    Attributes:
        time_s: of the last face.
        sampled_s: of the last sample.
        samples: (n, 58) newest last, n <= 240.
        estimate: (58,) rest, as the samples tell it.
        rest: (58,) what is taken off now.
    """

    time_s: float
    sampled_s: float
    samples: Floats
    estimate: Floats
    rest: Floats


def step(motion: Floats, time_s: float, state: Neutral | None) -> tuple[Floats, Neutral]:
    """One face (58,) of `time_s`, in order of time -> what the person does (58,), and what is known of them now.

    `state` None: nobody was seen yet. Shapes stay within 0..1.
    """
    state = _learned(np.asarray(motion, dtype=np.float32), time_s, state)
    return _relative(motion, state.rest), state


def _learned(motion: Floats, time_s: float, state: Neutral | None) -> Neutral:
    if state is None or not 0 <= time_s - state.time_s <= AWAY_S:
        rest = _rest(motion[None])
        return Neutral(time_s, time_s, motion[None], rest, rest)
    samples, sampled_s, estimate = state.samples, state.sampled_s, state.estimate
    if time_s - sampled_s >= _SAMPLE_S:
        samples = np.concatenate([samples[1 - _SAMPLES :], motion[None]])
        sampled_s, estimate = time_s, _rest(samples)
    follow = 1.0 - math.exp((state.time_s - time_s) / _EASE_S)
    rest = state.rest + np.float32(follow) * (estimate - state.rest)
    return Neutral(time_s, sampled_s, samples, estimate, rest)


def _rest(samples: Floats) -> Floats:
    """Samples (n, 58) -> (58,)."""
    low, middle = int(_SHAPE_QUANTILE * (len(samples) - 1)), (len(samples) - 1) // 2
    ranked = np.partition(samples, (low, middle), axis=0)
    rest: Floats = np.clip(ranked[low], 0.0, _HIGHEST_REST)
    rest[_MEDIANS] = ranked[middle, _MEDIANS]
    rest[SHAPES] = np.minimum(rest[SHAPES], _HIGHEST_REST)
    return rest


def _relative(motion: Floats, rest: Floats) -> Floats:
    """The pose seen from the resting one, R0^T R, and the shapes above their resting level."""
    out = np.zeros(MOTION_DIM, dtype=np.float32)
    both: Doubles = np.stack([rest[POSE], motion[POSE]]).astype(np.float64)
    at_rest, now = rotation(both[:, :3])
    out[POSE][:3] = angles_of((at_rest.T @ now)[None])[0]
    out[POSE][3:] = at_rest.T @ (both[1, 3:] - both[0, 3:])
    level = rest[SHAPES]
    out[SHAPES] = np.clip((motion[SHAPES] - level) / (1.0 - level), 0.0, 1.0)
    return out
