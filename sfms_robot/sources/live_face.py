"""From the faces of a tracker, as they arrive, to `Sighting`s in loop time."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, POSE, FaceFrame, Floats, Sighting
from sfms_robot.sources import neutral

_BLINKS: Final = [CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"]]
_WAITING: Final = 256  # faces; who is not asked for longer than these keeps the newest


class LiveFace:
    """Takes motion (58,) with its `time.monotonic` time; gives sightings with the person's rest taken off.

    Several faces between two questions become one, the newest, with the strongest blink of all: none falls between
    frames. Not thread-safe.

    signs: (6,) factors of the pose channels.
    """

    def __init__(self, signs: Floats) -> None:
        self._signs = signs
        self._neutral: neutral.Neutral | None = None
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
            self._sighting = Sighting(self._face(seen_s, motion), place_m=place_m)
        return self._sighting

    def _face(self, seen_s: float, motion: Floats) -> FaceFrame:
        motion[POSE] *= self._signs
        # Learned in monotonic time: a start does not tear it apart.
        motion, self._neutral = neutral.step(motion, seen_s, self._neutral)
        return FaceFrame.of(seen_s - self._origin_s, motion)
