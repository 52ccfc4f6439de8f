"""The loudspeaker's own process: what the robot says in, PortAudio's callbacks out, and what was not heard after all.

As with the microphone, a device that takes nothing for `LOST_S` went away: the process ends with that, and the one that
is started in its place begins with a PortAudio that sees the devices of that moment, until the device is back.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from statistics import median
from threading import Event
from typing import Any, Final

import numpy as np

from sfms_robot.errors import PortError
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Floats
from sfms_robot.signals.audio import at_positions
from sfms_robot.sources.drift import SampleClock
from sfms_robot.sources.sound_devices import (
    DeviceStream,
    SoundDevice,
    choose_device,
    listed_devices,
    portaudio,
    started_stream,
)

FLAG: Final = "--play"
LOST_S: Final = 0.5  # a busy computer is none that is gone
STATISTICS_S: Final = 1.0
TURN_S: Final = 0.02  # between two looks at what the parent tells
_LATENCY_S: Final = 0.05  # asked of the device: what is on its way out cannot be hushed any more
_START_LIMIT_S: Final = 1.0
_MEASURED_BLOCKS: Final = 20  # that tell how late the device is
_LATEST_S: Final = 2.0  # a time stamp that is further away is of another clock
_PLAYED: Final = 2  # channels that get the voice; those behind them are of a room
JUMP_S: Final = 0.02
PULL_S: Final = 1.0  # time constant of a correction
LARGEST_PULL: Final = 0.01  # of the rate: a sixth of a semitone
GAP_S: Final = 0.15  # a block that leaves so long after the end of the last one: the device was dry, and did not say so
_EXACT_S: Final = 0.0005  # where a stretch begins, and in silence
_UNTOLD: Final = 64  # silences that wait to be told


@dataclass(frozen=True)
class PlaybackOpened:
    """The first message. `latency_s`: from handing a sample over to its leaving, as the device says of itself."""

    device: str
    rate_hz: float
    latency_s: float


@dataclass(frozen=True)
class Speech:
    """From the parent: what leaves from frame `first` of the loop on, (n x 640,); the newest replaces what was told.

    origin_s: loop time 0 in seconds of `time.monotonic`.
    """

    origin_s: float
    first: int
    samples: Floats


@dataclass(frozen=True)
class Silence:
    """Samples `first` to `last` - 1 of the loop did not leave."""

    first: int
    last: int


Message = PlaybackOpened | Silence | dict[str, Any]


def play(wanted: str) -> Generator[Message | None, Speech | None, None]:
    """Play what is told; see `sources.worker`. `wanted`: a number, a name or a part of one; "" is the default device.

    Raises ConfigError for a device that is not there and without PortAudio, PortError where nothing plays, for a device
    that cannot be opened, and when it goes away.
    """
    with open_loudspeaker(wanted) as loudspeaker:
        playout = loudspeaker.playout
        told = yield PlaybackOpened(loudspeaker.device.name, loudspeaker.rate_hz, loudspeaker.latency_s())
        before: Speech | None = None
        next_statistics_s = 0.0
        while True:
            if told is not None and told is not before:
                if before is None or told.origin_s != before.origin_s:
                    playout.start(told.origin_s)
                playout.tell(told.first, told.samples)
                before = told
            loudspeaker.check()
            messages: list[Message | None] = [None]  # and hear what the parent tells
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
    """A device that plays what a `Playout` gives, by callbacks in a thread of PortAudio's."""

    def __init__(self, device: SoundDevice, rate_hz: float, channels: int) -> None:
        super().__init__(device, rate_hz, channels)
        self.playout = Playout(rate_hz)
        self._latencies_s: list[float] = []
        self._measured = Event()
        self._called_s = time.monotonic()

    def start(self) -> bool:
        """Open the stream; whether it plays. Raises PortAudio's errors."""
        import sounddevice

        self._open(sounddevice.OutputStream, _LATENCY_S, self._called)
        if not self._measured.wait(_START_LIMIT_S):
            self.close()
            return False
        return True

    def latency_s(self) -> float:
        """Of the newest blocks, the middle."""
        return median(self._latencies_s[-_MEASURED_BLOCKS:])

    def check(self) -> None:
        """Raises PortError when it went away."""
        if time.monotonic() - self._called_s > LOST_S:
            raise PortError(f"{self.device.name} takes no more sound")

    def _called(self, out: Floats, n: int, stamp: Any, status: Any) -> None:
        now_s = self._called_s = time.monotonic()
        ahead_s = stamp.outputBufferDacTime - stamp.currentTime if stamp.outputBufferDacTime else None
        latency_s = leaves_after_s(ahead_s, float(self._stream.latency) if self._stream is not None else _LATENCY_S)
        self._latencies_s = [*self._latencies_s[1 - _MEASURED_BLOCKS :], latency_s]
        if len(self._latencies_s) == _MEASURED_BLOCKS:
            self._measured.set()
        block = self.playout.block(n, now_s + latency_s, bool(status.output_underflow))
        out[:, :_PLAYED] = np.clip(block, -1.0, 1.0)[:, None]
        out[:, _PLAYED:] = 0.0


def leaves_after_s(ahead_s: float | None, usual_s: float) -> float:
    """How long after it is asked for a block leaves: what the device says, `ahead_s`, where that can be."""
    return ahead_s if ahead_s is not None and 0.0 <= ahead_s <= _LATEST_S else usual_s


def open_loudspeaker(wanted: str) -> PlaybackStream:
    """Open the device that is wanted, playing silence: at 16 kHz and mono where it takes that, else as it is.

    Blocks until it is known how late it is, some tenths of a second. Raises ConfigError, PortError; see `play`.
    """
    sounddevice = portaudio(FLAG)
    device = choose_device(listed_devices(FLAG, "sink"), wanted, FLAG, plays=True)
    counts = (1, min(_PLAYED, device.channels), device.channels)
    stream = started_stream(PlaybackStream, device, counts, sounddevice.check_output_settings, FLAG)
    if stream is None:
        raise PortError(f"{FLAG}: {device.name} is open, but takes no sound")
    return stream


# --- from what is said, in frames of the loop, to what the device is handed ---------------------------------------
#
# Every sample leaves the device at its time. The grid of the loop is the only clock: sample s, 16 kHz, leaves the
# loudspeaker s / 16000 after loop time 0, whatever the device's rate and drift. The device tells of every block when it
# leaves; `drift` computes from that the time of every sample, and the next block is the signal at the instants at which
# it leaves: its rate is the card's true one, and a little more or less where it is ahead or behind, 1 % at most.
# Nothing is cut out or put in but for these cases:
#
# 1. The device had nothing to play for a while. What was due then is not said any more; what follows is on time again.
# 2. What is handed over is off by more than `JUMP_S`, or at all while nothing sounds: it jumps to its place.
# 3. A sample arrives too late: the device has had zeros for it.
#
# What did not leave is reported (`Silence`), so that the rest of the program does not take it for said.


class Playout:
    """One device. `block` is called in one thread, the rest in another.

    Args:
        rate_hz: of the device, by its own word.

    Attributes:
        silences: not told yet; the oldest is taken from the left.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._origin_s: float | None = None
        self._said: tuple[int, Floats] = (0, np.zeros(1, np.float32))  # from which sample of the loop on, and what
        self._clock: SampleClock | None = None  # None: the next block begins a stretch
        self._skew = 0.0  # of the card, kept over its silences
        self._count = 0  # samples of the stretch that were handed over
        self._next = 0.0  # sample of the loop that is handed over next
        self._settled = False  # it goes on where the last block ended
        self.silences: deque[Silence] = deque(maxlen=_UNTOLD)
        self._counts = {"underruns": 0, "jumps": 0}
        at_positions(np.zeros(1, np.float32), np.zeros(1))  # makes its table now, not in the callback of the device

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`."""
        self._origin_s, self._next, self._settled = origin_s, 0.0, False

    def tell(self, first: int, samples: Floats) -> None:
        """What is to leave from frame `first` on, (n x 640,), n > 0; the newest replaces what was told before."""
        self._said = (first * FRAME_SAMPLES, samples)

    def block(self, n: int, leaves_s: float, dry: bool = False) -> Floats:
        """The next (n,) samples for the device, the first of which leaves at `leaves_s` of `time.monotonic`.

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

    def statistics(self) -> Mapping[str, Any]:
        """Times that the device ran dry, jumps, and how the card drifts."""
        drift_ppm = None if self._clock is None else round(self._clock.drift_ppm, 1)
        return {**self._counts, "drift_ppm": drift_ppm}

    def _followed(self, leaves_s: float, dry: bool) -> SampleClock:
        """The clock, which has seen this block; a new one where the block does not follow the last one."""
        if self._clock is not None and (dry or self._clock.lateness_s(self._count, leaves_s) > GAP_S):
            self._counts["underruns"] += self._origin_s is not None
            self._clock, self._settled = None, False
        if self._clock is None:
            self._clock, self._count = SampleClock(self._rate_hz, self._skew), 0
        self._clock.observe(self._count, leaves_s)
        self._skew = self._clock.skew
        return self._clock

    def _place(self, due: float, n: int) -> None:
        """What comes next is what is due, where that is not so nearly; `n`: samples of the loop that come."""
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
