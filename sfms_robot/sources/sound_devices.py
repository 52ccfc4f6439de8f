"""Sound devices for recording and playback: those of PortAudio, and a sound server's own by the server's names.

PulseAudio and PipeWire appear in PortAudio as one device ("pulse"). The environment variables PULSE_SOURCE and
PULSE_SINK select the source or sink that it opens. Monitors, which record the signal of a loudspeaker, are sources.
"""

from __future__ import annotations

import queue
import re
import subprocess
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, ClassVar, Final, Self

import numpy as np

from sfms_robot.data import speaker_names
from sfms_robot.errors import ConfigError, PortError
from sfms_robot.frames import AUDIO_HZ, Floats
from sfms_robot.signals.audio import environment
from sfms_robot.sources.live_voice import LiveVoice, Pace
from sfms_robot.sources.worker import SourceWorker

_SERVER: Final = "pulse"  # PortAudio's name for the device of a sound server
_HARDWARE: Final = re.compile(r" *\(hw:\d+(,\d+)?\)$")  # hardware numbers, which change when a device is plugged in
_PACTL_LIMIT_S: Final = 5.0
BLOCK_S: Final = 0.01
_OLDEST_S: Final = 1.0  # an older time stamp comes from another clock
_DENORMAL: Final = np.finfo(np.float32).tiny  # smaller values take four times the processor time
STEREO: Final = 2
_STARTS: Final = 20  # attempts to open a device: a stream of ALSA's plugin for sound servers may never start


@dataclass(frozen=True, kw_only=True)
class SoundDevice:
    """A device that records or plays sound.

    Attributes:
        name: its name in PortAudio or the sound server.
        number: its number in PortAudio; it may change when a device is plugged in.
        channels: highest number of channels.
        rate_hz: default sample rate.
        default: True for the device that is used if none is named.
        plays: True if it plays, False if it records.
        of_server: True for a source or sink of the sound server, False for a device of PortAudio itself.
    """

    name: str
    number: int
    channels: int
    rate_hz: float
    default: bool = False
    plays: bool = False
    of_server: bool = False

    @property
    def label(self) -> str:
        """Name of the device for the user, after its number if it has one."""
        return self.name if self.of_server else f"{self.number} {self.name}"

    @property
    def monitor(self) -> bool:
        """True if it records the signal of a loudspeaker."""
        return self.of_server and not self.plays and self.name.endswith(".monitor")

    def selected(self) -> AbstractContextManager[None]:
        """Select this device for streams that are opened by `number` in the context. Not for several threads."""
        variable = "PULSE_SINK" if self.plays else "PULSE_SOURCE"
        return environment({variable: self.name} if self.of_server else {})


class DeviceStream:
    """A PortAudio stream on one device. Base class of streams that record and streams that play.

    Attributes:
        plays: True if it plays, False if it records.
        wanted_latency_s: latency requested from the device.
        start_limit_s: time without sound after which the stream counts as not started.
        lost_s: time without a callback after which the device counts as lost.
    """

    plays: ClassVar[bool]
    wanted_latency_s: ClassVar[float]
    start_limit_s: ClassVar[float]
    lost_s: ClassVar[float]

    def __init__(self, device: SoundDevice, rate_hz: float, channels: int) -> None:
        self.device, self.rate_hz, self.channels = device, rate_hz, channels
        self._stream: Any = None
        self._flows = threading.Event()  # set by `_called`
        self._called_s = time.monotonic()

    @classmethod
    def opened(cls, wanted: str, flag: str) -> Self:
        """Open the device `wanted`: at 16 kHz and mono if it accepts that, else at its own rate.

        Blocks until sound flows, some tenths of a second. Raises ConfigError for an unknown device or if PortAudio is
        missing; PortError if the computer has no device, or if the device cannot be opened.
        """
        sounddevice = portaudio(flag)
        devices = listed_devices(flag, cls.plays)
        device = choose_device(devices, wanted, flag, cls.plays)
        check = sounddevice.check_output_settings if cls.plays else sounddevice.check_input_settings
        channels = (1, min(STEREO, device.channels), device.channels) if cls.plays else (1, device.channels)
        try:
            rate_hz, count = accepted_format(device, channels, check)
            for _ in range(_STARTS):
                stream = cls(device, rate_hz, count)
                if stream._start(sounddevice.OutputStream if cls.plays else sounddevice.InputStream):
                    return stream
        except sounddevice.PortAudioError as error:
            raise PortError(f"{flag}: {device.name} cannot be opened, {why_not_opened(error)}") from error
        others = ", ".join(each.label for each in devices if each is not device) or "there is no other"
        raise PortError(f"{flag}: {device.name} is open, but {'takes' if cls.plays else 'gives'} no sound ({others})")

    def check(self) -> None:
        """Raise PortError if the device is lost."""
        if time.monotonic() - self._called_s > self.lost_s:
            raise PortError(f"{self.device.name} {'takes' if self.plays else 'gives'} no more sound")

    def close(self) -> None:
        """Close the device. Idempotent."""
        if self._stream is not None:
            self._stream.abort()
            self._stream.close()
            self._stream = None

    def _start(self, stream: Any) -> bool:
        """Open a stream, one of the classes of sounddevice; return whether sound flows. Raises PortAudio's errors."""
        with self.device.selected():
            self._stream = stream(
                device=self.device.number,
                samplerate=self.rate_hz,
                channels=self.channels,
                dtype="float32",
                blocksize=round(self.rate_hz * BLOCK_S),
                latency=self.wanted_latency_s,
                callback=self._called,
            )
            self._stream.start()
        if not self._flows.wait(self.start_limit_s):
            self.close()
            return False
        return True

    def _called(self, samples: Floats, n: int, stamp: Any, status: Any) -> None:
        """Read or fill a block (n, channels), in a thread of PortAudio."""
        raise NotImplementedError


class Capture(DeviceStream):
    """A device that records into a queue.

    Attributes:
        overflows: how often PortAudio lost samples.
        pace: pace at which sound arrives.
    """

    plays = False
    wanted_latency_s = 0.06  # with less, a sound server's stream seldom starts
    start_limit_s = 0.3
    lost_s = 0.2

    def __init__(self, device: SoundDevice, rate_hz: float, channels: int) -> None:
        super().__init__(device, rate_hz, channels)
        self.overflows, self.pace = 0, Pace()
        self._pieces = queue.SimpleQueue[tuple[Floats, float, bool]]()

    def pass_on(self, voice: LiveVoice, wait_s: float) -> None:
        """Push all recorded pieces to `voice`; wait `wait_s` for the first. Raises PortError if the device is lost."""
        with suppress(queue.Empty):
            while True:
                samples, captured_s, overflow = self._pieces.get(wait_s > 0.0, wait_s)
                wait_s = 0.0
                if overflow:
                    self.overflows += 1
                    voice.interrupt()
                self.pace.observe(len(samples) / self.rate_hz, captured_s)
                voice.push(samples, self.rate_hz, captured_s)
        self.check()

    @property
    def problem(self) -> str:
        """Return the fault of the pace in one line, or an empty string."""
        if (rate := self.pace.off) is None:
            return ""
        return (
            f"{self.device.name}: gives {rate:.2f} s of sound a second: its clock is wrong, or sound is lost on the "
            "way; use another port, rate or device"
        )

    def _called(self, samples: Floats, n: int, stamp: Any, status: Any) -> None:
        now_s = self._called_s = time.monotonic()
        adc_age_s = stamp.currentTime - stamp.inputBufferAdcTime if stamp.inputBufferAdcTime else None
        piece = np.where(np.abs(samples) < _DENORMAL, np.float32(0), samples)  # a copy: PortAudio reuses the array
        self._pieces.put((piece, captured_s(now_s, adc_age_s, n / self.rate_hz), bool(status.input_overflow)))
        self._flows.set()


def captured_s(now_s: float, first_age_s: float | None, length_s: float) -> float:
    """Return the time of `time.monotonic` at which the newest sample of a piece was captured, never after `now_s`.

    `first_age_s`: age of the first sample as the device reports it; for None or an impossible age, `now_s` is returned.
    """
    if first_age_s is None or not -length_s <= first_age_s <= _OLDEST_S:
        return now_s
    return min(now_s, now_s - first_age_s + length_s)


def portaudio(flag: str) -> ModuleType:
    """Return the module sounddevice. Raises ConfigError, which names the option `flag`, if PortAudio is missing."""
    try:
        import sounddevice
    except OSError as error:
        raise ConfigError(f"{flag} needs PortAudio: sudo apt-get install libportaudio2") from error
    module: ModuleType = sounddevice
    return module


def choose_device(devices: Sequence[SoundDevice], wanted: str, flag: str, plays: bool = False) -> SoundDevice:
    """Return the device with the number or name `wanted`, or the only one with it in its name; "": the default device.

    Raises PortError if there are no devices, ConfigError with the choices if `wanted` fits none or several.
    """
    if not devices:
        choices = "leave it out" if plays else ", ".join(("FILE.wav", *speaker_names(), "none"))
        missing = "loudspeaker" if plays else "microphone"
        raise PortError(f"{flag}: this computer has no {missing}, or its sound server does not run ({choices})")
    fitting = _fitting(devices, wanted)
    if len(fitting) == 1:
        return fitting[0]
    problem = "fits several devices" if fitting else "no such device"
    choices = ", ".join(device.label for device in fitting or devices)
    raise ConfigError(f"{flag}{' ' if plays else ':'}{wanted}: {problem} ({choices})")


def accepted_format(device: SoundDevice, channels: Sequence[int], check: Callable[..., None]) -> tuple[float, int]:
    """Return the first rate and channel count that the device accepts: 16 kHz first, `channels` in their order.

    The last combination is returned unchecked. `check`: sounddevice's check of input or output settings.
    """
    import sounddevice

    wishes = [(rate, count) for rate in (AUDIO_HZ, device.rate_hz) for count in channels]
    with device.selected():
        for rate_hz, count in wishes[:-1]:
            try:
                check(device.number, count, "float32", samplerate=rate_hz)
                return rate_hz, count
            except (sounddevice.PortAudioError, ValueError):
                continue
    return wishes[-1]


def why_not_opened(error: Exception) -> str:
    """Return PortAudio's message, or the usual causes if the device is busy or unavailable."""
    text = str(error.args[0] if error.args else error).rpartition(": ")[2].partition(" [")[0]
    busy = "unavailable" in text.casefold() or "busy" in text.casefold()
    return "another program holds it, or it was unplugged" if busy else text


def tell_devices(plays: bool) -> Generator[list[SoundDevice], Any, None]:
    """Yield the present devices; runs in a `SourceWorker`, because PortAudio prints messages."""
    yield listed_devices("a loudspeaker" if plays else "a microphone", plays)


def sound_devices(plays: bool = False) -> list[SoundDevice]:
    """Return devices that record, or those that play. Blocks for a second. Raises ConfigError without PortAudio."""
    worker = SourceWorker("sound devices", tell_devices, plays)
    try:
        worker.wait()
        return list(worker.messages(time.monotonic())[0])
    finally:
        worker.close()


def device_name(wanted: str, flag: str, plays: bool = False) -> str:
    """Return `wanted`, or the name of a device given by number: numbers change when a device is plugged in."""
    return choose_device(sound_devices(plays), wanted, flag, plays).name if wanted.isdigit() else wanted


def listed_devices(flag: str, plays: bool) -> list[SoundDevice]:
    """Return the devices that play, or those that record; blocks for some tenths of a second.

    PortAudio lists the devices that were present when it was loaded. Raises ConfigError without PortAudio.
    """
    sounddevice = portaudio(flag)
    channels = "max_output_channels" if plays else "max_input_channels"
    found = [
        SoundDevice(
            name=each["name"], number=each["index"], channels=each[channels], rate_hz=each["default_samplerate"],
            default=each["index"] == sounddevice.default.device[plays], plays=plays,
        )
        for each in sounddevice.query_devices()
        if each[channels] > 0
    ]  # fmt: skip
    server = next((device for device in found if device.name == _SERVER), None)
    if server is not None:
        found += [replace(server, name=name, default=False, of_server=True) for name in _names_of_server(plays)]
    return found


def _fitting(devices: Sequence[SoundDevice], wanted: str) -> list[SoundDevice]:
    if not wanted:
        return [device for device in devices if device.default] or list(devices[:1])
    if wanted.isdigit():
        return [device for device in devices if not device.of_server and str(device.number) == wanted]
    looks = (
        lambda name: name == wanted,
        lambda name: _HARDWARE.sub("", name) == _HARDWARE.sub("", wanted),
        lambda name: wanted.casefold() in name.casefold(),
    )
    for look in looks:
        if fitting := [device for device in devices if look(device.name)]:
            return fitting
    return []


def _names_of_server(plays: bool) -> list[str]:
    """Return the sound server's sinks or sources; none if its tool pactl is not installed, fails or does not answer."""
    words = ["pactl", "list", "short", "sinks" if plays else "sources"]
    try:
        listed = subprocess.run(words, capture_output=True, text=True, timeout=_PACTL_LIMIT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.split("\t")[1] for line in listed.stdout.splitlines() if "\t" in line]
