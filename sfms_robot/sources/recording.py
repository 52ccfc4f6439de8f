"""A recorded person: a sound file as a voice, a face track as a sight.

A run lasts as long as its recording. In a longer run the recording starts again after one second of silence, the face
together with its voice.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, SILENCE, FaceFrame, Floats, Sighting
from sfms_robot.signals.audio import AudioFile
from sfms_robot.signals.tracks import Track, resample
from sfms_robot.sources.live_voice import SourcePart, window

if TYPE_CHECKING:
    from sfms_robot.sources.push import Player

_PAUSE_FRAMES = FRAME_HZ  # silence before a recording starts again
_EPS_FRAMES = 1e-6


class RecordedVoice(SourcePart):
    """A `ports.Voice` of a file that is read during the run. Silence follows its end.

    loop: start the file again after a pause instead.

    Attributes:
        frames: number of frames; the last is filled up with silence.
    """

    def __init__(self, audio: AudioFile, loop: bool = False) -> None:
        super().__init__()
        self._audio = audio
        self._loop = loop
        self._next = 0
        self._ahead: dict[int, Floats] = {}
        self.frames = math.ceil(audio.length / FRAME_SAMPLES)
        self.duration_s: float | None = self.frames * FRAME_S

    def take(self, index: int) -> Floats:
        """Return the samples (640,) of any frame; reading in order is fastest."""
        known = self._ahead.pop(index, None)
        return self._frame(index) if known is None else known

    def upcoming(self, index: int) -> Floats:
        """Return the samples (640,) of a frame, which are kept until it is taken; see `Spoken`."""
        if index not in self._ahead:
            self._ahead[index] = self._frame(index)
        return self._ahead[index]

    def played_by(self, player: Player) -> None:
        """Do nothing: a recording does not change."""

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._audio.close()

    def _frame(self, index: int) -> Floats:
        frame = index % (self.frames + _PAUSE_FRAMES) if self._loop else index
        if frame >= self.frames:
            return SILENCE
        if frame < self._next:
            self._audio.rewind()
            self._next = 0
        self._audio.read((frame - self._next) * FRAME_SAMPLES)
        self._next = frame + 1
        return window(0, self._audio.read(FRAME_SAMPLES), 0)


class RecordedSight(SourcePart):
    """A `ports.Sight` of a face track, resampled to the ends of the frames.

    It has no face where the track has none, and after the end of the track.

    Args:
        frames: number of frames of its voice, with which it starts again; None: it has no voice.
    """

    def __init__(self, track: Track, loop: bool, frames: int | None) -> None:
        super().__init__()
        self._faces = resample(track, FRAME_HZ, start_s=FRAME_S).motion
        self._loop = loop
        self._frames = len(self._faces) if frames is None else frames
        self.duration_s: float | None = len(self._faces) * FRAME_S

    def at(self, time_s: float) -> Sighting | None:
        """Return the face of the frame that ends at `time_s`, or of the last one that ended before."""
        index = math.floor(time_s * FRAME_HZ + _EPS_FRAMES) - 1
        place = index % (self._frames + _PAUSE_FRAMES) if self._loop else index
        if not 0 <= place < len(self._faces) or not np.isfinite(self._faces[place]).all():
            return None
        return Sighting(FaceFrame.of((index + 1) / FRAME_HZ, self._faces[place]))
