"""A person's sound and faces, and the robot's own speech, passed in by calls from any thread.

A call without a time stamp counts from the moment it arrives: a piece of sound begins then, and the next pieces follow
it. This delays the sound by the length of the longest piece, or, if pieces come in bursts, by the longest wait between
two bursts.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError, InputError
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, MOTION_DIM, NO_SOUND, SILENCE, FaceFrame, Floats, Reals, Sighting
from sfms_robot.ports import Facts, Voice
from sfms_robot.signals.audio import Downmix, Resampler, check_scale, finite
from sfms_robot.signals.face_units import beyond, motion_of
from sfms_robot.sources.live_voice import Clock, LiveVoice, Pace, SourcePart, check_rate, window

Pcm = bytes | Reals | NDArray[np.int16]

HEARD_S: Final = 1.0  # a listener cannot use a person's voice that is older than this
SAID_S: Final = 120.0  # speech that may wait: it is synthesized faster than it is spoken, a sentence at once
SIGHTINGS: Final = 64  # sightings kept: more than a camera delivers between two ticks
_JOIN: Final = round(0.02 * AUDIO_HZ)
_MOST_CHANNELS: Final = 32


class Player(Protocol):
    """A player of speech. All methods may be called from any thread; none waits for a device.

    Attributes:
        delay_s: from the time of a sample of speech until it leaves the loudspeaker.
    """

    delay_s: float

    def said(self) -> None:
        """Note that there is new speech to play."""

    def hushed(self) -> None:
        """Note that the speech ends now."""


class Spoken(Voice, Protocol):
    """A voice that can be played."""

    def upcoming(self, index: int) -> Floats | None:
        """Return the samples (640,) known so far of frame `index`, not taken yet; they may change until it is taken."""

    def played_by(self, player: Player) -> None:
        """Report every change to `player` at once, from now on."""


class PushedVoice(LiveVoice):
    """A `ports.Voice` of sound that a program passes to `hear`.

    Attributes:
        pace: pace at which the sound arrives; a fault of it is logged once.
    """

    _way = "hear()"  # in logs

    def __init__(self, now: Clock = time.monotonic) -> None:
        super().__init__(now)
        self._pushing = threading.Lock()
        self._longest_s = 0.0  # delay of the sound: the longest piece, or wait between bursts
        self._last_s = 0.0
        self._dropped = 0
        self.pace = Pace()

    def hear(self, pcm: Pcm, rate_hz: float, captured_s: float | None = None) -> None:
        """Add the next piece, float of full scale 1 or int16: (n,), (n, channels) or (channels, n); or bytes of mono.

        Of a piece longer than a second the newest second is kept. `captured_s`: `time.monotonic` of its newest sample;
        None: it begins at this call. Never blocks. Raises ConfigError for another rate, type, shape or scale.
        """
        check_rate(rate_hz)
        samples = as_floats(pcm)
        kept = samples[-int(HEARD_S * rate_hz) :]
        with self._pushing:
            self._dropped += len(samples) - len(kept)
            now_s, piece_s = self._now(), len(kept) / rate_hz
            if len(samples):
                self.pace.observe(len(samples) / rate_hz, now_s)
            self._uneven_s = min(self.pace.apart_s, HEARD_S)
            if captured_s is None:
                if now_s - self._last_s > self._longest_s + HEARD_S:
                    self._longest_s = 0.0
                if (needed_s := max(piece_s, self._uneven_s)) > self._longest_s:
                    self._longest_s = needed_s
                    self.interrupt()
                self._last_s = now_s
                captured_s = now_s + self._longest_s
            self.push(kept, rate_hz, captured_s, now_s)
        self.pace.warn_once(self._way)

    def statistics(self) -> Facts:
        return {
            **super().statistics(),
            "dropped": self._dropped,
            "delay_ms": round(self._longest_s * 1e3, 1),
            "pace": None if self.pace.rate is None else round(self.pace.rate, 3),
        }


class PushedSight(SourcePart):
    """A `ports.Sight` of faces that a program passes to `see`."""

    def __init__(self, now: Clock = time.monotonic) -> None:
        super().__init__(now)
        self._seen = deque[tuple[float, Sighting | None]](maxlen=SIGHTINGS)  # seconds of `now`

    def see(
        self,
        face: FaceFrame | Reals | Mapping[str, float] | None,
        seen_s: float | None = None,
        attention: float | None = None,
    ) -> None:
        """Set the person's face: a `FaceFrame`, (58,) motion or channels by name; None: it is lost. Never blocks.

        Args:
            seen_s: `time.monotonic` when it was seen, no earlier than that of the last call; None: now.
            attention: see `Sighting`.

        Raises ConfigError for another shape, an unknown channel, or a value beyond what a head can do.
        """
        if isinstance(face, Mapping):
            face = motion_of(face)
        if face is not None and not isinstance(face, FaceFrame):
            if np.shape(face) != (MOTION_DIM,):
                raise ConfigError(f"face has the shape {np.shape(face)}, not ({MOTION_DIM},): pose 6, blendshapes 52")
            face = FaceFrame.of(0.0, face)
        if face is not None and (problem := beyond(face.motion)):
            raise InputError(f"face: {problem}")
        with self._lock:
            at_s = self._now() if seen_s is None else seen_s
            self._seen.append((at_s, None if face is None else Sighting(face, attention)))

    def at(self, time_s: float) -> Sighting | None:
        """Return the newest sighting, see `ports.Sight`; None also from the time on at which the face was lost."""
        with self._lock:
            for seen_s, sighting in reversed(self._seen):
                if seen_s - self._origin_s <= time_s:
                    return sighting and replace(sighting, face=replace(sighting.face, time_s=seen_s - self._origin_s))
        return None


class PushedSpeech(SourcePart):
    """A `ports.Voice` of the robot's speech, with each sample at the time at which it is played.

    Speech is synthesized faster than it is spoken, so two minutes of it may wait. `take` returns None until the first
    speech, and silence in later pauses. All methods may be called from any thread; `take` waits for none of them.
    """

    def __init__(self, now: Clock = time.monotonic) -> None:
        super().__init__(now)
        self._saying = threading.Lock()  # for `say` and `hush`: guards the stretch that is resampled
        self._rate_hz = float(AUDIO_HZ)
        self._mix = Downmix()
        self._resampler: Resampler | None = None  # None: the next piece begins a stretch
        self._given = 0  # samples of the stretch, at its rate
        self._began = 0  # begin of the stretch, in samples of 16 kHz since 0 of `now`, as all places
        self._place = 0  # place of the next sample that the resampler returns
        # Pieces to be played; `_lock` is held only for operations on this list.
        self._pieces = deque[tuple[int, Floats]]()
        self._origin = 0
        self._taken = 0  # end of the last frame that was taken
        self._speaks = False
        self._counts = {"dropped": 0, "late": 0, "not_finite": 0}
        self._player: Player | None = None

    def say(self, pcm: Pcm, rate_hz: float, at_s: float | None = None) -> None:
        """Add a piece of speech, in the formats of `PushedVoice.hear`.

        Args:
            at_s: `time.monotonic` when its first sample is played; speech that was to be played from then on is
                replaced. None: after the speech that still waits, or one frame (40 ms) after this call.

        A piece that begins within 20 ms of the end of the last one follows it. Samples that come after their time, and
        samples to be played in more than two minutes, are left out and counted.
        """
        check_rate(rate_hz)
        if at_s is not None and not np.isfinite(at_s):
            raise ConfigError(f"at_s = {at_s!r}: expected a finite time")
        samples, not_finite = finite(as_floats(pcm))
        if at_s is not None and self._player is not None:
            at_s -= self._player.delay_s
        soonest = _place(self._now()) + FRAME_SAMPLES
        with self._saying:
            at = max(soonest, self._end) if at_s is None else _place(at_s)
            if abs(at - self._end) <= _JOIN:
                at = self._end
            if self._resampler is None or rate_hz != self._rate_hz or at != self._end:
                self._begin(at, rate_hz)
            assert self._resampler is not None
            self._given += len(samples)
            self._counts["not_finite"] += not_finite
            self._append(self._resampler.push(np.clip(samples, -1.0, 1.0)))
        if self._player is not None:
            self._player.said()

    def hush(self) -> None:
        """Drop all speech that is not yet played."""
        with self._saying:
            self._resampler, self._began, self._given = None, _place(self._now()), 0
            self._cut(self._began)
        if self._player is not None:
            self._player.hushed()

    def played_by(self, player: Player) -> None:
        """Play the speech on `player`: at `at_s` it leaves the loudspeaker; without `at_s`, as soon as possible."""
        self._player = player

    def start(self, origin_s: float) -> None:
        with self._lock:
            self._origin = _place(origin_s)

    def take(self, index: int) -> Floats | None:
        """Return the samples (640,) that are played in frame `index`; silence where there is no speech."""
        begin = self._origin + index * FRAME_SAMPLES
        if self._saying.acquire(blocking=False):  # else another thread is adding speech
            try:
                if self._resampler is not None and self._place < min(begin + FRAME_SAMPLES, self._end):
                    self._finish()  # no further piece can come in time
            finally:
                self._saying.release()
        with self._lock:
            if not self._speaks:
                return None
            while self._pieces and self._pieces[0][0] + len(self._pieces[0][1]) <= begin:
                self._pieces.popleft()
            self._taken = begin + FRAME_SAMPLES
            return self._frame(begin)

    def upcoming(self, index: int) -> Floats | None:
        """Return the samples (640,) known so far of a frame; see `Spoken`."""
        with self._lock:
            return self._frame(self._origin + index * FRAME_SAMPLES) if self._speaks else None

    def statistics(self) -> Facts:
        """Return counts of samples: to be played in more than two minutes (dropped), too late to play, not finite."""
        with self._lock:
            return dict(self._counts)

    @property
    def _end(self) -> int:
        """End of the stretch, including samples that its resampler still holds."""
        return self._began + round(self._given * AUDIO_HZ / self._rate_hz)

    def _frame(self, begin: int) -> Floats:
        """Return the samples (640,) from place `begin` on."""
        frame = SILENCE.copy()
        for place, piece in self._pieces:
            if place >= begin + FRAME_SAMPLES:
                break
            frame += window(place, piece, begin)
        return frame

    def _begin(self, at: int, rate_hz: float) -> None:
        self._finish()
        self._cut(at)
        self._rate_hz, self._resampler, self._given = rate_hz, Resampler(rate_hz, self._mix), 0
        self._began = self._place = at

    def _finish(self) -> None:
        """End the stretch and append the samples that the resampler still holds."""
        if self._resampler is not None:
            end = self._end
            self._append(self._resampler.push(NO_SOUND, last=True))
            self._resampler, self._began, self._given = None, end, 0

    def _cut(self, at: int) -> None:
        """Drop the samples to be played from `at` on."""
        with self._lock:
            while self._pieces and self._pieces[-1][0] + len(self._pieces[-1][1]) > at:
                place, piece = self._pieces.pop()
                if place < at:
                    self._pieces.append((place, piece[: at - place]))

    def _append(self, samples: Floats) -> None:
        kept = samples[: max(0, _place(self._now() + SAID_S) - self._place)]
        with self._lock:
            self._speaks = True
            self._counts["dropped"] += len(samples) - len(kept)
            self._counts["late"] += min(len(kept), max(0, self._taken - self._place))
            if len(kept):
                self._pieces.append((self._place, kept))
        self._place += len(samples)


def _place(time_s: float) -> int:
    return round(time_s * AUDIO_HZ)


def as_floats(pcm: Pcm) -> Floats:
    """Return sound as (n,) or (n, channels) with full scale 1; the smaller axis is that of channels.

    Raises ConfigError for another type, shape or scale.
    """
    if isinstance(pcm, bytes | bytearray | memoryview):
        if len(pcm) % 2:
            raise ConfigError(f"pcm: expected 16-bit samples, got {len(pcm)} bytes")
        pcm = np.frombuffer(pcm, dtype="<i2")
    samples = np.asarray(pcm)
    if samples.ndim not in (1, 2) or (samples.dtype != np.int16 and samples.dtype.kind != "f"):
        problem = "not float or int16 of (n,), (n, channels) or (channels, n)"
        raise ConfigError(f"pcm is {samples.dtype} of shape {samples.shape}, {problem}")
    if not samples.size:
        return NO_SOUND
    if samples.ndim == 2:
        channels, n = sorted(samples.shape)
        if channels > _MOST_CHANNELS or 1 < channels == n:
            problem = f"expected (n, channels) or (channels, n), at most {_MOST_CHANNELS} channels and more samples"
            raise ConfigError(f"pcm of shape {samples.shape}: {problem}")
        samples = samples.T if samples.shape[0] == channels else samples
    if samples.dtype == np.int16:
        return samples.astype(np.float32) / np.float32(32768)
    check_scale("pcm", samples)
    return samples.astype(np.float32)
