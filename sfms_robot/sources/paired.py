"""The 40 ms grid, which joins a voice, a sight and the robot's own voice, each of any kind, to one source.

1. Frame i covers (i, i + 1) x 40 ms of loop time. Every index has exactly one frame, in order: listeners count frames.
2. A frame is returned as soon as its voice is complete. When that takes `ALLOWANCE_S` longer than the voice's latency,
   the frame is returned with empty audio (an overrun), and the rest of its voice is discarded. No frame waits longer
   than `LONGEST_WAIT_S`, because a plan reaches only a third of a second ahead.
3. The face is the newest one, or None if that is older than `FACE_S` at the end of the frame. A recorded face is no
   newer than the end of the frame. A live face may be up to one frame newer when the frame is returned late: a face
   does not wait for the voice, which arrives some tens of milliseconds late.
4. The robot's own voice comes one frame early, because a program that speaks has it in advance: frame i carries the
   samples of frame i + 1, for which a listener plans its lips while it processes frame i.
5. A sighting without an attention gets one computed from the face (`signals.attention`).
6. Values that are not finite or have the wrong shape are left out here, in one place: a single NaN would stay in the
   memory of a listener forever.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.data import Names, Report
from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    BLENDSHAPES,
    FRAME_HZ,
    FRAME_S,
    FRAME_SAMPLES,
    NO_SOUND,
    FaceFrame,
    Floats,
    Sighting,
    SpeakerFrame,
)
from sfms_robot.ports import Facts, Outlet, Sight, Source, Voice
from sfms_robot.signals.attention import AttentionState, attend
from sfms_robot.signals.events import CORNERS
from sfms_robot.signals.face_units import beyond
from sfms_robot.signals.quantiles import Quantiles
from sfms_robot.sources.live_voice import Pace

logger = logging.getLogger(__name__)

ALLOWANCE_S: Final = 0.04
LONGEST_WAIT_S: Final = 0.15
FACE_S: Final = 0.25  # a face that is older counts as lost
SMILED_FRAMES: Final = 1500  # a listener treats a smile of this length as the neutral look of the face
_SMILE: Final = 0.25
_EPS: Final = 1e-6  # tolerance, in frames or seconds


class PairedSource:
    """A `ports.Source` made of a voice and a sight; each may be None.

    Args:
        agent: the robot's own voice.
        duration_s: length of the run; None: that of the voice, or of the sight if there is no voice, but at least that
            of the robot's own voice.

    Attributes:
        duration_s: length of the run; None: without end.
        latency_s: see `ports.Voice`.
        missing: names of lost parts, of voice, face and agent_audio.
        outlets: outlets of the parts, each once.
    """

    def __init__(
        self,
        voice: Voice | None = None,
        sight: Sight | None = None,
        agent: Voice | None = None,
        duration_s: float | None = None,
    ) -> None:
        if duration_s is not None and not (math.isfinite(duration_s) and duration_s > 0):
            raise ConfigError(f"--duration = {duration_s:g}: a run lasts more than 0 s and ends")
        self.duration_s = _length_s(voice, sight, agent) if duration_s is None else duration_s
        self.latency_s = 0.0
        self.missing: Names = ()
        self._voice, self._sight, self._agent = voice, sight, agent
        parts: dict[str, Voice | Sight | None] = {"voice": voice, "face": sight, "agent_audio": agent}
        self._parts = {name: part for name, part in parts.items() if part is not None}
        behind = [getattr(part, "outlet", None) for part in self._parts.values()]
        self.outlets: Sequence[Outlet] = list(dict.fromkeys(each for each in behind if each is not None))
        self._judge = FrameJudge()
        self._given = 0
        self._says: tuple[int, Floats | None] = (0, None)  # index and samples of the newest frame of the robot's voice
        self._overruns = 0
        self._wait_ms = Quantiles()
        self._face_age_ms = Quantiles()

    def start(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`."""
        for part in self._parts.values():
            part.start(origin_s)

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        """Return frames that are due by `now_s` and complete, or too late to wait for; oldest first. Never blocks."""
        until_s = now_s if self.duration_s is None else min(now_s, self.duration_s)
        due = math.floor(until_s * FRAME_HZ + _EPS)
        frames: list[SpeakerFrame] = []
        while self._given < due:
            heard = self._heard(self._given, now_s)
            if heard is None:
                break
            frames.append(self._frame(self._given, heard, now_s))
            self._given += 1
        self.missing = tuple(name for name, part in self._parts.items() if part.lost)
        return frames

    def moves(self, speed_rad_s: float) -> None:
        """Pass the speed on to a microphone; see `ports.Source`."""
        if (moves := getattr(self._voice, "moves", None)) is not None:
            moves(speed_rad_s)

    def statistics(self) -> Facts:
        """Return statistics of the grid, and those of the parts under `voice`, `face` and `agent_audio`.

        frames, overruns (frames whose voice came too late), faces_lost (frames with no face or one that was too old),
        left_out (counts by kind of value), wait_ms (from the end of a frame until it was returned), face_age_ms (at the
        end of its frame).
        """
        figures: Report = {
            "frames": self._given,
            "overruns": self._overruns,
            "left_out": dict(self._judge.left_out),
            "wait_ms": self._wait_ms.report(p50=50, p99=99),
        }
        if self._sight is not None:
            figures["faces_lost"] = self._given - len(self._face_age_ms)
            figures["face_age_ms"] = self._face_age_ms.report(p50=50, p99=99)
        return figures | {name: dict(part.statistics()) for name, part in self._parts.items()}

    def close(self) -> None:
        """Close all parts. Idempotent."""
        for part in self._parts.values():
            part.close()

    def _heard(self, index: int, now_s: float) -> Floats | None:
        """Return the voice of a frame, empty if it is too late; None: the frame has to wait."""
        waited_s = max(0.0, now_s - (index + 1) / FRAME_HZ)
        heard: Floats | None = NO_SOUND
        if self._voice is not None:
            own_voice = getattr(self._voice, "own_voice", None)
            if own_voice is not None and self._says[0] <= index:
                own_voice(index + 1, self._own_voice(index + 1))
            heard, self.latency_s = self._voice.take(index), self._voice.latency_s
            if heard is None and waited_s < min(self.latency_s + ALLOWANCE_S, LONGEST_WAIT_S) - _EPS:
                return None
        self._wait_ms.add(waited_s * 1e3)
        if heard is None:
            self._overruns += 1
            return NO_SOUND
        return heard

    def _frame(self, index: int, heard: Floats, now_s: float) -> SpeakerFrame:
        time_s = seen_s = (index + 1) / FRAME_HZ
        if self._sight is not None and self._sight.duration_s is None:
            seen_s = min(max(now_s, time_s), time_s + FRAME_S)
        sighting = None if self._sight is None else self._sight.at(seen_s)
        if sighting is not None:
            age_s = time_s - sighting.face.time_s
            if age_s > FACE_S + _EPS:
                sighting = None
            else:
                self._face_age_ms.add(max(0.0, age_s * 1e3))
        return self._judge.frame(index, heard, sighting, self._own_voice(index + 1))

    def _own_voice(self, index: int) -> Floats | None:
        """Return the robot's voice in frame `index`; each frame is taken from its source only once."""
        if self._agent is not None and self._says[0] < index:
            self._says = (index, self._agent.take(index))
        return self._says[1]


class JudgedSource:
    """A `ports.Source` around a source of another package; checks its frames and numbers them as they come."""

    def __init__(self, inner: Source) -> None:
        """Raise ConfigError for an object that is not a source."""
        if missing := [name for name in _SOURCE if not hasattr(inner, name)]:
            raise ConfigError(f"{type(inner).__name__} lacks {', '.join(missing)}: derive it from sfms_robot.Source")
        self.duration_s = inner.duration_s
        self.latency_s = inner.latency_s
        self.missing: Names = ()
        self._inner = inner
        self.start, self.moves, self.close = inner.start, inner.moves, inner.close
        self.outlets: Sequence[Outlet] = tuple(getattr(inner, "outlets", ()))
        self._judge = FrameJudge()
        self._pace = Pace()
        self._given = 0

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        """Return the checked frames of the inner source; raises the errors that it raises."""
        frames: list[SpeakerFrame] = []
        for given in self._inner.read(now_s):
            seen = None if given.face is None else Sighting(given.face, given.attention, given.place_m)
            frames.append(self._judge.frame(self._given, given.audio, seen, given.agent_audio))
            self._given += 1
            self._pace.observe(FRAME_S, now_s)
        self._pace.warn_once(type(self._inner).__name__)
        self.latency_s, self.missing = self._inner.latency_s, tuple(self._inner.missing)
        return frames

    def statistics(self) -> Facts:
        """Return the number of frames, counts of values left out, and the inner source's own statistics."""
        return {"frames": self._given, "left_out": dict(self._judge.left_out), **self._inner.statistics()}


_SOURCE: Final = ("duration_s", "latency_s", "missing", "start", "read", "moves", "statistics", "close")


class FrameJudge:
    """Converter of unchecked values to frames on the grid: 640 finite samples or none, a finite face or none.

    Attributes:
        left_out: number of frames from which the voice, face, attention, place or robot's voice was left out, by kind;
            each kind is logged once.
    """

    def __init__(self) -> None:
        self.left_out = Counter[str]()
        self._smiled = 0
        self._attending = AttentionState()

    def frame(self, index: int, heard: Floats, seen: Sighting | None, says: Floats | None) -> SpeakerFrame:
        """Return frame `index` at its time on the grid; its face keeps the time of the sighting if plausible."""
        time_s = (index + 1) / FRAME_HZ
        audio = self._samples(index, "voice", heard)
        own_audio = None if says is None else self._samples(index, "robot's voice", says)
        face = None if seen is None else self._face(index, seen.face)
        if seen is None or face is None:
            return SpeakerFrame(time_s, audio, None, own_audio)
        self._smiled = self._smiled + 1 if face.motion[CORNERS].min() > _SMILE else 0
        if self._smiled == SMILED_FRAMES:
            logger.warning("source: the face has smiled for 60 s without a pause: it is not answered until it changes")
        place_m = self._finite(index, "place", seen.place_m, (3,))
        attention = seen.attention
        if attention is None or self._finite(index, "attention", attention, ()) is None:
            attention, self._attending = attend(face, place_m, self._attending)
        else:
            attention = min(max(float(attention), 0.0), 1.0)
        return SpeakerFrame(time_s, audio, face, own_audio, attention, place_m)

    def _samples(self, index: int, what: str, given: Floats) -> Floats:
        samples = NO_SOUND if np.shape(given) == (0,) else self._finite(index, what, given, (FRAME_SAMPLES,))
        return NO_SOUND if samples is None else np.clip(samples, -1.0, 1.0)

    def _face(self, index: int, face: FaceFrame) -> FaceFrame | None:
        pose = self._finite(index, "face", face.pose, (6,))
        shapes = None if pose is None else self._finite(index, "face", face.blendshapes, (len(BLENDSHAPES),))
        jaw = None if shapes is None else self._finite(index, "face", face.jaw_rad, (3,))
        if pose is None or shapes is None or (jaw is None) != (face.jaw_rad is None):
            return None
        if problem := beyond(np.concatenate([pose, shapes])):
            self._leave_out(index, "face", problem)
            return None
        end_s = (index + 1) / FRAME_HZ
        time_s = face.time_s if -FACE_S - _EPS <= face.time_s - end_s <= FRAME_S + _EPS else end_s
        return FaceFrame(time_s, pose, np.clip(shapes, 0.0, 1.0), jaw)

    def _finite(self, index: int, what: str, given: ArrayLike | None, shape: tuple[int, ...]) -> Floats | None:
        """Return finite values of this shape; None if none are given, or for others, which are counted as left out."""
        if given is None:
            return None
        values = np.asarray(given, dtype=np.float32)
        if values.shape == shape and np.isfinite(values).all():
            return values
        got = "values that are not finite" if values.shape == shape else f"shape {values.shape}, not {shape}"
        self._leave_out(index, what, got)
        return None

    def _leave_out(self, index: int, what: str, got: str) -> None:
        if what not in self.left_out:
            logger.warning("source: frame %d: %s left out: %s (said once)", index, what, got)
        self.left_out[what] += 1


def _length_s(voice: Voice | None, sight: Sight | None, agent: Voice | None) -> float | None:
    person = voice or sight
    says_s = 0.0 if agent is None else agent.duration_s or 0.0
    if person is None:
        return says_s or None
    return None if person.duration_s is None else max(person.duration_s, says_s)
