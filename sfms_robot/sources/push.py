"""A source that is fed from outside: sound and faces by calls, from any thread, at any rate.

What comes in is resampled to 16 kHz as it comes and waits in a queue; every 40 ms a frame takes its 640 samples, or is
empty where they are not there yet. So the grid never slips, however uneven the calls are. What has waited longest is
dropped where the caller is faster than time for long.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_SAMPLES, MOTION_DIM, FaceFrame, Floats, SpeakerFrame
from sfms_robot.signals.audio import HIGHEST_RATE_HZ, LOWEST_RATE_HZ, Resampler

Pcm = bytes | NDArray[np.floating] | NDArray[np.int16]

HEARD_S: Final = 1.0  # a person's voice that is older than this is no use to a listener
SAID_S: Final = 120.0  # speech is synthesized faster than it is spoken, a sentence at once
FACE_S: Final = 0.25  # a face that is older counts as lost
PATIENCE_FRAMES: Final = 25  # a voice may come in pieces of up to a second; after so long without any it has ended
_EPS_FRAMES: Final = 1e-6
_NONE: Final = np.zeros(0, dtype=np.float32)


class PcmQueue:
    """Sound of any rate in, frames of 640 samples at 16 kHz out. Not thread-safe.

    Attributes:
        dropped: samples that were thrown away because more than `longest_s` waited.
        not_finite: samples that came in as NaN or infinite, and count as silence.
    """

    def __init__(self, longest_s: float, patience_frames: int) -> None:
        """`patience_frames`: so many frames find nothing before what was pushed counts as a whole."""
        self.dropped = 0
        self.not_finite = 0
        self._longest = int(longest_s * AUDIO_HZ)
        self._patience_frames = patience_frames
        self._rate_hz = float(AUDIO_HZ)
        self._resampler = Resampler(self._rate_hz)
        self._waiting: Floats = _NONE
        self._fed = False
        self._starved = 0  # frames since the last push for which nothing was there

    def push(self, pcm: Pcm, rate_hz: float) -> None:
        """(n,) or (n, channels): float of full scale 1, int16, or bytes of 16-bit little-endian mono.

        Raises ConfigError for another rate, type or shape.
        """
        if not LOWEST_RATE_HZ <= rate_hz <= HIGHEST_RATE_HZ:
            raise ConfigError(f"rate_hz = {rate_hz!r} is no rate for speech ({LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ})")
        samples = _as_floats(pcm)
        finite = np.isfinite(samples)
        if not finite.all():
            self.not_finite += int(samples.size - finite.sum())
            samples = np.where(finite, samples, np.float32(0))
        if rate_hz != self._rate_hz:
            self._finish()
            self._rate_hz, self._resampler = rate_hz, Resampler(rate_hz)
        self._fed, self._starved = True, 0
        self._append(self._resampler.push(np.clip(samples, -1.0, 1.0)))

    def take(self) -> Floats | None:
        """The next (640,), or None where fewer wait. The last of a whole is filled up with silence."""
        if len(self._waiting) < FRAME_SAMPLES:
            self._starved += 1
            if self._starved < self._patience_frames:
                return None
            self._finish()
            if not len(self._waiting):
                return None
        frame = np.zeros(FRAME_SAMPLES, dtype=np.float32)
        part, self._waiting = self._waiting[:FRAME_SAMPLES], self._waiting[FRAME_SAMPLES:]
        frame[: len(part)] = part
        return frame

    def _finish(self) -> None:
        """What was pushed so far is a whole: let out what the resampler still holds."""
        if self._fed:
            self._append(self._resampler.push(_NONE, last=True))
            self._resampler, self._fed = Resampler(self._rate_hz), False

    def _append(self, samples: Floats) -> None:
        waiting = np.concatenate([self._waiting, samples])
        self.dropped += max(0, len(waiting) - self._longest)
        self._waiting = waiting[-self._longest :]


class PushSource:
    """`ports.Source` whose voice, face and robot's voice are pushed into it. All methods may be called from any thread.

    Args:
        duration_s: length of the run; None: until somebody ends it.
        heard_s, said_s: most sound that waits of the person, and of the robot.
    """

    def __init__(self, duration_s: float | None = None, heard_s: float = HEARD_S, said_s: float = SAID_S) -> None:
        self._duration_s = duration_s
        self._lock = threading.Lock()
        self._heard = PcmQueue(heard_s, PATIENCE_FRAMES)
        self._said = PcmQueue(said_s, 1)  # who plays it has no more either
        self._face: FaceFrame | None = None
        self._face_at_s: float | None = None  # None: pushed since the last read, which tells its time
        self._speaks = False
        self._given = 0

    @property
    def duration_s(self) -> float | None:
        return self._duration_s

    def hear(self, pcm: Pcm, rate_hz: float) -> None:
        """What the person says. Never blocks; raises ConfigError as `PcmQueue.push` does."""
        with self._lock:
            self._heard.push(pcm, rate_hz)

    def say(self, pcm: Pcm, rate_hz: float) -> None:
        """What the robot says, from the next frame on; play it one frame (40 ms) after it is pushed.

        A sentence may come in pieces; stay ahead of what is played, or there is a gap.
        """
        with self._lock:
            self._said.push(pcm, rate_hz)
            self._speaks = True

    def see(self, face: FaceFrame | NDArray[np.floating] | None) -> None:
        """The person's face now, as a `FaceFrame` or (58,) motion; None: it is lost. It holds for 250 ms.

        Raises ConfigError for another shape.
        """
        if face is not None and not isinstance(face, FaceFrame):
            if np.shape(face) != (MOTION_DIM,):
                raise ConfigError(f"face has the shape {np.shape(face)}, not ({MOTION_DIM},): pose 6, blendshapes 52")
            face = FaceFrame.of(0.0, face)
        with self._lock:
            self._face, self._face_at_s = face, None

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        """Frames complete at or before `now_s` and not given yet, oldest first."""
        until_s = now_s if self._duration_s is None else min(now_s, self._duration_s)
        complete = math.floor(until_s * FRAME_HZ + _EPS_FRAMES)
        with self._lock:
            return [self._frame(now_s) for _ in range(self._given, complete)]

    def close(self) -> None:
        """Nothing is held open."""

    def statistics(self) -> dict[str, int]:
        """Samples dropped because too many waited, and those that were not finite."""
        with self._lock:
            both = (self._heard, self._said)
            return {"dropped": sum(q.dropped for q in both), "not_finite": sum(q.not_finite for q in both)}

    def _frame(self, now_s: float) -> SpeakerFrame:
        self._given += 1
        time_s = self._given / FRAME_HZ
        heard, says = self._heard.take(), self._said.take()
        if says is None and self._speaks:
            says = np.zeros(FRAME_SAMPLES, dtype=np.float32)
        return SpeakerFrame(time_s, _NONE if heard is None else heard, self._seen(time_s, now_s), says)

    def _seen(self, time_s: float, now_s: float) -> FaceFrame | None:
        if self._face is None:
            return None
        if self._face_at_s is None:
            self._face_at_s = now_s
        if now_s - self._face_at_s > FACE_S:
            return None
        return FaceFrame(time_s, self._face.pose, self._face.blendshapes, self._face.jaw_rad)


def open_push(argument: str, duration_s: float | None) -> PushSource:
    """`--audio push`; it takes no argument."""
    return PushSource(duration_s)


def _as_floats(pcm: Pcm) -> NDArray[np.float32]:
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
