"""The microphone, `--audio mic[:DEVICE]`, and the robot's voice as a device records it, `--agent-audio device:DEVICE`.

PortAudio, resampling and echo cancellation run in a separate process (`listen`), which sends frames of the loop. A
device without sound for a fifth of a second is lost: the process ends and is started again, with a PortAudio that lists
the devices of that moment, until the device is back.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.data import Report
from sfms_robot.errors import NOTE, Said
from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_S, FRAME_SAMPLES, SILENCE, Floats
from sfms_robot.ports import Facts, Voice
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES
from sfms_robot.signals.own_voice_gate import OwnVoiceGate
from sfms_robot.sources.live_voice import LiveVoice, latency_after, window
from sfms_robot.sources.sound_devices import BLOCK_S, Capture, device_name
from sfms_robot.sources.worker import SourceWorker

logger = logging.getLogger(__name__)

MIC_FLAG: Final = "--audio mic"
DEVICE_FLAG: Final = "--agent-audio device"
STATISTICS_S: Final = 1.0
LINES: Final = "lines"  # key in the statistics: lines for the run to log, because the worker has no log
LONGEST_WAIT_S: Final = 0.15  # longest wait for the microphone from the end of a frame; later the loop cannot use it
REFERENCE_WAIT_S: Final = 0.1
SAID_FRAMES: Final = 12  # frames of the robot's voice in a message: the worker may miss half a second of messages
KEPT_FRAMES: Final = 50
_ALIVE_S: Final = 0.1
_NEW_SPEED_RAD_S: Final = 0.1  # least change of speed that is sent


# --- the worker's side -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A device to record: its number, name or part of its name; "" for the default device.

    Attributes:
        flag: the option named in errors, "--audio mic".
        reference: device that records the signal of the loudspeaker, or None.
        spoken: True if the parent sends the robot's voice (`ToWorker.said`).
    """

    device: str
    flag: str
    reference: str | None = None
    spoken: bool = False


@dataclass(frozen=True)
class ToWorker:
    """A message from the parent.

    Attributes:
        origin_s: loop time 0 in seconds of `time.monotonic`.
        first, said: (n x 640,) the robot's voice from frame `first` on; several frames, because messages may be missed.
        speed_rad_s: summed speed of the head's joints.
    """

    origin_s: float
    first: int = 0
    said: Floats | None = None
    speed_rad_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class MicrophoneFrame:
    """A frame of the loop.

    Attributes:
        index: index of the frame.
        known_s: time of `time.monotonic` at which it was known.
        audio: (640,) the person's voice.
        said: (640,) the robot's voice at the same time if a device records it, else None; as late as `audio`.
    """

    index: int
    known_s: float
    audio: Floats
    said: Floats | None = None


MicrophoneMessage = str | MicrophoneFrame | Report  # the first is the name of the device


def listen(recording: Recording) -> Generator[MicrophoneMessage | None, ToWorker | None, None]:
    """Yield frames of a microphone, and once a second its statistics; see `sources.worker`.

    Raises ConfigError for an unknown device or if PortAudio is missing; PortError if no device records, or if a device
    cannot be opened or is lost.
    """
    with ExitStack() as stack:
        mic = stack.enter_context(closing(Capture.opened(recording.device, recording.flag)))
        said = None
        if recording.reference is not None:
            said = stack.enter_context(closing(Capture.opened(recording.reference, DEVICE_FLAG)))
        reference = SpeechFrames() if recording.spoken else None if said is None else LiveVoice()
        front_end = FrontEnd(reference, mic.device.name)
        given = yield mic.device.name
        before: ToWorker | None = None
        said_s = next_statistics_s = 0.0
        while True:
            mic.pass_on(front_end.mic, 2 * BLOCK_S)
            if said is not None and isinstance(reference, LiveVoice):
                said.pass_on(reference, 0.0)
            if given is not None and given is not before:
                if before is None or given.origin_s != before.origin_s:
                    front_end.start(given.origin_s, time.monotonic())
                if isinstance(reference, SpeechFrames) and given.said is not None:
                    reference.set(given.first, given.said)
                front_end.speed_rad_s = given.speed_rad_s
                before = given
            messages: list[MicrophoneMessage | None] = [*front_end.frames(time.monotonic())]
            if (now_s := time.monotonic()) >= next_statistics_s:
                next_statistics_s = now_s + STATISTICS_S
                lines = {"mix": front_end.mic.mix.line, "pace": mic.problem}
                pace = None if mic.pace.rate is None else round(mic.pace.rate, 3)
                messages.append({**front_end.statistics(), "overflows": mic.overflows, "pace": pace, LINES: lines})
            elif not messages and (before is None or recording.spoken or now_s > said_s + _ALIVE_S):
                messages.append(None)  # yield, to receive messages of the parent
            for message in messages:
                given, said_s = (yield message), now_s


# --- from recorded sound to a person's voice, on the grid of the loop ---------------------------------------------
#
#     pieces by their time stamps -> frames of 40 ms -> the robot's own voice removed -> `MicrophoneFrame`
#
# Microphone and reference drift, each with its own clock; both are resampled to the computer's clock (`LiveVoice`), so
# that they stay together. The echo canceller is a few milliseconds late. Its input frames begin that much later, so
# that its output is on the frames of the loop, and no frame waits for the next one.


class SpeechFrames:
    """Speech of the robot in frames of the loop, each known one frame before it is played."""

    _first = 0  # sample of the loop
    _samples: Floats = SILENCE[:0]

    def start(self, origin_s: float) -> None:
        """Do nothing: the frames are counted from loop time 0 already."""

    def set(self, first: int, samples: Floats) -> None:
        """Set the samples (n x 640,) from frame `first` on, which replace the earlier ones."""
        self._first, self._samples = first * FRAME_SAMPLES, samples

    def take(self, index: int) -> Floats | None:
        """Return the samples (640,) of a frame, shifted by the latency of the echo canceller; None: not known yet."""
        begin = index * FRAME_SAMPLES + ECHO_LATENCY_SAMPLES - self._first
        if begin + FRAME_SAMPLES > len(self._samples):
            return None
        return window(0, self._samples, begin)


class FrontEnd:
    """Processing of one microphone and, if the robot speaks, of its voice. Belongs to one thread.

    Args:
        reference: the robot's voice: a `LiveVoice` of the signal of its loudspeaker, or frames from the parent.
        name: name of the device in log lines.

    Attributes:
        mic: voice that receives the microphone's pieces by `push`.
        speed_rad_s: summed speed of the head's joints, which determines the expected noise of their motors.
    """

    def __init__(self, reference: LiveVoice | SpeechFrames | None = None, name: str = "microphone") -> None:
        self.mic = LiveVoice(name=name)
        self.speed_rad_s = 0.0
        self._reference = reference
        self._gate = OwnVoiceGate(speaks=reference is not None)
        self._origin_s: float | None = None
        self._next = 0
        self._waiting: Floats | None = None  # frame of the microphone that waits for its reference
        self._counts = {"voice_frames": 0, "own_voice_frames": 0, "without_reference": 0}

    def start(self, origin_s: float, now_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`; frames that ended before `now_s` are skipped."""
        begins_s = origin_s + self._gate.latency_s
        self.mic.start(begins_s)
        if self._reference is not None:
            self._reference.start(begins_s)
        self._origin_s, self._waiting = origin_s, None
        self._next = max(0, math.floor((now_s - origin_s) * FRAME_HZ))

    def frames(self, now_s: float) -> list[MicrophoneFrame]:
        """Return complete frames, oldest first; a frame whose microphone sound is too late is left out."""
        frames: list[MicrophoneFrame] = []
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

    def statistics(self) -> Facts:
        """Return the statistics of the microphone (`LiveVoice`) and the number of frames with a voice.

        With a reference also its own statistics if it is a `LiveVoice`, and the numbers of frames in which the robot
        spoke and of frames whose reference came too late.
        """
        figures: Report = {**self.mic.statistics(), "voice_frames": self._counts["voice_frames"]}
        if self._reference is not None:
            figures |= self._counts
        if isinstance(self._reference, LiveVoice):
            figures["reference"] = dict(self._reference.statistics())
        return figures

    def _judge(self, now_s: float, mic: Floats | None, said: Floats | None) -> MicrophoneFrame:
        """Return a frame without the robot's own voice; every frame is passed, because the gate counts samples."""
        own = None if self._reference is None else (SILENCE if said is None else said)
        (frame,) = self._gate.push(SILENCE if mic is None else mic, own, self.speed_rad_s)
        self._counts["voice_frames"] += frame.voice
        self._counts["own_voice_frames"] += own is not None and bool(own.any())
        self._counts["without_reference"] += own is not None and said is None
        own_said = said if isinstance(self._reference, LiveVoice) else None
        return MicrophoneFrame(index=self._next, known_s=now_s, audio=frame.audio, said=own_said)


# --- the run's side --------------------------------------------------------------------------------------------------


class Microphone:
    """A `ports.Voice` of the frames from the worker `listen`. Only `close` blocks.

    Args:
        early_s: time by which the robot's own voice is sent earlier; None: it is not passed in by calls.

    Attributes:
        own_voice: function that receives the robot's voice in frame i, (640,) or None, in order from frame 1 on; None
            if the voice is not passed in by calls.
        device: name of the device.
        latency_s: recent longest time from the end of a frame until the worker had it.
    """

    duration_s: float | None = None

    def __init__(self, worker: SourceWorker, early_s: float | None = None) -> None:
        self._worker = worker
        self.own_voice = None if early_s is None else self._take_own_voice
        self._early = round((early_s or 0.0) * AUDIO_HZ)
        self._own = deque[Floats]([SILENCE], maxlen=SAID_FRAMES)
        self._origin_s: float | None = None
        self._frames: dict[int, MicrophoneFrame] = {}
        self.device = ""
        self.latency_s = 0.0
        self._late_frames = 0
        self._figures: Facts = {}
        self._logged = Said()
        self._said: dict[int, Floats | None] = {}
        self._speed_rad_s = self._sent_speed_rad_s = 0.0
        self._collect(time.monotonic(), 0)

    @property
    def lost(self) -> bool:
        """True if it delivered sound before and has stopped."""
        return self._worker.lost

    def start(self, origin_s: float) -> None:
        self._origin_s = origin_s
        self._worker.tell(ToWorker(origin_s))

    def take(self, index: int) -> Floats | None:
        """Return the samples of a frame; see `ports.Voice`."""
        if self._origin_s is None:
            return None
        if self.own_voice is None and abs(self._speed_rad_s - self._sent_speed_rad_s) > _NEW_SPEED_RAD_S:
            self._tell(self._origin_s)
        self._collect(self._origin_s + (index + 1) * FRAME_S, index)
        heard = self._frames.pop(index, None)
        self._said[index] = None if heard is None else heard.said
        self._said.pop(index - 2, None)
        return None if heard is None else heard.audio

    def moves(self, speed_rad_s: float) -> None:
        """Set the summed speed of the head's joints, which determines the expected noise of their motors."""
        self._speed_rad_s = speed_rad_s

    def _take_own_voice(self, index: int, said: Floats | None) -> None:
        """Send the worker the robot's voice in a frame, with the frames before it.

        The samples sent are shifted earlier by `early_s`, with silence at the end.
        """
        self._own.append(SILENCE if said is None else said)
        if self._origin_s is not None:
            samples = np.concatenate([*self._own, SILENCE[: self._early]])[self._early :]
            self._tell(self._origin_s, index + 1 - len(self._own), samples)

    def _tell(self, origin_s: float, first: int = 0, said: Floats | None = None) -> None:
        self._sent_speed_rad_s = self._speed_rad_s
        self._worker.tell(ToWorker(origin_s, first, said, self._speed_rad_s))

    def said(self, index: int) -> Floats | None:
        """Return the recorded signal of the loudspeaker in a frame that was taken just now."""
        return self._said.get(index)

    def statistics(self) -> Facts:
        """Return device, latency, frames that came too late, state of the worker, and statistics of the sound."""
        return {
            "device": self.device,
            **self._worker.statistics(),
            **self._figures,
            "latency_ms": round(self.latency_s * 1e3, 1),
            "late_frames": self._late_frames,
        }

    def close(self) -> None:
        self._worker.close()

    def _collect(self, now_s: float, wanted: int) -> None:
        for old in [index for index in self._frames if index < wanted]:
            del self._frames[old]
        for message in self._worker.messages(now_s):
            if isinstance(message, MicrophoneFrame):
                self._take_in(message, wanted)
            elif isinstance(message, str):
                self.device = message
            else:
                for about, line in message.pop(LINES, {}).items():
                    if line and self._logged.first(about):
                        logger.warning("%s (said once)", line)
                self._figures = message

    def _take_in(self, heard: MicrophoneFrame, wanted: int) -> None:
        assert self._origin_s is not None
        late_s = heard.known_s - self._origin_s - (heard.index + 1) * FRAME_S
        self.latency_s = latency_after(late_s, self.latency_s)
        if wanted <= heard.index < wanted + KEPT_FRAMES:
            self._frames[heard.index] = heard
        else:
            self._late_frames += 1


class Loudspeaker:
    """A `ports.Voice` of the robot's voice as a device records it; late, as any recording.

    Args:
        recorder: the microphone whose worker also records this voice, or a `Microphone` for this voice alone.
    """

    duration_s: float | None = None
    latency_s = 0.0

    def __init__(self, recorder: Microphone, beside: bool) -> None:
        self._recorder, self._beside = recorder, beside
        self.start, self.close = recorder.start, recorder.close

    @property
    def lost(self) -> bool:
        return self._recorder.lost

    def take(self, index: int) -> Floats | None:
        """Return the sound recorded one frame before with the microphone, or two frames before without one."""
        return self._recorder.said(index - 1) if self._beside else self._recorder.take(index - 2)

    def statistics(self) -> Facts:
        figures = self._recorder.statistics()
        return figures.get("reference", {}) if self._beside else figures


def open_microphone(argument: str, agent: Voice | None = None) -> Microphone:
    """Open `--audio mic[:DEVICE]`: a number, a name or a part of one; "" is the default.

    The voice of `agent` is removed from the sound; the microphone receives it by `own_voice`.
    Blocks until it records, a second. Raises ConfigError for an unknown device or if PortAudio is missing, PortError if
    there is no microphone or it cannot be opened.
    """
    return _opened(argument, MIC_FLAG, early_s=None if agent is None else getattr(agent, "early_s", 0.0))


def open_microphone_and_loudspeaker(argument: str, device: str) -> tuple[Microphone, Loudspeaker]:
    """Open a microphone whose sound lacks the robot's voice as recorded by `device`; return also that voice."""
    microphone = _opened(argument, MIC_FLAG, device_name(device, DEVICE_FLAG))
    return microphone, Loudspeaker(microphone, beside=True)


def open_loudspeaker(argument: str) -> Loudspeaker:
    """Open `--agent-audio device:DEVICE` without a microphone. Blocks and raises as `open_microphone`."""
    return Loudspeaker(_opened(argument, DEVICE_FLAG), beside=False)


def _opened(argument: str, flag: str, reference: str | None = None, early_s: float | None = None) -> Microphone:
    """Open the device of `flag`. `early_s`: the robot's voice is passed in by calls and sent this much earlier."""
    name, device = "microphone" if flag == MIC_FLAG else "loudspeaker", device_name(argument, flag)
    recording = Recording(device=device, flag=flag, reference=reference, spoken=early_s is not None)
    worker = SourceWorker(name, listen, recording)
    worker.wait()
    microphone = Microphone(worker, early_s)
    logger.log(NOTE, "%s: %s", name, microphone.device)
    return microphone
