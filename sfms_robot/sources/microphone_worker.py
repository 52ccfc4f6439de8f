"""The microphone's own process: PortAudio's callbacks in, frames of the loop out, the robot's own voice taken out.

A device that gives nothing for `LOST_S` went away: the process ends with that, and the one that is started in its place
begins with a PortAudio that sees the devices of that moment. So it goes on until the device is back.
"""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Generator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.errors import PortError
from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, Floats
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES
from sfms_robot.signals.own_voice_gate import OwnVoiceGate
from sfms_robot.sources.live_voice import LiveVoice
from sfms_robot.sources.sound_devices import (
    BLOCK_S,
    DeviceStream,
    SoundDevice,
    choose_device,
    listed_devices,
    portaudio,
    started_stream,
)

LOST_S: Final = 0.2
STATISTICS_S: Final = 1.0
_ALIVE_S: Final = 0.1
_LATENCY_S: Final = 0.06  # asked of the device; with less, a sound server's stream seldom starts
_START_LIMIT_S: Final = 0.3
_OLDEST_S: Final = 1.0  # a time stamp that is further away is of another clock
_DENORMAL: Final = np.finfo(np.float32).tiny  # what is smaller costs four times the processor
_MIXED: Final = 2  # channels; of more the first is taken, where arrays put what they made of the others
LONGEST_WAIT_S: Final = 0.15  # for the microphone, from the end of a frame: later it is of no use to the loop
REFERENCE_WAIT_S: Final = 0.1
_SILENCE: Final = np.zeros(FRAME_SAMPLES, dtype=np.float32)
_SILENCE.flags.writeable = False


@dataclass(frozen=True)
class Recording:
    """What to record: a device by number, name or part of its name, "" for the default one, and for whom.

    Attributes:
        flag: how errors call it, "--audio mic".
        reference: what the loudspeaker is given, as a device; None for none.
        told: the parent tells what the robot says (`Told.said`).
    """

    device: str
    flag: str
    reference: str | None = None
    reference_flag: str = ""
    told: bool = False


@dataclass(frozen=True)
class Opened:
    """The first message."""

    device: str
    rate_hz: float
    channels: int


@dataclass(frozen=True)
class Told:
    """From the parent.

    Attributes:
        origin_s: loop time 0 in seconds of `time.monotonic`.
        first, said: (n x 640,) what the robot says from frame `first` on: the newest frames, as it may miss some.
        speed_rad_s: how fast its joints move, all together.
    """

    origin_s: float
    first: int = 0
    said: Floats | None = None
    speed_rad_s: float = 0.0


@dataclass(frozen=True)
class Heard:
    """A frame of the loop.

    Attributes:
        index: of the frame.
        known_s: when it was known, `time.monotonic`.
        audio: (640,) what the person said.
        voice: a person speaks in it.
        said: (640,) what the robot said meanwhile, where a device tells; it comes as late as `audio`.
    """

    index: int
    known_s: float
    audio: Floats
    voice: bool
    said: Floats | None = None


Message = Opened | Heard | dict[str, Any]


def listen(recording: Recording) -> Generator[Message | None, Told | None, None]:
    """Frames of a microphone, once a second its statistics; see `sources.worker`.

    Raises ConfigError for a device that is not there and without PortAudio, PortError where nothing records, for a
    device that cannot be opened, and when one goes away.
    """
    with ExitStack() as stack:
        mic = stack.enter_context(open_capture(recording.device, recording.flag))
        said = None
        if recording.reference is not None:
            said = stack.enter_context(open_capture(recording.reference, recording.reference_flag))
        reference = ToldSpeech() if recording.told else None if said is None else LiveVoice()
        front_end = FrontEnd(reference)
        told = yield Opened(mic.device.name, mic.rate_hz, mic.channels)
        before: Told | None = None
        said_s = next_statistics_s = 0.0
        while True:
            mic.pass_on(front_end.mic, 2 * BLOCK_S)
            if said is not None and isinstance(reference, LiveVoice):
                said.pass_on(reference, 0.0)
            if told is not None and told is not before:
                if before is None or told.origin_s != before.origin_s:
                    front_end.start(told.origin_s, time.monotonic())
                if isinstance(reference, ToldSpeech) and told.said is not None:
                    reference.tell(told.first, told.said)
                front_end.speed_rad_s = told.speed_rad_s
                before = told
            messages: list[Message | None] = [*front_end.frames(time.monotonic())]
            if (now_s := time.monotonic()) >= next_statistics_s:
                next_statistics_s = now_s + STATISTICS_S
                messages.append({**front_end.statistics(), "overflows": mic.overflows})
            elif not messages and (before is None or recording.told or now_s > said_s + _ALIVE_S):
                messages.append(None)  # and hear what the parent tells
            for message in messages:
                told, said_s = (yield message), now_s


class Capture(DeviceStream):
    """A device that records into a queue, by callbacks in a thread of PortAudio's.

    Attributes:
        overflows: times that PortAudio lost samples.
    """

    def __init__(self, device: SoundDevice, rate_hz: float, channels: int) -> None:
        super().__init__(device, rate_hz, channels)
        self.overflows = 0
        self._pieces: queue.SimpleQueue[tuple[Floats, float, bool]] = queue.SimpleQueue()
        self._heard_s = time.monotonic()

    def start(self) -> bool:
        """Open the stream; whether it records. Raises PortAudio's errors."""
        import sounddevice

        self._open(sounddevice.InputStream, _LATENCY_S, self._called)
        try:
            self._pieces.get(timeout=_START_LIMIT_S)
        except queue.Empty:
            self.close()
            return False
        return True

    def pass_on(self, voice: LiveVoice, wait_s: float) -> None:
        """All that was recorded, to `voice`; waits so long for something. Raises PortError when it went away."""
        try:
            piece = self._pieces.get(timeout=wait_s) if wait_s else self._pieces.get_nowait()
            while True:
                samples, captured_s, overflow = piece
                if overflow:
                    self.overflows += 1
                    voice.interrupt()
                voice.push(samples, self.rate_hz, captured_s)
                piece = self._pieces.get_nowait()
        except queue.Empty:
            if time.monotonic() - self._heard_s > LOST_S:
                raise PortError(f"{self.device.name} gives no more sound") from None

    def _called(self, samples: Floats, n: int, stamp: Any, status: Any) -> None:
        now_s = self._heard_s = time.monotonic()
        adc_age_s = stamp.currentTime - stamp.inputBufferAdcTime if stamp.inputBufferAdcTime else None
        used = samples[:, :1] if self.channels > _MIXED else samples
        piece = np.where(np.abs(used) < _DENORMAL, np.float32(0), used)  # a copy: PortAudio writes there again
        self._pieces.put((piece, captured_s(now_s, adc_age_s, n / self.rate_hz), bool(status.input_overflow)))


def captured_s(now_s: float, first_age_s: float | None, length_s: float) -> float:
    """When the newest sample of a piece came, `time.monotonic`, never after `now_s`.

    `first_age_s`: how old the device says that its first one is; None, or what cannot be: it came just now.
    """
    if first_age_s is None or not -length_s <= first_age_s <= _OLDEST_S:
        return now_s
    return min(now_s, now_s - first_age_s + length_s)


def open_capture(wanted: str, flag: str) -> Capture:
    """Open the device that is wanted, recording: at 16 kHz and mono where it takes that, else as it is.

    Blocks until sound comes, some tenths of a second. Raises ConfigError, PortError; see `listen`.
    """
    sounddevice = portaudio(flag)
    devices = listed_devices(flag, "source")
    device = choose_device(devices, wanted, flag)
    capture = started_stream(Capture, device, (1, device.channels), sounddevice.check_input_settings, flag)
    if capture is None:
        others = ", ".join(each.label for each in devices if each is not device) or "there is no other"
        raise PortError(f"{flag}: {device.name} is open, but gives no sound ({others})")
    return capture


# --- from what is recorded to what a person said, on the grid of the loop -----------------------------------------
#
#     pieces by their time stamps -> frames of 40 ms -> what the robot itself says taken out -> `Heard`
#
# Microphone and reference each drift by their own clock; both are resampled to the computer's (`LiveVoice`), so that
# they stay together. The echo canceller is a few milliseconds late: its frames begin that much later, so that its
# output is the frames of the loop, and nothing waits for the next one.


class ToldSpeech:
    """What the robot says, in frames of the loop, told one frame before they are played."""

    def __init__(self) -> None:
        self._first = 0  # sample of the loop
        self._samples: Floats = _SILENCE[:0]

    def start(self, origin_s: float) -> None:
        """They are counted from the origin already."""

    def tell(self, first: int, samples: Floats) -> None:
        """(n x 640,) from frame `first` on; the newest replace what was told before."""
        self._first, self._samples = first * FRAME_SAMPLES, samples

    def take(self, index: int) -> Floats | None:
        """(640,) of a frame of the echo canceller, which begins that much later than the loop's; None: not told yet."""
        begin = index * FRAME_SAMPLES + ECHO_LATENCY_SAMPLES - self._first
        if begin + FRAME_SAMPLES > len(self._samples):
            return None
        frame = _SILENCE.copy()
        known = min(max(0, -begin), FRAME_SAMPLES)
        frame[known:] = self._samples[begin + known : begin + FRAME_SAMPLES]
        return frame


class FrontEnd:
    """One microphone and, where the robot speaks, its voice. Belongs to one thread.

    Args:
        reference: what the robot says: a `LiveVoice` of what its loudspeaker is given, or what it is told.

    Attributes:
        mic: push its pieces here.
        speed_rad_s: how fast the head's joints move, all together: what their motors are heard by.
    """

    def __init__(self, reference: LiveVoice | ToldSpeech | None = None) -> None:
        self.mic = LiveVoice()
        self.speed_rad_s = 0.0
        self._reference = reference
        self._gate = OwnVoiceGate(speaks=reference is not None)
        self._origin_s: float | None = None
        self._next = 0
        self._waiting: Floats | None = None  # of the microphone, for its reference
        self._counts = {"voice_frames": 0, "own_voice_frames": 0, "without_reference": 0}

    def start(self, origin_s: float, now_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`; frames that ended before `now_s` are not given."""
        begins_s = origin_s + self._gate.latency_s
        self.mic.start(begins_s)
        if self._reference is not None:
            self._reference.start(begins_s)
        self._origin_s, self._waiting = origin_s, None
        self._next = max(0, math.floor((now_s - origin_s) * FRAME_HZ))

    def frames(self, now_s: float) -> list[Heard]:
        """Frames that are whole, oldest first; one whose microphone is missing for too long is left out."""
        frames: list[Heard] = []
        while self._origin_s is not None:
            late_s = now_s - self._origin_s - (self._next + 1) * FRAME_S
            if self._waiting is None:
                self._waiting = self.mic.take(self._next)
            if self._waiting is None and late_s < LONGEST_WAIT_S:
                break
            said = None if self._reference is None else self._reference.take(self._next)
            if self._reference is not None and said is None and late_s < REFERENCE_WAIT_S:
                break
            heard = self._judge(now_s, self._waiting, said)
            if self._waiting is not None:
                frames.append(heard)
            self._next, self._waiting = self._next + 1, None
        return frames

    def statistics(self) -> Mapping[str, Any]:
        """Of the microphone as `LiveVoice`; frames with a voice; where there is a reference, what it is like, frames
        in which the robot spoke, and frames whose reference was not there in time.
        """
        told: dict[str, Any] = {**self.mic.statistics(), "voice_frames": self._counts["voice_frames"]}
        if self._reference is not None:
            told |= self._counts
        if isinstance(self._reference, LiveVoice):
            told["reference"] = dict(self._reference.statistics())
        return told

    def _judge(self, now_s: float, mic: Floats | None, said: Floats | None) -> Heard:
        """One frame in, one frame out: the gate counts samples."""
        own = None if self._reference is None else (_SILENCE if said is None else said)
        (frame,) = self._gate.push(_SILENCE if mic is None else mic, own, self.speed_rad_s)
        self._counts["voice_frames"] += frame.voice
        self._counts["own_voice_frames"] += own is not None and bool(own.any())
        self._counts["without_reference"] += own is not None and said is None
        own_said = said if isinstance(self._reference, LiveVoice) else None
        return Heard(self._next, now_s, frame.audio, frame.voice, own_said)
