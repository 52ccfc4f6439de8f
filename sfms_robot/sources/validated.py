"""What every source hands on, whoever wrote it: 640 finite samples or none, a finite face or none, on a grid of 40 ms.

A listener counts frames and keeps what it hears for seconds, so one NaN would stay with it for good. Everything between
a source and a listener may rely on what is judged here.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Final

import numpy as np

from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_SAMPLES, FaceFrame, Floats, SpeakerFrame
from sfms_robot.ports import Source
from sfms_robot.signals.attention import AttentionState, attend

logger = logging.getLogger(__name__)

_NONE: Final = np.zeros(0, dtype=np.float32)


class ValidatedSource:
    """`ports.Source` around another: what cannot be used is left out, counted, and named once in the log.

    Frame i carries time (i + 1) x 40 ms whatever the inner source says. Where it does not tell the person's attention,
    their face does.
    """

    def __init__(self, inner: Source) -> None:
        self._inner = inner
        self._given = 0
        self._attention = AttentionState()
        self._left_out: dict[str, int] = {}

    @property
    def duration_s(self) -> float | None:
        return self._inner.duration_s

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        """Raises what the inner source raises."""
        return [self._frame(frame) for frame in self._inner.read(now_s)]

    def close(self) -> None:
        self._inner.close()

    def statistics(self) -> dict[str, int]:
        """Frames so far, and of how many the voice, the face or the robot's own voice was left out."""
        return {"frames": self._given, **self._left_out}

    def _frame(self, frame: SpeakerFrame) -> SpeakerFrame:
        self._given += 1
        time_s = self._given / FRAME_HZ
        audio = self._samples("voice", frame.audio)
        says = None if frame.agent_audio is None else self._samples("robot's voice", frame.agent_audio)
        face = self._face(time_s, frame.face)
        if face is None:
            return SpeakerFrame(time_s, audio, None, says)
        place_m = self._place(frame.place_m)
        attention = frame.attention
        if attention is None:
            attention, self._attention = attend(face, place_m, self._attention)
        return SpeakerFrame(time_s, audio, face, says, attention, place_m)

    def _place(self, given: Floats | None) -> Floats | None:
        if given is None:
            return None
        place_m = np.asarray(given, dtype=np.float32)
        if place_m.shape != (3,) or not np.isfinite(place_m).all():
            self._leave_out("place", f"{place_m} is no point in metres")
            return None
        return place_m

    def _samples(self, what: str, given: Floats) -> Floats:
        samples = np.asarray(given, dtype=np.float32)
        if samples.shape == (0,):
            return samples
        if samples.shape != (FRAME_SAMPLES,):
            self._leave_out(what, f"shape {samples.shape}, not ({FRAME_SAMPLES},)")
            return _NONE
        if not np.isfinite(samples).all():
            self._leave_out(what, "samples that are not finite")
            return _NONE
        clipped: Floats = np.clip(samples, -1.0, 1.0)
        return clipped

    def _face(self, time_s: float, face: FaceFrame | None) -> FaceFrame | None:
        if face is None:
            return None
        pose, shapes = np.asarray(face.pose, dtype=np.float32), np.asarray(face.blendshapes, dtype=np.float32)
        jaw = None if face.jaw_rad is None else np.asarray(face.jaw_rad, dtype=np.float32)
        if pose.shape != (6,) or shapes.shape != (len(BLENDSHAPES),) or (jaw is not None and jaw.shape != (3,)):
            self._leave_out("face", f"pose {pose.shape} and blendshapes {shapes.shape}, not (6,) and (52,)")
            return None
        if not all(np.isfinite(part).all() for part in (pose, shapes, *(() if jaw is None else (jaw,)))):
            self._leave_out("face", "values that are not finite")
            return None
        return FaceFrame(time_s, pose, np.clip(shapes, 0.0, 1.0), jaw)

    def _leave_out(self, what: str, why: str) -> None:
        if what not in self._left_out:
            logger.warning("source: frame %d: %s left out: %s (said once)", self._given - 1, what, why)
        self._left_out[what] = self._left_out.get(what, 0) + 1
