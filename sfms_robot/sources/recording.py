"""A recorded person as a source: a sound file, a face track, or one of them, at 25 frames a second.

Frame i covers (i, i + 1) x 40 ms and carries the face at its end. A missing voice is empty audio, a missing face is
None: both are normal. A voice shorter than the run starts again after one second of silence.

What the robot itself says is told one frame early, as a program that speaks knows it: frame i carries the samples of
frame i + 1, for which a listener plans its lips while it hears frame i. When it ends, silence follows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, FaceFrame, Floats, SpeakerFrame
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.tracks import Track, read_track, resample
from sfms_robot.sources.speakers import recorded_files

_PAUSE_FRAMES = FRAME_HZ  # silence before a recording starts again
_EPS_FRAMES = 1e-6


class Recording:
    """`ports.Source` over arrays. Holds no time of its own: `read` is told it.

    audio: (n,) mono 16 kHz, or None. track: the face, or None. duration_s: length of the run; None for the length of
    what is recorded (and for ever when nothing is). loop: start again when the recording ends before the run does.
    """

    def __init__(
        self,
        audio: Floats | None,
        track: Track | None,
        duration_s: float | None = None,
        loop: bool = True,
        agent_audio: Floats | None = None,
    ) -> None:
        if duration_s is not None and not (math.isfinite(duration_s) and duration_s > 0):
            raise ConfigError(f"--duration = {duration_s:g}: a run lasts longer than 0 s")
        self._audio = audio
        self._agent_audio = agent_audio
        self._faces = None if track is None else resample(track, FRAME_HZ, start_s=FRAME_S).motion
        self._loop = loop
        self._given = 0
        self._recorded = _frames_recorded(audio, self._faces)
        recorded_s = (self._recorded or _frames_recorded(agent_audio, None)) * FRAME_S or None
        self._duration_s = recorded_s if duration_s is None else duration_s

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
        """Nothing is held open."""

    def _frame(self, index: int) -> SpeakerFrame:
        place = index % (self._recorded + _PAUSE_FRAMES) if self._loop and self._recorded else index
        time_s = (index + 1) / FRAME_HZ
        face = None
        if self._faces is not None and place < len(self._faces) and np.isfinite(self._faces[place]).all():
            face = FaceFrame.of(time_s, self._faces[place])
        heard = np.zeros(0, dtype=np.float32) if self._audio is None else _samples(self._audio, place)
        says = None if self._agent_audio is None else _samples(self._agent_audio, index + 1)
        return SpeakerFrame(time_s, heard, face, says)


def _samples(audio: Floats, frame: int) -> Floats:
    """(640,) of a frame, filled up with silence."""
    out = np.zeros(FRAME_SAMPLES, dtype=np.float32)
    part = audio[frame * FRAME_SAMPLES : (frame + 1) * FRAME_SAMPLES]
    out[: len(part)] = part
    return out


def _frames_recorded(audio: Floats | None, faces: Floats | None) -> int:
    """The voice decides where a recording ends; a face alone does for itself."""
    if audio is not None:
        return math.ceil(len(audio) / FRAME_SAMPLES)
    return 0 if faces is None else len(faces)


def open_source(
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
        None if files.audio is None else read_audio(files.audio),
        None if files.face is None else read_track(files.face),
        duration_s,
        loop,
        None if files.agent_audio is None else read_audio(files.agent_audio),
    )
