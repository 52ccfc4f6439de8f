"""A live voice on the grid of the loop: pieces of a sound card, or of a sender, in; frames of 640 samples out.

Sound cards drift: 100 ppm are 0.36 s an hour. So each piece comes with the time of its newest sample, `drift` tells
from them where every sample lies, and a resampler of variable rate (soxr) follows: its ratio is the card's true rate,
and a little more or less where its output is ahead or behind, 1 % at most. Nothing is cut out or put in but for three
cases:

1. The device was away: `GAP_S` and more are missing. The frames of that time are missing too, and the stretch after it
   is placed anew.
2. A stretch of less than `SETTLE_S`, of which little is known yet, is placed again where it is `UNSETTLED_S` off.
3. The place is off by more than `GAP_S`: pieces that were held up came all at once.

soxr 1.0, which some packages pin, has no variable rate: a stream keeps the true rate known when it was placed, and is
placed again where it is `UNSETTLED_S` off.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, Floats
from sfms_robot.signals.audio import HIGHEST_RATE_HZ, LOWEST_RATE_HZ
from sfms_robot.sources.drift import SampleClock

GAP_S: Final = 0.15
SETTLE_S: Final = 1.0
UNSETTLED_S: Final = 0.01
PULL_S: Final = 1.0  # time constant of a correction
LARGEST_PULL: Final = 0.01  # of the rate: a sixth of a semitone
KEPT_FRAMES: Final = 50  # at most, ahead of the one that is asked for
_LATENCY_FALLS_S: Final = 1e-4  # a frame, so that a bad second is forgotten in a minute
_NONE: Final = np.zeros(0, dtype=np.float32)


class LiveVoice:
    """`ports.Voice` of a live stream. All methods may be called from any thread; none blocks for longer than a piece
    takes to be resampled.
    """

    duration_s: float | None = None
    lost: bool = False

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._origin_s: float | None = None
        self._rate_hz = 0.0
        self._clock: SampleClock | None = None  # None: the next piece begins a stretch
        self._skew = 0.0  # of the card, kept over its gaps
        self._received = 0  # samples of the stretch
        self._settled_s = 0.0  # when enough is known of the stretch
        self._stream: Any = None  # None: the next piece is placed
        self._ratio = 1.0  # samples of the card to one of the loop
        self._varies = True  # soxr follows the ratio, from 1.1 on
        self._position = 0.0  # samples of the stretch that went into what came out of the stream
        self._next = 0  # sample of the loop, at 16 kHz, that the stream gives next
        self._frames: dict[int, Floats] = {}
        self._wanted = 0  # frame
        self._latency_s = 0.0
        self._counts = {"gaps": 0, "late_samples": 0, "not_finite": 0}

    @property
    def latency_s(self) -> float:
        """The longest from the end of a frame to the piece that made it whole, lately."""
        return self._latency_s

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`. Pieces that came before taught the clock, and are dropped."""
        with self._lock:
            self._origin_s, self._stream, self._next, self._wanted = origin_s, None, 0, 0
            self._frames.clear()

    def push(
        self, samples: NDArray[np.float32], rate_hz: float, captured_s: float, arrived_s: float | None = None
    ) -> None:
        """The next piece, (n,) or (n, channels), full scale 1.

        Args:
            captured_s: `time.monotonic` of its newest sample; may be late by some tens of milliseconds, never early.
            arrived_s: when it is pushed, for the latency, where that is another time.

        What is not finite counts as silence. Raises ConfigError for a rate outside 4 to 384 kHz.
        """
        check_rate(rate_hz)
        mono, not_finite = _mono(samples)
        if not len(mono):
            return
        with self._lock:
            self._counts["not_finite"] += not_finite
            self._observe(len(mono), rate_hz, captured_s)
            if self._origin_s is not None:
                self._resample(mono, captured_s, captured_s if arrived_s is None else arrived_s)

    def take(self, index: int) -> Floats | None:
        """See `ports.Voice`. A frame of which only a part was heard is filled up with silence."""
        with self._lock:
            self._wanted = index
            for old in [each for each in self._frames if each < index]:
                del self._frames[old]
            whole = self._next >= (index + 1) * FRAME_SAMPLES
            return self._frames.pop(index, None) if whole else None

    def statistics(self) -> Mapping[str, Any]:
        """Drift of the card, gaps, samples that came too late or were not finite, and the latency."""
        with self._lock:
            drift_ppm = None if self._clock is None else round(self._clock.drift_ppm, 1)
            return {
                "rate_hz": self._rate_hz, "drift_ppm": drift_ppm, "latency_ms": round(self._latency_s * 1e3, 1),
                **self._counts,
            }  # fmt: skip

    def close(self) -> None:
        """Nothing is held open."""

    def interrupt(self) -> None:
        """The next piece does not follow the last one."""
        with self._lock:
            self._end_stretch()

    def _observe(self, n: int, rate_hz: float, captured_s: float) -> None:
        """Learn from a piece; it begins a stretch when it cannot follow the last one."""
        if rate_hz != self._rate_hz:
            self._end_stretch()
        elif self._clock is not None and self._clock.lateness_s(self._received + n, captured_s) > GAP_S:
            self._counts["gaps"] += 1
            self._end_stretch()
        if self._clock is None:
            self._clock = SampleClock(rate_hz, self._skew if rate_hz == self._rate_hz else 0.0)
            self._rate_hz, self._received, self._settled_s = rate_hz, 0, captured_s + SETTLE_S
        self._received += n
        self._clock.observe(self._received, captured_s)
        self._skew = self._clock.skew

    def _resample(self, samples: Floats, captured_s: float, arrived_s: float) -> None:
        first = self._received - len(samples)
        settled = captured_s > self._settled_s
        most_s = GAP_S if settled and self._varies else UNSETTLED_S
        if self._stream is not None and abs(self._behind()) > most_s * self._rate_hz:
            self._end_stream()
        if self._stream is None:
            samples = self._place(samples, first)
            if not len(samples):
                return
        assert self._clock is not None
        if self._varies:
            pull = min(max(self._behind() / (PULL_S * self._rate_hz), -LARGEST_PULL), LARGEST_PULL)
            self._ratio = self._clock.rate_hz / AUDIO_HZ * (1.0 + pull)
            self._stream.set_io_ratio(self._ratio, 1.0)
        out = self._stream.resample_chunk(samples)
        self._position += self._ratio * len(out)
        self._write(out, arrived_s)

    def _behind(self) -> float:
        """By how many samples of the card the stream is behind its place."""
        assert self._clock is not None and self._origin_s is not None
        return self._clock.count_at(self._origin_s + self._next / AUDIO_HZ) - self._position

    def _place(self, samples: Floats, first: int) -> Floats:
        """Begin a stream at the first of these samples that is not in the past; returns what is left of them."""
        import soxr

        assert self._clock is not None and self._origin_s is not None
        at = (self._clock.time_s(first) - self._origin_s) * AUDIO_HZ
        past = min(len(samples), max(0, math.ceil((self._next - at) * self._rate_hz / AUDIO_HZ)))
        self._counts["late_samples"] += past
        if past < len(samples):
            self._next = max(self._next, round(at + past * AUDIO_HZ / self._rate_hz))
            self._position = first + past
            self._ratio = self._clock.rate_hz / AUDIO_HZ
            self._varies = hasattr(soxr.ResampleStream, "set_io_ratio")
            highest_hz = self._rate_hz * (1.0 + 2 * LARGEST_PULL) if self._varies else self._clock.rate_hz
            more = {"vr": True} if self._varies else {}
            self._stream = soxr.ResampleStream(highest_hz, AUDIO_HZ, 1, dtype="float32", quality="HQ", **more)
        return samples[past:]

    def _end_stretch(self) -> None:
        self._end_stream()
        self._clock = None

    def _end_stream(self) -> None:
        if self._stream is not None:
            self._write(self._stream.resample_chunk(_NONE, last=True), None)
            self._stream = None

    def _write(self, samples: Floats, arrived_s: float | None) -> None:
        """Lay samples into their frames. `arrived_s`: None for what a resampler still held."""
        while len(samples):
            index, within = divmod(self._next, FRAME_SAMPLES)
            part, samples = samples[: FRAME_SAMPLES - within], samples[FRAME_SAMPLES - within :]
            self._next += len(part)
            if index < self._wanted or index >= self._wanted + KEPT_FRAMES:
                self._counts["late_samples"] += len(part)
            else:
                frame = self._frames.setdefault(index, np.zeros(FRAME_SAMPLES, dtype=np.float32))
                frame[within : within + len(part)] = np.clip(part, -1.0, 1.0)
            if arrived_s is not None and within + len(part) == FRAME_SAMPLES:
                self._measure((index + 1) * FRAME_S, arrived_s)

    def _measure(self, end_s: float, arrived_s: float) -> None:
        assert self._origin_s is not None
        late_s = float(arrived_s) - self._origin_s - end_s
        self._latency_s = max(late_s, self._latency_s - _LATENCY_FALLS_S, 0.0)


def check_rate(rate_hz: float) -> None:
    """Raises ConfigError for what is no rate of speech."""
    if not LOWEST_RATE_HZ <= rate_hz <= HIGHEST_RATE_HZ:
        raise ConfigError(f"rate_hz = {rate_hz!r} is no rate for speech ({LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ})")


def _mono(samples: NDArray[np.float32]) -> tuple[Floats, int]:
    """Channels averaged, and how many of the samples are not finite."""
    finite = np.isfinite(samples)
    not_finite = samples.size - int(np.count_nonzero(finite))
    if not_finite:
        samples = np.where(finite, samples, np.float32(0))
    mixed = samples.mean(axis=1, dtype=np.float64) if samples.ndim > 1 else samples
    return np.ascontiguousarray(np.clip(mixed, -1.0, 1.0), dtype=np.float32), not_finite
