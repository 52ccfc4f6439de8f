"""The loudspeaker's own process: what the robot says in, PortAudio's callbacks out, and what was not heard after all.

As with the microphone, a device that takes nothing for `LOST_S` went away: the process ends with that, and the one that
is started in its place begins with a PortAudio that sees the devices of that moment, until the device is back.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from dataclasses import dataclass
from statistics import median
from threading import Event
from typing import Any, Final

import numpy as np

from sfms_robot.errors import PortError
from sfms_robot.frames import Floats
from sfms_robot.sources.playout import Playout, Silence
from sfms_robot.sources.sound_devices import (
    SoundDevice,
    accepted_format,
    choose_device,
    playing_devices,
    portaudio,
    why_not_opened,
)

FLAG: Final = "--play"
LOST_S: Final = 0.5  # a busy computer is none that is gone
STATISTICS_S: Final = 1.0
TURN_S: Final = 0.02  # between two looks at what the parent tells
_BLOCK_S: Final = 0.01
_LATENCY_S: Final = 0.05  # asked of the device: what is on its way out cannot be hushed any more
_STARTS: Final = 20  # a stream of ALSA's plugin for sound servers may never start: it is opened again
_START_LIMIT_S: Final = 1.0
_MEASURED_BLOCKS: Final = 20  # that tell how late the device is
_LATEST_S: Final = 2.0  # a time stamp that is further away is of another clock
_PLAYED: Final = 2  # channels that get the voice; those behind them are of a room


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


class PlaybackStream:
    """A device that plays what a `Playout` gives, by callbacks in a thread of PortAudio's."""

    def __init__(self, device: SoundDevice, rate_hz: float, channels: int) -> None:
        self.device, self.rate_hz, self.channels = device, rate_hz, channels
        self.playout = Playout(rate_hz)
        self._latencies_s: list[float] = []
        self._measured = Event()
        self._called_s = time.monotonic()
        self._stream: Any = None

    def start(self) -> bool:
        """Open the stream; whether it plays. Raises PortAudio's errors."""
        import sounddevice

        with self.device.selected():
            self._stream = sounddevice.OutputStream(
                device=self.device.number, samplerate=self.rate_hz, channels=self.channels, dtype="float32",
                blocksize=round(self.rate_hz * _BLOCK_S), latency=_LATENCY_S, callback=self._called,
            )  # fmt: skip
            self._stream.start()
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

    def close(self) -> None:
        if self._stream is not None:
            self._stream.abort()
            self._stream.close()
            self._stream = None

    def __enter__(self) -> PlaybackStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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
    """The device that is wanted, playing silence: at 16 kHz and mono where it takes that, else as it is.

    Blocks until it is known how late it is, some tenths of a second. Raises ConfigError, PortError; see `play`.
    """
    sounddevice = portaudio(FLAG)
    device = choose_device(playing_devices(FLAG), wanted, FLAG, plays=True)
    try:
        counts = (1, min(_PLAYED, device.channels), device.channels)
        rate_hz, channels = accepted_format(device, counts, sounddevice.check_output_settings)
        for _ in range(_STARTS):
            stream = PlaybackStream(device, rate_hz, channels)
            if stream.start():
                return stream
    except sounddevice.PortAudioError as error:
        raise PortError(f"{FLAG}: {device.name} cannot be opened, {why_not_opened(error)}") from error
    raise PortError(f"{FLAG}: {device.name} is open, but takes no sound")
