"""Sound devices that record: what PortAudio lists, and the sources of a sound server by the server's own names.

PulseAudio and PipeWire are one device to PortAudio ("pulse"). Which of their sources it opens is the environment
variable PULSE_SOURCE at that moment; monitors, what a loudspeaker is given, are such sources.
"""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Final

from sfms_robot.errors import ConfigError, PortError
from sfms_robot.sources.speakers import speakers

_SERVER: Final = "pulse"  # PortAudio's name for the device of a sound server
_HARDWARE: Final = re.compile(r" *\(hw:\d+(,\d+)?\)$")  # numbers that change when something is plugged in
_PACTL_LIMIT_S: Final = 5.0


@dataclass(frozen=True)
class SoundDevice:
    """A device that records.

    Attributes:
        name: as PortAudio or the sound server calls it.
        number: of PortAudio; another one when something was plugged in.
        inputs: channels at most.
        rate_hz: that it has without being asked for another.
        default: the one that records where none is named.
        server_source: it is this source of the sound server; None: a device of PortAudio's own.
    """

    name: str
    number: int
    inputs: int
    rate_hz: float
    default: bool = False
    server_source: str | None = None

    @property
    def label(self) -> str:
        """What a person may type for it, number first where it has one of its own."""
        return self.name if self.server_source else f"{self.number} {self.name}"

    @property
    def monitor(self) -> bool:
        """It records what a loudspeaker is given."""
        return self.server_source is not None and self.server_source.endswith(".monitor")

    @contextmanager
    def selected(self) -> Iterator[None]:
        """What is opened in here by `number` is this device. Not for several threads."""
        before = os.environ.pop("PULSE_SOURCE", None)
        if self.server_source:
            os.environ["PULSE_SOURCE"] = self.server_source
        elif before is not None:
            os.environ["PULSE_SOURCE"] = before
        try:
            yield
        finally:
            os.environ.pop("PULSE_SOURCE", None)
            if before is not None:
                os.environ["PULSE_SOURCE"] = before


def portaudio(flag: str) -> ModuleType:
    """The module sounddevice, its library loaded. Raises ConfigError where there is none; `flag` is who needs it."""
    try:
        import sounddevice
    except OSError as error:
        raise ConfigError(f"{flag} needs PortAudio: sudo apt-get install libportaudio2") from error
    module: ModuleType = sounddevice
    return module


def recording_devices(flag: str) -> list[SoundDevice]:
    """Those there are; blocks for some tenths of a second. PortAudio sees what was there when it was loaded.

    Raises ConfigError without PortAudio.
    """
    sounddevice = portaudio(flag)
    default = sounddevice.default.device[0]
    found = [
        SoundDevice(each["name"], each["index"], each["max_input_channels"], each["default_samplerate"],
                    each["index"] == default)
        for each in sounddevice.query_devices()
        if each["max_input_channels"] > 0
    ]  # fmt: skip
    server = next((device for device in found if device.name == _SERVER), None)
    if server is not None:
        found += [replace(server, name=name, default=False, server_source=name) for name in _server_sources()]
    return found


def choose_device(devices: Sequence[SoundDevice], wanted: str, flag: str) -> SoundDevice:
    """The device with this number, this name, or the only one with this in its name; "" is the default one.

    Raises PortError where nothing records, ConfigError for a name that is not there or fits several, with the choices.
    """
    if not devices:
        choices = ", ".join(("FILE.wav", *speakers(), "none"))
        raise PortError(f"{flag}: this computer has no microphone, or its sound server does not run ({choices})")
    fitting = _fitting(devices, wanted)
    if len(fitting) == 1:
        return fitting[0]
    problem = "fits several devices" if fitting else "no such device"
    choices = ", ".join(device.label for device in fitting or devices)
    raise ConfigError(f"{flag}:{wanted}: {problem} ({choices})")


def tell_devices(_: Any) -> Generator[list[SoundDevice], Any, None]:
    """For a `SourceWorker`: PortAudio, which prints what it likes, sees the devices of this moment."""
    yield recording_devices("a microphone")


def _fitting(devices: Sequence[SoundDevice], wanted: str) -> list[SoundDevice]:
    if not wanted:
        return [device for device in devices if device.default] or list(devices[:1])
    if wanted.isdigit():
        return [device for device in devices if not device.server_source and device.number == int(wanted)]
    looks = (
        lambda name: name == wanted,
        lambda name: _HARDWARE.sub("", name) == _HARDWARE.sub("", wanted),
        lambda name: wanted.casefold() in name.casefold(),
    )
    for look in looks:
        if fitting := [device for device in devices if look(device.name)]:
            return fitting
    return []


def _server_sources() -> list[str]:
    """By name; none where the server's own tool is not installed, or does not answer."""
    try:
        told = subprocess.run(
            ["pactl", "list", "short", "sources"], capture_output=True, text=True, timeout=_PACTL_LIMIT_S, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.split("\t")[1] for line in told.stdout.splitlines() if "\t" in line]
