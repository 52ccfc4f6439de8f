"""A recorded person as a source: a sound file, a face track, or one of them, at 25 frames a second.

Frame i covers (i, i + 1) x 40 ms and carries the face at its end. A missing voice is empty audio, a missing face is
None: both are normal. A run lasts as long as the longer of voice and robot's voice; of one that is asked to last longer
the voice starts again after one second of silence.

What the robot itself says is told one frame early, as a program that speaks knows it: frame i carries the samples of
frame i + 1, for which a listener plans its lips while it hears frame i. When it ends, silence follows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, FaceFrame, Floats, SpeakerFrame
from sfms_robot.signals.audio import AudioFile
from sfms_robot.signals.tracks import Track, read_track, resample
from sfms_robot.sources.speakers import recorded_files

_PAUSE_FRAMES = FRAME_HZ  # silence before a recording starts again
_EPS_FRAMES = 1e-6


class Recording:
    """`ports.Source` over recordings. Holds no time of its own: `read` is told it.

    audio: (n,) mono 16 kHz, a file that is read as the run goes, or None. track: the face, or None. duration_s: length
    of the run; None for the length of what is recorded (and for ever when nothing is). loop: start again when the
    recording ends before a `duration_s` does.
    """

    def __init__(
        self,
        audio: Floats | AudioFile | None,
        track: Track | None,
        duration_s: float | None = None,
        loop: bool = True,
        agent_audio: Floats | AudioFile | None = None,
    ) -> None:
        if duration_s is not None and not (math.isfinite(duration_s) and duration_s > 0):
            raise ConfigError(f"--duration = {duration_s:g}: a run lasts longer than 0 s")
        self._audio = None if audio is None else _Frames(audio)
        self._agent_audio = None if agent_audio is None else _Frames(agent_audio)
        self._faces = None if track is None else resample(track, FRAME_HZ, start_s=FRAME_S).motion
        self._loop = loop and duration_s is not None
        self._given = 0
        # The voice decides where a recording ends; a face alone does for itself.
        faces = 0 if self._faces is None else len(self._faces)
        self._recorded = faces if self._audio is None else self._audio.count
        says = 0 if self._agent_audio is None else self._agent_audio.count
        self._duration_s = max(self._recorded, says) * FRAME_S or None if duration_s is None else duration_s

    @property
    def duration_s(self) -> float | None:
        """Length of the run; None for one without end."""
        return self._duration_s

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        """Frames complete at or before `now_s` and not given yet, oldest first."""
        complete = math.floor(now_s * FRAME_HZ + _EPS_FRAMES)
        if self._duration_s is not None:
            complete = min(complete, math.floor(self._duration_s * FRAME_HZ + _EPS_FRAMES))
        frames = [self._frame(index) for index in range(self._given, complete)]
        self._given = max(self._given, complete)
        return frames

    def close(self) -> None:
        """Give the files back. Idempotent."""
        for frames in (self._audio, self._agent_audio):
            if frames is not None:
                frames.close()

    def _frame(self, index: int) -> SpeakerFrame:
        place = index % (self._recorded + _PAUSE_FRAMES) if self._loop and self._recorded else index
        time_s = (index + 1) / FRAME_HZ
        face = None
        if self._faces is not None and place < len(self._faces) and np.isfinite(self._faces[place]).all():
            face = FaceFrame.of(time_s, self._faces[place])
        heard = np.zeros(0, dtype=np.float32) if self._audio is None else self._audio.at(place)
        says = None if self._agent_audio is None else self._agent_audio.at(index + 1)
        return SpeakerFrame(time_s, heard, face, says)


class _Frames:
    """A recorded voice by frames (640,), filled up with silence; asked in order, but for going back to the start."""

    def __init__(self, audio: Floats | AudioFile) -> None:
        self._audio = audio
        self._next = 0
        self.count = math.ceil((audio.length if isinstance(audio, AudioFile) else len(audio)) / FRAME_SAMPLES)

    def at(self, frame: int) -> Floats:
        out = np.zeros(FRAME_SAMPLES, dtype=np.float32)
        if frame < self.count:
            part = self._part(frame)
            out[: len(part)] = part
        return out

    def close(self) -> None:
        if isinstance(self._audio, AudioFile):
            self._audio.close()

    def _part(self, frame: int) -> Floats:
        if not isinstance(self._audio, AudioFile):
            return self._audio[frame * FRAME_SAMPLES : (frame + 1) * FRAME_SAMPLES]
        if frame < self._next:
            self._audio.rewind()
            self._next = 0
        self._audio.read((frame - self._next) * FRAME_SAMPLES)
        self._next = frame + 1
        return self._audio.read(FRAME_SAMPLES)


def open_recording(
    audio: str = "default",
    face: str = "auto",
    duration_s: float | None = None,
    loop: bool = True,
    agent_audio: str = "none",
) -> Recording:
    """What `--audio FILE|SPEAKER|none|default`, `--face FILE|none|auto` and `--agent-audio FILE|none` ask for.

    See `recorded_files`. Raises ConfigError for files that cannot be used.
    """
    files = recorded_files(audio, face, agent_audio)
    return Recording(
        None if files.audio is None else AudioFile(files.audio),
        None if files.face is None else read_track(files.face),
        duration_s,
        loop,
        None if files.agent_audio is None else AudioFile(files.agent_audio),
    )
