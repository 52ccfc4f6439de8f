"""A person who is handed over by calls, from any thread: sound, faces, and what the robot itself says.

A call brings no time of its own, so sound counts from the moment it comes: a piece is played out from then on, and the
next ones follow it. Where pieces are long, or come unevenly, that leaves room for the longest of them.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, MOTION_DIM, FaceFrame, Floats, Sighting
from sfms_robot.signals.audio import Resampler
from sfms_robot.sources.live_voice import LiveVoice, check_rate

Pcm = bytes | NDArray[np.floating] | NDArray[np.int16]

HEARD_S: Final = 1.0  # a person's voice that is older than this is no use to a listener
SAID_S: Final = 120.0  # speech is synthesized faster than it is spoken, a sentence at once
SIGHTINGS: Final = 64  # kept: more than a camera sees until they are asked for
_NONE: Final = np.zeros(0, dtype=np.float32)


class PushedVoice(LiveVoice):
    """`ports.Voice` of what a program hears."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now = now
        self._pushing = threading.Lock()
        self._longest_s = 0.0  # piece
        self._last_s = 0.0
        self._dropped = 0

    def hear(self, pcm: Pcm, rate_hz: float) -> None:
        """The next piece: (n,) or (n, channels), float of full scale 1 or int16; or bytes of 16-bit mono.

        Of one that is longer than a second the newest is kept. Never blocks. Raises ConfigError for another rate, type
        or shape.
        """
        check_rate(rate_hz)
        samples = as_floats(pcm)
        kept = samples[-int(HEARD_S * rate_hz) :]
        with self._pushing:
            self._dropped += len(samples) - len(kept)
            now_s, piece_s = self._now(), len(kept) / rate_hz
            if now_s - self._last_s > self._longest_s + HEARD_S:
                self._longest_s = 0.0
            if piece_s > self._longest_s:
                self._longest_s = piece_s
                self.interrupt()
            self._last_s = now_s
            self.push(kept, rate_hz, now_s + self._longest_s, now_s)

    def statistics(self) -> Mapping[str, Any]:
        return {**super().statistics(), "dropped": self._dropped, "delay_ms": round(self._longest_s * 1e3, 1)}


class PushedSight:
    """`ports.Sight` of what a program sees."""

    lost = False  # what is not pushed is not there
    duration_s: float | None = None
    latency_s = 0.0

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._origin_s = 0.0
        self._seen: deque[tuple[float, Sighting | None]] = deque(maxlen=SIGHTINGS)  # seconds of `now`

    def see(self, face: FaceFrame | NDArray[np.floating] | None) -> None:
        """The person's face now, as a `FaceFrame` or (58,) motion; None: it is lost. Never blocks.

        Raises ConfigError for another shape.
        """
        if face is not None and not isinstance(face, FaceFrame):
            if np.shape(face) != (MOTION_DIM,):
                raise ConfigError(f"face has the shape {np.shape(face)}, not ({MOTION_DIM},): pose 6, blendshapes 52")
            face = FaceFrame.of(0.0, face)
        with self._lock:
            self._seen.append((self._now(), None if face is None else Sighting(face)))

    def start(self, origin_s: float) -> None:
        with self._lock:
            self._origin_s = origin_s

    def at(self, time_s: float) -> Sighting | None:
        """See `ports.Sight`; None also from the moment on in which the face was lost."""
        with self._lock:
            for seen_s, sighting in reversed(self._seen):
                if seen_s - self._origin_s <= time_s:
                    return sighting and replace(sighting, face=replace(sighting.face, time_s=seen_s - self._origin_s))
        return None

    def statistics(self) -> Mapping[str, Any]:
        return {}

    def close(self) -> None:
        """Nothing is held open."""


class PushedSpeech:
    """`ports.Voice` of what the robot says: a queue, for speech is synthesized faster than it is spoken.

    Nothing until it has said something, silence after that. All methods may be called from any thread.
    """

    lost = False  # what is not pushed is not there
    duration_s: float | None = None
    latency_s = 0.0

    def __init__(self, longest_s: float = SAID_S) -> None:
        self._lock = threading.Lock()
        self._longest = int(longest_s * AUDIO_HZ)
        self._rate_hz = float(AUDIO_HZ)
        self._resampler = Resampler(self._rate_hz)
        self._waiting: Floats = _NONE
        self._speaks = False
        self._counts = {"dropped": 0, "not_finite": 0}

    def say(self, pcm: Pcm, rate_hz: float) -> None:
        """What it says from the next frame on, as `PushedVoice.hear`; play it one frame (40 ms) after this call.

        A sentence may come in pieces; stay ahead of what is played, or there is a gap. Of more than two minutes that
        wait the oldest are dropped.
        """
        check_rate(rate_hz)
        samples = as_floats(pcm)
        finite = np.isfinite(samples)
        with self._lock:
            self._counts["not_finite"] += int(samples.size - finite.sum())
            if rate_hz != self._rate_hz:
                self._finish()
                self._rate_hz, self._resampler = rate_hz, Resampler(rate_hz)
            self._speaks = True
            self._append(self._resampler.push(np.clip(np.where(finite, samples, np.float32(0)), -1.0, 1.0)))

    def start(self, origin_s: float) -> None:
        """It is played from when the loop asks for it."""

    def take(self, index: int) -> Floats | None:
        """The next (640,), whatever the index; the end of a sentence is filled up with silence."""
        with self._lock:
            if not self._speaks:
                return None
            if len(self._waiting) < FRAME_SAMPLES:
                self._finish()  # who plays it has no more either
            frame = np.zeros(FRAME_SAMPLES, dtype=np.float32)
            part, self._waiting = self._waiting[:FRAME_SAMPLES], self._waiting[FRAME_SAMPLES:]
            frame[: len(part)] = part
            return frame

    def statistics(self) -> Mapping[str, Any]:
        """Samples dropped because too many waited, and those that were not finite."""
        with self._lock:
            return dict(self._counts)

    def close(self) -> None:
        """Nothing is held open."""

    def _finish(self) -> None:
        """What was said so far is a whole: let out what the resampler still holds."""
        self._append(self._resampler.push(_NONE, last=True))
        self._resampler = Resampler(self._rate_hz)

    def _append(self, samples: Floats) -> None:
        waiting = np.concatenate([self._waiting, samples])
        self._counts["dropped"] += max(0, len(waiting) - self._longest)
        self._waiting = waiting[-self._longest :]


def as_floats(pcm: Pcm) -> NDArray[np.float32]:
    """(n,) or (n, channels), full scale 1. Raises ConfigError for another type or shape."""
    if isinstance(pcm, bytes | bytearray | memoryview):
        if len(pcm) % 2:
            raise ConfigError(f"pcm of {len(pcm)} bytes is not of 16-bit samples")
        pcm = np.frombuffer(pcm, dtype="<i2")
    samples = np.asarray(pcm)
    if samples.ndim not in (1, 2) or (samples.dtype != np.int16 and samples.dtype.kind != "f"):
        problem = "not float or int16 of (n,) or (n, channels)"
        raise ConfigError(f"pcm is {samples.dtype} of shape {samples.shape}, {problem}")
    if samples.dtype == np.int16:
        return samples.astype(np.float32) / np.float32(32768)
    with np.errstate(over="ignore"):  # what is too large for 32 bits becomes infinite, and is judged as that
        return samples.astype(np.float32)


def open_pushed_voice(argument: str) -> PushedVoice:
    """`--audio push`; it takes no argument."""
    return PushedVoice()


def open_pushed_sight(argument: str) -> PushedSight:
    """`--face push`; it takes no argument."""
    return PushedSight()
