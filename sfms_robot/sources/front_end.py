"""From what a microphone records to what a person said, on the grid of the loop.

    pieces by their time stamps -> frames of 40 ms -> what the robot itself says taken out -> `Heard`

Microphone and reference each drift by their own clock; both are resampled to the computer's (`LiveVoice`), so that they
stay together. The echo canceller is a few milliseconds late: its frames begin that much later, so that what comes out
of it are the frames of the loop, and nothing waits for the next one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, Floats
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES
from sfms_robot.signals.own_voice_gate import OwnVoiceGate
from sfms_robot.sources.live_voice import LiveVoice

LONGEST_WAIT_S: Final = 0.15  # for the microphone, from the end of a frame: later it is of no use to the loop
REFERENCE_WAIT_S: Final = 0.1
_SILENCE: Final = np.zeros(FRAME_SAMPLES, dtype=np.float32)
_SILENCE.flags.writeable = False


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
