"""Place of the other person in a phrase: its length so far, the length of the silence, and that of the last phrase.

Nods depend on these times, which reach back further than the 1.6 s that a predictor sees. `step_each` turns the
levels of frames into features for a predictor; the three times alone serve the table of nod rates (`evaluation`).

A phrase continues across silences under 0.2 s. Features are a piecewise linear basis of each time on a grid that is
logarithmic from 0.2 s up (the weights of the two neighbouring knots), so that a linear layer can represent any curve
over it. They are all 0 for a phase that has not occurred yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.frames import FRAME_S, Bools, Doubles, Floats
from sfms_robot.signals import voice_activity
from sfms_robot.signals.voice_activity import Ear

GAP_FRAMES: Final = 5  # this many silent frames, 0.2 s, end a phrase
SPEECH_KNOTS_S: Final = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
SILENCE_KNOTS_S: Final = (0.0, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8)
PHRASE_KNOTS_S: Final = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
FEATURES: Final = len(SPEECH_KNOTS_S) + len(SILENCE_KNOTS_S) + len(PHRASE_KNOTS_S)  # 21
SOFT_S: Final = 0.2


def log_time(seconds: ArrayLike) -> Doubles:
    """Return times on the scale of the knots, logarithmic from `SOFT_S` up."""
    return np.log1p(np.asarray(seconds, np.float64) / SOFT_S)


def piecewise_linear_basis(seconds: Doubles, knots_s: Sequence[float]) -> Doubles:
    """Return the weights (N, K) of the two neighbouring knots of each time (N,), adding up to 1.

    Beyond the last knot only that knot counts, so `math.inf` is "long ago"; for NaN all weights are 0.
    """
    knots = log_time(knots_s)
    place = np.interp(log_time(np.minimum(seconds, knots_s[-1])), knots, np.arange(len(knots)))
    weights = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(len(knots))))
    return np.where(np.isnan(seconds)[:, None], 0.0, weights)


@dataclass(frozen=True)
class SpeechPhase:
    """Counts of frames, up to and including the newest one.

    Attributes:
        speech: length of the phrase in progress, short gaps included; 0 when there is none.
        silence: length since the last speech, or the start of a stream; 0 while the person speaks.
        last: length of the last whole phrase; 0 before the first one has ended.
    """

    speech: int = 0
    silence: int = 0
    last: int = 0

    def after(self, active: bool) -> SpeechPhase:
        """Return the phase one frame later."""
        if active:
            return SpeechPhase(self.speech + 1, 0, self.last)
        silence = self.silence + 1
        if not self.speech:
            return SpeechPhase(0, silence, self.last)
        if silence < GAP_FRAMES:
            return SpeechPhase(self.speech + 1, silence, self.last)
        return SpeechPhase(0, silence, self.speech + 1 - silence)

    @property
    def times_s(self) -> tuple[float, float, float]:
        """Speech so far, silence so far, length of the last phrase."""
        return self.speech * FRAME_S, self.silence * FRAME_S, self.last * FRAME_S


@dataclass(frozen=True)
class PhaseState:
    """Memory of a stream."""

    ear: Ear
    phase: SpeechPhase


def start() -> PhaseState:
    """Return the memory of a new stream."""
    return PhaseState(voice_activity.start(), SpeechPhase())


def step_each(levels_db: Sequence[Sequence[float]], states: Sequence[PhaseState]) -> tuple[Floats, list[PhaseState]]:
    """Return the features (N, 21) of all N frames of several streams, one stream after the other, and their states.

    `levels_db`: of any number of frames per stream.
    """
    times_s: list[tuple[float, float, float]] = []
    after = []
    for own, state in zip(levels_db, states, strict=True):
        ear, phase = state.ear, state.phase
        for level_db in own:
            ear = voice_activity.step(level_db, ear)
            phase = phase.after(ear.active)
            times_s.append(phase.times_s)
        after.append(PhaseState(ear, phase))
    return features(np.reshape(times_s, (-1, 3))), after


def of_audio(audio: Floats) -> Floats:
    """Return the features (N, 21) of samples (N * 640,), equal to `step_each`; remaining samples are not used."""
    return of_levels(voice_activity.levels_db(audio))


def of_levels(levels_db: Doubles) -> Floats:
    """Return the features (N, 21) of the levels (N,) of frames from the start of a stream."""
    return features(times(hear(levels_db)))


def hear(levels_db: Doubles) -> list[bool]:
    """Return whether each frame is speech, from levels (N,) from the start of a stream."""
    ear, heard = voice_activity.start(), []
    for level in levels_db.tolist():
        ear = voice_activity.step(level, ear)
        heard.append(ear.active)
    return heard


def times(active: Sequence[bool] | Bools) -> Doubles:
    """Return seconds (N, 3) of speech so far, silence so far and the last phrase, of frames of speech (N,)."""
    index = np.arange(len(active))
    newest = np.maximum.accumulate(np.where(active, index, -1))  # frame of speech
    silence = index - newest
    phrase = (newest >= 0) & (silence < GAP_FRAMES)
    begins = phrase & ~np.r_[False, phrase][:-1]
    first = np.r_[0, np.flatnonzero(begins)][np.cumsum(begins)]  # frame of the newest phrase; 0 before any
    length = newest - first + 1  # of that phrase up to its newest speech; 0 before any
    last = np.where(phrase, np.r_[0, length][first], length)
    return np.stack([phrase * (index - first + 1), silence, last], axis=1) * FRAME_S


def features(times_s: Doubles) -> Floats:
    """Return features (N, 21) of seconds (N, 3): speech (0 in silence), silence, last phrase (0 before it)."""
    speech, silence, last = times_s.T
    parts = [
        piecewise_linear_basis(speech, SPEECH_KNOTS_S) * (speech > 0)[:, None],
        piecewise_linear_basis(silence, SILENCE_KNOTS_S),
        piecewise_linear_basis(last, PHRASE_KNOTS_S) * (last > 0)[:, None],
    ]
    return np.concatenate(parts, axis=1).astype(np.float32)
