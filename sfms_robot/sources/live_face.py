"""From the faces of a tracker, as they arrive, to `Sighting`s in loop time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, POSE, FaceFrame, Floats, Sighting
from sfms_robot.sources import neutral

# Does a person look at the head? (face, state or None) -> (0..1 or None where that cannot be told, state).
Attention = Callable[[FaceFrame, Any], tuple[float | None, Any]]

_BLINKS: Final = [CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"]]
_WAITING: Final = 256  # faces; who is not asked for longer than these keeps the newest


class LiveFace:
    """Takes motion (58,) with its `time.monotonic` time; gives sightings with the person's rest taken off.

    Several faces between two questions become one, the newest, with the strongest blink of all: none falls between
    frames. Not thread-safe.

    Args:
        signs: (6,) factors of the pose channels.
        attention: fills `Sighting.attention`; without it that stays None.
    """

    def __init__(self, signs: Floats, attention: Attention | None = None) -> None:
        self._signs = signs
        self._attention = attention
        self._attention_state: Any = None
        self._neutral: neutral.Neutral | None = None
        self._waiting: deque[tuple[float, Floats]] = deque(maxlen=_WAITING)
        self._sighting: Sighting | None = None
        self._origin_s = 0.0

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`. What was learned of the person stays."""
        self._origin_s, self._sighting = origin_s, None

    def forget(self) -> None:
        """Another camera, or another person: what was learned of the last one does not hold."""
        self._neutral, self._attention_state = None, None

    def put(self, time_s: float, motion: Floats) -> None:
        """A face (58,) of `time_s` of `time.monotonic`, in order of time."""
        self._waiting.append((time_s, motion))

    def at(self, time_s: float) -> Sighting | None:
        """See `ports.Sight.at`."""
        seen = []
        while self._waiting and self._waiting[0][0] - self._origin_s <= time_s:
            seen.append(self._waiting.popleft())
        if seen:
            motion = seen[-1][1].copy()
            motion[_BLINKS] = np.max([each[_BLINKS] for _, each in seen], axis=0)
            self._sighting = self._seen(seen[-1][0] - self._origin_s, motion)
        return self._sighting

    def _seen(self, time_s: float, motion: Floats) -> Sighting:
        motion[POSE] *= self._signs
        # Learned in monotonic time: a start does not tear it apart.
        motion, self._neutral = neutral.step(motion, time_s + self._origin_s, self._neutral)
        face = FaceFrame.of(time_s, motion)
        if self._attention is None:
            return Sighting(face)
        attention, self._attention_state = self._attention(face, self._attention_state)
        return Sighting(face, attention)
