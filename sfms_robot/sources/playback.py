"""Playback of the robot's own voice, `--play [DEVICE]`, on a loudspeaker in another process (`play`).

Speech leaves the loudspeaker `delay_s` after its time, by the device's own time stamps (`Playout`), and has that later
time in the rest of the program: the listener's lips, the state of the run and the echo canceller follow the sound that
leaves. Speech that did not leave is silence for them too.

A device that accepts no sound for half a second is lost: the process ends and is started again, with a PortAudio that
lists the devices of that moment, until the device is back.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

import numpy as np

from sfms_robot.data import Report
from sfms_robot.errors import NOTE
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, NO_SOUND, SILENCE, Floats
from sfms_robot.ports import Facts
from sfms_robot.signals.audio import at_positions
from sfms_robot.sources.live_voice import GAP_S, LARGEST_PULL, PULL_S, Clock, SampleClock, window
from sfms_robot.sources.push import Spoken
from sfms_robot.sources.sound_devices import STEREO, DeviceStream, SoundDevice, device_name
from sfms_robot.sources.worker import SourceWorker

logger = logging.getLogger(__name__)

FLAG: Final = "--play"
STATISTICS_S: Final = 1.0
TURN_S: Final = 0.02  # between two checks for messages of the parent
_MEASURED_BLOCKS: Final = 20  # blocks from which the latency of the device is measured
_LATEST_S: Final = 2.0  # a time stamp further ahead comes from another clock
JUMP_S: Final = 0.02
_EXACT_S: Final = 0.0005  # largest error at the begin of a stretch and in silence
_UNREPORTED: Final = 64  # silences that wait to be reported
DEFAULT: Final = "default"  # `--play` without a device
MARGIN_S: Final = 0.08  # speech is known this long before the device needs it: a frame, two processes, a late tick
HUSH_S: Final = 0.04  # until a hush reaches the worker
EARLY_S: Final = 0.02  # lead of the echo canceller's reference: time stamps may be off, and no echo precedes its sound
AHEAD_FRAMES: Final = 10  # frames sent in advance to the worker if they are known, because the loop may be held up
_KEPT: Final = AUDIO_HZ  # samples kept after they left
_FADE: Final = np.linspace(1.0, 0.0, AUDIO_HZ // 200, dtype=np.float32)  # 5 ms: a voice that is cut off clicks


@dataclass(frozen=True)
class PlaybackOpened:
    """The first message of `play`. `latency_s`: from passing a sample to the device until it leaves, by its report."""

    device: str
    latency_s: float


@dataclass(frozen=True)
class Speech:
    """A message from the parent: the samples (n x 640,) that leave from frame `first` of the loop on.

    It replaces earlier messages.

    origin_s: loop time 0 in seconds of `time.monotonic`.
    """

    origin_s: float
    first: int
    samples: Floats


@dataclass(frozen=True)
class Silence:
    """A report that samples `first` to `last` - 1 of the loop did not leave the device."""

    first: int
    last: int


PlaybackMessage = PlaybackOpened | Silence | Report


def play(wanted: str) -> Generator[PlaybackMessage | None, Speech | None, None]:
    """Play the parent's messages; see `sources.worker`. `wanted`: a number, a name, a part of one; "": the default.

    Raises ConfigError for an unknown device or if PortAudio is missing; PortError if no device plays, or if the device
    cannot be opened or is lost.
    """
    with closing(PlaybackStream.opened(wanted, FLAG)) as loudspeaker:
        playout = loudspeaker.playout
        told = yield PlaybackOpened(loudspeaker.device.name, loudspeaker.latency_s())
        before: Speech | None = None
        next_statistics_s = 0.0
        while True:
            if told is not None and told is not before:
                if before is None or told.origin_s != before.origin_s:
                    playout.start(told.origin_s)
                playout.tell(told.first, told.samples)
                before = told
            loudspeaker.check()
            messages: list[PlaybackMessage | None] = [None]  # yield at least once, to receive messages of the parent
            while playout.silences:
                messages.append(playout.silences.popleft())
            if (now_s := time.monotonic()) >= next_statistics_s:
                next_statistics_s = now_s + STATISTICS_S
                messages.append({**playout.statistics(), "latency_ms": round(loudspeaker.latency_s() * 1e3, 1)})
            for message in messages:
                told = yield message
            if told is before:
                time.sleep(TURN_S)


class PlaybackStream(DeviceStream):
    """A device that plays the blocks of a `Playout`; it counts as started once its latency was measured."""

    plays = True
    wanted_latency_s = 0.05  # short, because sound that was passed to the device cannot be hushed
    start_limit_s = 1.0
    lost_s = 0.5  # longer than the delays of a busy computer

    def __init__(self, device: SoundDevice, rate_hz: float, channels: int) -> None:
        super().__init__(device, rate_hz, channels)
        self.playout = Playout(rate_hz)
        self._latencies_s: list[float] = []

    def latency_s(self) -> float:
        """Return the median latency of the newest blocks."""
        return median(self._latencies_s)

    def _called(self, out: Floats, n: int, stamp: Any, status: Any) -> None:
        now_s = self._called_s = time.monotonic()
        ahead_s = stamp.outputBufferDacTime - stamp.currentTime if stamp.outputBufferDacTime else None
        usual_s = self.wanted_latency_s if self._stream is None else float(self._stream.latency)
        latency_s = leaves_after_s(ahead_s, usual_s)
        self._latencies_s = [*self._latencies_s[1 - _MEASURED_BLOCKS :], latency_s]
        if len(self._latencies_s) == _MEASURED_BLOCKS:
            self._flows.set()
        block = self.playout.block(n, now_s + latency_s, bool(status.output_underflow))
        out[:, :STEREO] = np.clip(block, -1.0, 1.0)[:, None]
        out[:, STEREO:] = 0.0  # further loudspeakers of a room


def leaves_after_s(ahead_s: float | None, usual_s: float) -> float:
    """Return how long after the request a block leaves: the device's value `ahead_s` if plausible, else `usual_s`."""
    return ahead_s if ahead_s is not None and 0.0 <= ahead_s <= _LATEST_S else usual_s


# --- from speech in frames of the loop to blocks for the device ----------------------------------------------------
#
# Every sample leaves the device at its time. The grid of the loop is the only clock: sample s, 16 kHz, leaves the
# loudspeaker s / 16000 after loop time 0, for any rate and drift of the device. The device reports for every block when
# it leaves; `SampleClock` computes from that the time of every sample, and the next block is the signal at the instants
# at which it leaves. Its rate is the card's true rate, changed by at most 1 % when it is ahead or behind. Samples are
# cut out or inserted in these cases only:
#
# 1. The device had nothing to play for a while. Speech that was due then is dropped; later speech is on time again.
# 2. The position is off by more than `JUMP_S`, or at all in silence: it jumps to its place.
# 3. A sample arrives too late: the device has already played zeros in its place.
#
# Speech that did not leave is reported (`Silence`), so that the rest of the program does not treat it as said.


class Playout:
    """The samples for one device. `block` is called in one thread, the other methods in another.

    Args:
        rate_hz: nominal rate of the device.

    Attributes:
        silences: silences not reported yet; the oldest is on the left.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._origin_s: float | None = None
        self._said: tuple[int, Floats] = (0, np.zeros(1, np.float32))  # first sample of the loop, and the samples
        self._clock: SampleClock | None = None  # None: the next block begins a stretch
        self._skew = 0.0  # skew of the card, kept over its silences
        self._count = 0  # samples of the stretch that were passed to the device
        self._next = 0.0  # sample of the loop that is passed next
        self._settled = False  # True: the next block continues where the last one ended
        self.silences = deque[Silence](maxlen=_UNREPORTED)
        self._counts = {"underruns": 0, "jumps": 0}
        at_positions(np.zeros(1, np.float32), np.zeros(1))  # computes its table now, not in the callback of the device

    def start(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`."""
        self._origin_s, self._next, self._settled = origin_s, 0.0, False

    def tell(self, first: int, samples: Floats) -> None:
        """Set the samples (n x 640,), n > 0, that leave from frame `first` on; they replace those set before."""
        self._said = (first * FRAME_SAMPLES, samples)

    def block(self, n: int, leaves_s: float, dry: bool = False) -> Floats:
        """Return the next (n,) samples for the device, the first of which leaves at `leaves_s` of `time.monotonic`.

        `leaves_s` may be late by some milliseconds, seldom early. `dry`: the device had nothing to play before it.
        """
        clock = self._followed(leaves_s, dry)
        count, self._count = self._count, self._count + n
        if self._origin_s is None:
            return np.zeros(n, np.float32)
        due = (clock.time_s(count) - self._origin_s) * AUDIO_HZ
        self._place(due, math.ceil(n * AUDIO_HZ / self._rate_hz))
        pull = (due - self._next) / (PULL_S * AUDIO_HZ)
        ratio = AUDIO_HZ / clock.rate_hz * (1.0 + min(max(pull, -LARGEST_PULL), LARGEST_PULL))
        begins, self._next = self._next, self._next + ratio * n
        first, said = self._said
        self._lacks(max(begins, first + len(said)), self._next)
        return at_positions(said, begins - first + ratio * np.arange(n, dtype=np.float64))

    def statistics(self) -> Facts:
        """Return how often the device had nothing to play, the number of jumps, and the drift of the card."""
        return {**self._counts, "drift_ppm": None if self._clock is None else round(self._clock.drift_ppm, 1)}

    def _followed(self, leaves_s: float, dry: bool) -> SampleClock:
        """Return the clock, updated by this block; a new clock if the block does not follow the last one."""
        if self._clock is not None and (dry or self._clock.lateness_s(self._count, leaves_s) > GAP_S):
            self._counts["underruns"] += self._origin_s is not None
            self._clock, self._settled = None, False
        if self._clock is None:
            self._clock, self._count = SampleClock(self._rate_hz, self._skew), 0
        self._clock.observe(self._count, leaves_s)
        self._skew = self._clock.skew
        return self._clock

    def _place(self, due: float, n: int) -> None:
        """Move to the sample that is due if the next one is too far from it; `n`: samples of the loop in the block."""
        first, said = self._said
        begins, ends = (max(0, math.floor(at(self._next, due)) - first) for at in (min, max))
        sounds = bool(said[begins : ends + n].any())
        if abs(due - self._next) / AUDIO_HZ > (JUMP_S if self._settled and sounds else _EXACT_S):
            if sounds:
                self._counts["jumps"] += self._settled
                self._lacks(self._next, due)
            self._next = due
        self._settled = True

    def _lacks(self, begins: float, ends: float) -> None:
        if ends > begins and ends > 0.0:
            self.silences.append(Silence(max(0, math.floor(begins)), math.ceil(ends)))


# --- the run's side --------------------------------------------------------------------------------------------------


class PlayedVoice:
    """A `ports.Voice` of the speech of `spoken` as it leaves the loudspeaker. Only `close` blocks.

    Args:
        loudspeaker: the worker of `play`; its first message has arrived.
        now: `time.monotonic`, or the clock of a test.

    Attributes:
        device: name of the device.
        delay_s: from the time of a sample in `spoken` until it leaves.
        duration_s: time until all speech has left; None: without end.
        outlet: the server of the program that sends the speech, or None.
        early_s: time by which an echo canceller receives the voice too early.
    """

    latency_s = 0.0
    early_s = EARLY_S

    def __init__(self, loudspeaker: SourceWorker, spoken: Spoken, now: Clock = time.monotonic) -> None:
        self._loudspeaker, self._spoken, self._now = loudspeaker, spoken, now
        self.device = ""
        self.delay_s = self._device_s = 0.0
        self._origin_s: float | None = None
        self._turn = threading.Lock()  # held while sending to the loudspeaker
        self._next = 0  # frame of `spoken` that is taken next
        self._leaves: tuple[int, Floats] = (0, NO_SOUND)  # first sample of the loop, and the samples that leave
        self._speaks = False
        self._unsaid = 0
        self._told: Facts = {}
        self._collect()
        self.duration_s = None if spoken.duration_s is None else spoken.duration_s + self.delay_s
        self.outlet = getattr(spoken, "outlet", None)

    @property
    def lost(self) -> bool:
        """True while the device is lost, so that the robot cannot be heard."""
        return self._loudspeaker.lost

    def start(self, origin_s: float) -> None:
        self._spoken.start(origin_s)
        with self._turn:
            self._origin_s = origin_s
            self._next, self._leaves = 0, (round(self.delay_s * AUDIO_HZ), NO_SOUND)
            self._tell()

    def take(self, index: int) -> Floats | None:
        """Return the samples (640,) that leave in frame `index`, silence in pauses; None until the first speech.

        For a future frame, return the samples that will leave, as far as they are known.
        """
        if self._origin_s is not None and self._turn.acquire(blocking=False):  # else another thread is sending
            try:
                self._collect()
                self._tell()
            finally:
                self._turn.release()
        if not self._speaks:
            return None
        begin, leaves = self._leaves
        return window(begin, NO_SOUND if self.lost else leaves, index * FRAME_SAMPLES)

    def said(self) -> None:
        """Send new speech to the loudspeaker; see `Player`."""
        with self._turn:
            if self._origin_s is not None:
                self._tell()

    def hushed(self) -> None:
        """Drop all speech except that which the device is already playing; see `Player`."""
        with self._turn:
            if self._origin_s is None:
                return
            self._take_in()
            begin, leaves = self._leaves
            cut = max(self._sample(self._now() + self._device_s + HUSH_S) - begin, 0)
            fading = leaves[cut : cut + len(_FADE)]
            silent = np.zeros(max(len(leaves) - cut - len(_FADE), 0), np.float32)
            self._leaves = (begin, np.concatenate([leaves[:cut], fading * _FADE[: len(fading)], silent]))
            self._tell()

    def statistics(self) -> Facts:
        """Return statistics of device and process, delay and speech that did not leave [ms], and those of `spoken`."""
        return {
            "device": self.device, **self._loudspeaker.statistics(), **self._told,
            "delay_ms": round(self.delay_s * 1e3, 1), "unsaid_ms": round(self._unsaid / AUDIO_HZ * 1e3, 1),
            **self._spoken.statistics(),
        }  # fmt: skip

    def close(self) -> None:
        self._loudspeaker.close()
        self._spoken.close()

    def _tell(self) -> None:
        """Send the loudspeaker the samples that leave from now on, and the known frames after them."""
        self._take_in()
        assert self._origin_s is not None
        begin, leaves = self._leaves
        first = max(0, self._sample(self._now()) // FRAME_SAMPLES)
        skip = first * FRAME_SAMPLES - begin
        ahead = [self._spoken.upcoming(index) for index in range(self._next, self._next + AHEAD_FRAMES)]
        samples = np.concatenate([np.zeros(max(-skip, 0), np.float32), leaves[max(skip, 0) :], *map(_sounding, ahead)])
        whole = len(samples) // FRAME_SAMPLES * FRAME_SAMPLES
        self._loudspeaker.tell(Speech(self._origin_s, first, samples[:whole]))

    def _take_in(self) -> None:
        """Take the speech up to the frame in progress, which will leave; forget samples that left long ago."""
        begin, leaves = self._leaves
        now = self._sample(self._now())
        pieces = []
        while self._next <= now // FRAME_SAMPLES:
            piece = self._spoken.take(self._next)
            self._speaks = self._speaks or piece is not None
            pieces.append(_sounding(piece))
            self._next += 1
        old = min(max(0, now - _KEPT - begin), len(leaves))
        self._leaves = (begin + old, np.concatenate([leaves[old:], *pieces]))

    def _sample(self, time_s: float) -> int:
        """Return the sample of the loop at `time_s` of `time.monotonic`."""
        assert self._origin_s is not None
        return math.floor((time_s - self._origin_s) * AUDIO_HZ)

    def _collect(self) -> None:
        for message in self._loudspeaker.messages(self._now()):
            if isinstance(message, PlaybackOpened):
                if not self.device:  # a returning device may have another latency: speech keeps its delay
                    self.delay_s = round((message.latency_s + MARGIN_S) * AUDIO_HZ) / AUDIO_HZ
                self.device, self._device_s = message.device, message.latency_s
            elif isinstance(message, Silence):
                self._silence(message)
            else:
                self._told = message

    def _silence(self, silence: Silence) -> None:
        begin, leaves = self._leaves
        first, last = (min(max(at - begin, 0), len(leaves)) for at in (silence.first, silence.last))
        lacks = int(np.count_nonzero(leaves[first:last]))
        if lacks and silence.first and not self._unsaid:  # from 0 on: the device was lost, which is logged already
            text = "loudspeaker: %s had nothing to play for %.0f ms while the robot spoke (said once)"
            logger.warning(text, self.device, lacks / AUDIO_HZ * 1e3)
        self._unsaid += lacks
        leaves[first:last] = 0.0


def _sounding(piece: Floats | None) -> Floats:
    return SILENCE if piece is None else piece


def open_playback(argument: str, spoken: Spoken) -> PlayedVoice:
    """Play the speech of `spoken` on a device by number, name or a part of one; "default" is the default device.

    Blocks until it plays, a second. Raises ConfigError for an unknown device or if PortAudio is missing, PortError if
    there is no loudspeaker or it cannot be opened.
    """
    worker = SourceWorker("loudspeaker", play, device_name("" if argument == DEFAULT else argument, FLAG, plays=True))
    worker.wait()
    played = PlayedVoice(worker, spoken)
    spoken.played_by(played)
    logger.log(NOTE, "loudspeaker: %s, %.0f ms after it is said", played.device, played.delay_s * 1e3)
    return played
