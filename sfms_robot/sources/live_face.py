"""The face of a live person: what `--face` says of it, and from a tracker's faces, as they arrive, to `Sighting`s.

The flag is `--face KIND[:PLACE][,flip=CHANNEL+CHANNEL]`. PLACE is the kind's own: a UDP port, a camera. `flip` turns
the sign of pose channels that a tracker has the other way round: `live-link:11111,flip=yaw+roll`.
"""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    BLENDSHAPES,
    CHANNEL_INDEX,
    CHANNELS,
    MOTION_DIM,
    POSE,
    POSE_CHANNELS,
    SHAPES,
    Doubles,
    FaceFrame,
    Floats,
    Sighting,
)
from sfms_robot.signals.rotations import rotation
from sfms_robot.signals.spaces import angles_of

_OPTION: Final = re.compile(r",([a-z]+)=([^,=]*)$")
_BLINKS: Final = [CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"]]
_WAITING: Final = 256  # faces; who is not asked for longer than these keeps the newest
REMEMBERED_S: Final = 120.0
AWAY_S: Final = 10.0
_SAMPLE_S: Final = 0.5
_SAMPLES: Final = int(REMEMBERED_S / _SAMPLE_S)
_EASE_S: Final = 0.5  # time constant with which rest follows its estimate: a face never jumps
_SHAPE_QUANTILE: Final = 0.2
_HIGHEST_REST: Final = 0.5  # a shape held above this is an expression, however long it lasts
_MEDIANS: Final = [i for i, name in enumerate(CHANNELS) if name not in BLENDSHAPES or name.startswith("eyeLook")]


@dataclass(frozen=True)
class FaceArgument:
    """PLACE, "" where none is given, and the pose channels to flip."""

    place: str
    flip: tuple[str, ...] = ()

    @property
    def signs(self) -> Floats:
        """(6,) -1 for every pose channel that is flipped, 1 for the others."""
        return np.array([-1.0 if name in self.flip else 1.0 for name in POSE_CHANNELS], dtype=np.float32)


def parse_face_argument(kind: str, argument: str) -> FaceArgument:
    """Return the parsed text behind `KIND:`. Raises ConfigError for another option, and for an unknown channel."""
    place, flip = argument, ()
    while option := _OPTION.search(place):
        name, value = option.groups()
        channels = tuple(value.split("+"))
        if name != "flip":
            raise ConfigError(f"--face {kind}: option {name!r} is not known (flip)")
        for channel in channels:
            if channel not in POSE_CHANNELS:
                raise ConfigError(f"--face {kind}: flip = {channel!r} is no pose channel ({', '.join(POSE_CHANNELS)})")
        place, flip = place[: option.start()], (*channels, *flip)
    return FaceArgument(place, flip)


class LiveFace:
    """Takes motion (58,) with its `time.monotonic` time; gives sightings with the person's rest taken off.

    Several faces between two questions become one, the newest, with the strongest blink of all: none falls between
    frames. Not thread-safe.

    signs: (6,) factors of the pose channels.
    """

    def __init__(self, signs: Floats) -> None:
        self._signs = signs
        self._neutral: Neutral | None = None
        self._waiting: deque[tuple[float, Floats, Floats | None]] = deque(maxlen=_WAITING)
        self._sighting: Sighting | None = None
        self._origin_s = 0.0

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`. What was learned of the person stays."""
        self._origin_s, self._sighting = origin_s, None

    def forget(self) -> None:
        """Another camera, or another person: what was learned of the last one does not hold."""
        self._neutral = None

    def put(self, time_s: float, motion: Floats, place_m: Floats | None = None) -> None:
        """A face (58,) of `time_s` of `time.monotonic`, in order of time; `place_m`: see `Sighting`."""
        self._waiting.append((time_s, motion, place_m))

    def at(self, time_s: float) -> Sighting | None:
        """See `ports.Sight.at`."""
        seen = []
        while self._waiting and self._waiting[0][0] - self._origin_s <= time_s:
            seen.append(self._waiting.popleft())
        if seen:
            seen_s, newest, place_m = seen[-1]
            motion = newest.copy()
            motion[_BLINKS] = np.max([each[_BLINKS] for _, each, _ in seen], axis=0)
            motion[POSE] *= self._signs
            # Learned in monotonic time: a start does not tear it apart.
            motion, self._neutral = relative_to_rest(motion, seen_s, self._neutral)
            self._sighting = Sighting(FaceFrame.of(seen_s - self._origin_s, motion), place_m=place_m)
        return self._sighting


# --- a person's face at rest, learned while they are seen ---------------------------------------------------------
#
# A camera looks from the side or from below, and no face rests at zero. So the pose a person holds most is straight
# ahead, and a blendshape counts from its resting level on: (v - rest) / (1 - rest).
#
# Rest is a quantile of the last two minutes, one sample every half second: the median of pose and gaze, which go both
# ways, a low quantile of all other shapes, which only go up. From the first face on there is one, of what was seen so
# far. So:
#
# - a camera's angle and a face's offset are gone 3 s after the first face, and 80 s after the camera was moved;
# - what lasts less than half of what is remembered (pose, gaze) or four fifths of it (the others) stays what it is: a
#   minute once two have been seen;
# - a face that was away for 10 s may come back as another person: learning begins again.


@dataclass(frozen=True)
class Neutral:
    """A memory of one person. A value: `relative_to_rest` gives a new one.

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


def relative_to_rest(motion: Floats, time_s: float, state: Neutral | None) -> tuple[Floats, Neutral]:
    """Return what the person does (58,) in one face (58,) of `time_s`, and the new memory; faces come in order of time.

    `state` None: no person was seen yet. Shapes stay within 0..1.
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
