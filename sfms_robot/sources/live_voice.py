"""A live voice on the grid of the loop: converts pieces from a sound card or a sender to frames of 640 samples.

Sound cards drift: 100 ppm are 0.36 s an hour. So each piece comes with the time of its newest sample, `SampleClock`
computes from these times where every sample lies, and a resampler of variable rate (soxr) follows. Its ratio is that of
the card's true rate, changed by at most 1 % when its output is ahead or behind. Samples are cut out or inserted in
three cases only:

1. The device was away: `GAP_S` or more are missing. The frames of that time are missing too, and the stretch of samples
   after the gap is placed on the grid again.
2. A stretch of less than `SETTLE_S`, of which little is known yet, is placed again when it is off by `UNSETTLED_S`.
3. The place is off by more than `GAP_S`: pieces that were held up arrived all at once.

soxr 1.0, which some packages pin, has no variable rate: a stream keeps the true rate known when it was placed, and is
placed again when it is off by `UNSETTLED_S`.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from numbers import Real
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, NO_SOUND, SILENCE, Floats
from sfms_robot.ports import Facts
from sfms_robot.signals.audio import HIGHEST_RATE_HZ, LOWEST_RATE_HZ, Downmix, finite

logger = logging.getLogger(__name__)

GAP_S: Final = 0.15
SETTLE_S: Final = 1.0
UNSETTLED_S: Final = 0.01
PULL_S: Final = 1.0  # time constant of a correction
LARGEST_PULL: Final = 0.01  # largest correction, as a share of the rate: a sixth of a semitone
KEPT_FRAMES: Final = 50  # most frames kept ahead of the requested one
_LATENCY_FALLS_S: Final = 1e-4  # decrease per frame, so that a bad second is forgotten in a minute

BIN_S: Final = 1.0  # of each bin of this length, the least late callback is kept
BINS: Final = 64  # about a minute, so that the line follows a card that warms up
LEAST_SPAN_S: Final = 8.0  # over a shorter span, jitter would affect the estimated rate more than the card does
LOST_S: Final = 0.02  # if the least late callback of a bin is this late, samples were lost
LARGEST_SKEW: Final = 5e-3  # a larger skew means that the nominal rate is wrong


Clock = Callable[[], float]  # in seconds


class SourcePart:
    """Base class of voices and sights (`ports.Voice`, `ports.Sight`), with defaults.

    now: `time.monotonic`, or the clock of a test.
    """

    lost = False
    duration_s: float | None = None
    latency_s = 0.0

    def __init__(self, now: Clock = time.monotonic) -> None:
        self._now, self._lock, self._origin_s = now, threading.Lock(), 0.0

    def start(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`."""
        with self._lock:
            self._origin_s = origin_s

    def statistics(self) -> Facts:
        return {}

    def close(self) -> None:
        """Close all resources. Idempotent."""


def window(first: int, samples: Floats, begin: int) -> Floats:
    """Return 640 samples from place `begin` on, cut from `samples`, which begin at place `first`; silence elsewhere."""
    out = SILENCE.copy()
    start, end = max(first, begin), min(first + len(samples), begin + FRAME_SAMPLES)
    if start < end:
        out[start - begin : end - begin] = samples[start - first : end - first]
    return out


# --- the clock of a sound card, measured by the computer's -----------------------------------------------------------
#
# The card counts samples; each callback comes with the time of its newest sample, by the computer's clock. A callback
# may come late, never early. So in the plane of (samples, seconds) the true clock is the highest line below all
# callbacks: the edge of their lower convex hull below their middle, which makes the sum of lateness least (Moon, Skelly
# and Towsley, "Estimation and removal of clock skew from network delay measurements", 1999). Late callbacks, one or
# many, lie above the line and do not change it.

_Point = tuple[float, float]


class SampleClock:
    """Conversion between samples of one unbroken stream and seconds of `time.monotonic`.

    Counts begin at 0. Not thread-safe.

    Args:
        rate_hz: nominal rate.
        skew: seconds of the computer for one second of the card, minus one, if known.
    """

    def __init__(self, rate_hz: float, skew: float = 0.0) -> None:
        self._nominal_hz = rate_hz
        self.skew = skew
        self._offset_s: float | None = None  # the line: offset + (1 + skew) x, with x = samples / nominal rate
        self._least = deque[_Point](maxlen=BINS)  # (x, seconds - x)
        self._bin: _Point | None = None
        self._bin_ends_s = BIN_S

    @property
    def rate_hz(self) -> float:
        """The card's true rate, by the computer's clock."""
        return self._nominal_hz / (1.0 + self.skew)

    @property
    def drift_ppm(self) -> float:
        """Excess of the card's rate over its nominal rate [ppm]."""
        return (1.0 / (1.0 + self.skew) - 1.0) * 1e6

    def observe(self, count: int, captured_s: float) -> None:
        """Update the line by a callback: `count` samples so far, the newest captured at `captured_s` or before."""
        x_s = count / self._nominal_hz
        point = (x_s, float(captured_s) - x_s)
        below_s = point[1] - self.skew * x_s
        self._offset_s = below_s if self._offset_s is None else min(self._offset_s, below_s)
        if self._bin is None or below_s < self._bin[1] - self.skew * self._bin[0]:
            self._bin = point
        if x_s < self._bin_ends_s:
            return
        least, self._bin, self._bin_ends_s = self._bin, None, x_s + BIN_S
        if self.lateness_s(round(least[0] * self._nominal_hz), sum(least)) > LOST_S:
            self._least.clear()
        self._least.append(least)
        if least[0] - self._least[0][0] >= LEAST_SPAN_S:
            (x0, r0), (x1, r1) = _edge_below_middle(list(self._least))
            self.skew = min(max((r1 - r0) / (x1 - x0), -LARGEST_SKEW), LARGEST_SKEW)
        self._offset_s = min(r - self.skew * x for x, r in self._least)

    def lateness_s(self, count: int, captured_s: float) -> float:
        """Return how late such a callback would be; negative: earlier than the line allows. 0 for the first one."""
        return 0.0 if self._offset_s is None else captured_s - self.time_s(count)

    def time_s(self, count: float) -> float:
        """Return when `count` samples had been captured. Raises ValueError before the first callback."""
        if self._offset_s is None:
            raise ValueError("no callback was observed")
        return self._offset_s + (1.0 + self.skew) * count / self._nominal_hz

    def count_at(self, time_s: float) -> float:
        """Return how many samples had been captured at `time_s`."""
        return (time_s - self.time_s(0)) * self.rate_hz


def _edge_below_middle(points: list[_Point]) -> tuple[_Point, _Point]:
    """Return the edge of the lower convex hull below the middle of two or more points, sorted from left to right."""
    hull: list[_Point] = []
    for point in points:
        while len(hull) > 1 and _turns_right(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    middle = sum(x for x, _ in points) / len(points)
    right = next((index for index in range(1, len(hull)) if hull[index][0] >= middle), len(hull) - 1)
    return hull[right - 1], hull[right]


def _turns_right(a: _Point, b: _Point, c: _Point) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])


# --- the pace at which sound is delivered ----------------------------------------------------------------------------

PAUSE_S: Final = 0.25  # a wait that is this much longer than its piece is a pause of the sender
OFF_PACE: Final = 0.015  # a sound card is off by at most a third of this
PACE_SECONDS: Final = 6
BURSTS: Final = 5  # within `BURSTS_S`
BURSTS_S: Final = 10.0


class Pace:
    """Meter of the pace at which a source delivers sound, relative to time: too slow, too fast, or in bursts.

    A source is behind by the time that has passed minus the sound that came. This lag rises and falls with the pieces,
    but its minimum in each second is constant for a source that keeps pace. The median of its changes gives the pace.

    Attributes:
        rate: seconds of sound per second, over the last seconds; None: not known yet.
    """

    def __init__(self) -> None:
        self.rate: float | None = None
        self._last_s = -math.inf
        self._behind_s = self._most_s = 0.0
        self._least = deque[_Point](maxlen=PACE_SECONDS + 1)  # (begin of a second, least lag), the last unfinished
        self._wait_s = self._widest_s = 0.0  # longest wait since the last burst, and longest before any burst
        self._bursts_s = deque[float](maxlen=BURSTS)
        self._said = False

    def observe(self, piece_s: float, now_s: float) -> None:
        """Update the pace by a piece of `piece_s` that is delivered at `now_s`."""
        wait_s, self._last_s = now_s - self._last_s, now_s
        if math.isinf(wait_s):
            wait_s = piece_s
        self._behind_s += wait_s - piece_s
        if wait_s > piece_s + PAUSE_S:
            self._least.clear()
        self._observe_burst(wait_s if wait_s > piece_s + GAP_S else 0.0, now_s)
        if self._least and now_s < self._least[-1][0] + 1.0:
            begin_s, least_s = self._least.pop()
            self._least.append((begin_s, min(least_s, self._behind_s)))
            return
        self._least.append((now_s, self._behind_s))
        if len(self._least) == self._least.maxlen:
            time_s, behind_s = np.diff(list(self._least)[:-1], axis=0).T
            self.rate = 1.0 - float(np.median(behind_s / time_s))

    @property
    def problem(self) -> str | None:
        """One line about a fault of the pace, or None."""
        if self.off:
            way = "falls behind" if self.off < 1.0 else "is ahead"
            return f"sound comes at {self.off:.2f} of real time: its sender {way}; pace it by the clock"
        if self.apart_s:
            return f"sound comes in bursts, up to {self.apart_s * 1e3:.0f} ms apart: send it as it is recorded"
        return None

    def warn_once(self, name: str) -> None:
        """Log the fault of the pace of the source `name`, the first time that there is one."""
        if not self._said and (problem := self.problem) is not None:
            self._said = True
            logger.warning("%s: %s (said once)", name, problem)

    @property
    def off(self) -> float | None:
        """Return the rate if it differs from real time, else None."""
        return None if self.rate is None or abs(self.rate - 1.0) <= OFF_PACE else self.rate

    @property
    def apart_s(self) -> float:
        """Longest wait between two bursts if sound comes in bursts, else 0."""
        bursts = len(self._bursts_s) == BURSTS and self._last_s - self._bursts_s[0] < BURSTS_S
        return self._widest_s if bursts else 0.0

    def _observe_burst(self, wait_s: float, now_s: float) -> None:
        self._wait_s, self._most_s = max(self._wait_s, wait_s), max(self._most_s, self._behind_s)
        if self._most_s - self._behind_s > GAP_S and self._wait_s:
            self._bursts_s.append(now_s)
            self._widest_s = max(self._widest_s, self._wait_s)
            self._wait_s, self._most_s = 0.0, self._behind_s


class LiveVoice(SourcePart):
    """A `ports.Voice` of a live stream.

    All methods may be called from any thread; none blocks for longer than the resampling of a piece takes.

    Attributes:
        mix: mix of its channels; `name` is the name of the sound in the mix's log line.
    """

    def __init__(self, now: Clock = time.monotonic, name: str = "sound") -> None:
        super().__init__(now)
        self._zero_s: float | None = None  # loop time 0; None: not started
        self.mix = Downmix(name)
        self._rate_hz = 0.0
        self._clock: SampleClock | None = None  # None: the next piece begins a stretch
        self._skew = 0.0  # skew of the card, kept over its gaps
        self._received = 0  # samples received of the stretch
        self._settled_s = 0.0  # time from which enough is known of the stretch
        self._stream: Any = None  # None: the next piece is placed
        self._ratio = 1.0  # samples of the card per sample of the loop
        self._varies = True  # soxr has a variable ratio, from version 1.1 on
        self._position = 0.0  # samples of the stretch that correspond to the output of the stream so far
        self._next = 0  # sample of the loop, at 16 kHz, that the stream returns next
        self._frames: dict[int, Floats] = {}
        self._wanted = 0  # index of the frame requested last
        self._counts = {"gaps": 0, "late_samples": 0, "not_finite": 0}
        self._uneven_s = 0.0  # additional lateness that does not count as a gap

    def start(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`. Earlier pieces are dropped after use by the clock."""
        with self._lock:
            self._zero_s, self._stream, self._next, self._wanted = origin_s, None, 0, 0
            self._frames.clear()

    def push(self, samples: Floats, rate_hz: float, captured_s: float, arrived_s: float | None = None) -> None:
        """Add the next piece, (n,) or (n, channels), full scale 1.

        Args:
            captured_s: `time.monotonic` of its newest sample; may be late by some tens of milliseconds, never early.
            arrived_s: time of the push, for the latency, if it differs from `captured_s`.

        Samples that are not finite count as silence. Raises ConfigError for a rate outside 4 to 384 kHz.
        """
        check_rate(rate_hz)
        samples, not_finite = finite(samples)
        if not len(samples):
            return
        with self._lock:
            mono = np.ascontiguousarray(np.clip(self.mix(samples), -1.0, 1.0))
            self._counts["not_finite"] += not_finite
            self._observe(len(mono), rate_hz, captured_s)
            if self._zero_s is not None:
                self._resample(mono, captured_s, captured_s if arrived_s is None else arrived_s)

    def take(self, index: int) -> Floats | None:
        """Return a frame; see `ports.Voice`. A frame of which only a part arrived is filled up with silence."""
        with self._lock:
            self._wanted = index
            for old in [each for each in self._frames if each < index]:
                del self._frames[old]
            whole = self._next >= (index + 1) * FRAME_SAMPLES
            return self._frames.pop(index, None) if whole else None

    def statistics(self) -> Facts:
        """Return rate and drift of the card, latency, gaps, and samples that came too late or were not finite."""
        with self._lock:
            drift_ppm = None if self._clock is None else round(self._clock.drift_ppm, 1)
            return {
                "rate_hz": self._rate_hz, "drift_ppm": drift_ppm, "latency_ms": round(self.latency_s * 1e3, 1),
                **self._counts,
            }  # fmt: skip

    def interrupt(self) -> None:
        """End the stretch, so that the next piece does not follow the last one."""
        with self._lock:
            self._end_stretch()

    def _observe(self, n: int, rate_hz: float, captured_s: float) -> None:
        """Update the clock by a piece; a piece that cannot follow the last one begins a new stretch."""
        if rate_hz != self._rate_hz:
            self._end_stretch()
        elif (
            self._clock is not None and self._clock.lateness_s(self._received + n, captured_s) > GAP_S + self._uneven_s
        ):
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
        """Return how many samples of the card the stream is behind its place."""
        assert self._clock is not None and self._zero_s is not None
        return self._clock.count_at(self._zero_s + self._next / AUDIO_HZ) - self._position

    def _place(self, samples: Floats, first: int) -> Floats:
        """Begin a stream at the first of these samples that is not in the past; return the samples from there on."""
        import soxr

        assert self._clock is not None and self._zero_s is not None
        at = (self._clock.time_s(first) - self._zero_s) * AUDIO_HZ
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
            self._write(self._stream.resample_chunk(NO_SOUND, last=True), None)
            self._stream = None

    def _write(self, samples: Floats, arrived_s: float | None) -> None:
        """Put samples into their frames. `arrived_s`: None for samples that a resampler still held."""
        while len(samples):
            index, within = divmod(self._next, FRAME_SAMPLES)
            part, samples = samples[: FRAME_SAMPLES - within], samples[FRAME_SAMPLES - within :]
            self._next += len(part)
            if index < self._wanted or index >= self._wanted + KEPT_FRAMES:
                self._counts["late_samples"] += len(part)
            else:
                frame = self._frames.setdefault(index, SILENCE.copy())
                frame[within : within + len(part)] = np.clip(part, -1.0, 1.0)
            if arrived_s is not None and within + len(part) == FRAME_SAMPLES:
                assert self._zero_s is not None
                late_s = float(arrived_s) - self._zero_s - (index + 1) * FRAME_S
                self.latency_s = latency_after(late_s, self.latency_s)


def latency_after(late_s: float, latency_s: float) -> float:
    """Return the latency after a frame that came `late_s` after its end: at least that, and falling slowly."""
    return max(late_s, latency_s - _LATENCY_FALLS_S, 0.0)


def check_rate(rate_hz: float) -> None:
    """Raise ConfigError for a sample rate that is not one of speech, or is not a number."""
    if not isinstance(rate_hz, Real) or not LOWEST_RATE_HZ <= rate_hz <= HIGHEST_RATE_HZ:
        raise ConfigError(f"rate_hz = {rate_hz!r}: expected a rate of speech ({LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ})")
