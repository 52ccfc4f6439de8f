"""Where the other person is in a phrase: how long it has lasted, how long it is silent, how long the last one was.

This is what nods depend on, and it reaches back further than the 1.6 s that a predictor sees. `step` takes the samples
of one frame and gives features for a predictor; the three times alone serve the table of nod rates (`evaluation`).

A phrase goes on across silences under 0.2 s. Features are hat functions of each time on a logarithmic grid, so that a
linear layer can already draw any curve over it, and are all 0 for a phase that has not been yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import FRAME_S, Doubles, Floats
from sfms_robot.signals import voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.hats import hats
from sfms_robot.signals.voice_activity import Ear

GAP_FRAMES: Final = 5  # this many silent frames, 0.2 s, end a phrase
SPEECH_KNOTS_S: Final = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
SILENCE_KNOTS_S: Final = (0.0, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8)
PHRASE_KNOTS_S: Final = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
FEATURES: Final = len(SPEECH_KNOTS_S) + len(SILENCE_KNOTS_S) + len(PHRASE_KNOTS_S)  # 21
LONGEST: Final = round(
    max(*SPEECH_KNOTS_S, *SILENCE_KNOTS_S, *PHRASE_KNOTS_S) / FRAME_S
)  # frames: no feature tells more
_OF_SPEECH: Final = slice(0, len(SPEECH_KNOTS_S))
_OF_SILENCE: Final = slice(_OF_SPEECH.stop, _OF_SPEECH.stop + len(SILENCE_KNOTS_S))
_OF_LAST: Final = slice(_OF_SILENCE.stop, FEATURES)


@dataclass(frozen=True)
class SpeechPhase:
    """Counts of frames, up to and with the newest one.

    Attributes:
        speech: of the phrase in progress, short gaps included; 0 when there is none.
        silence: since somebody last spoke; 0 while he does; counts from the start of a stream.
        last: of the last whole phrase; 0 before the first one has ended.
    """

    speech: int = 0
    silence: int = 0
    last: int = 0

    def after(self, active: bool) -> SpeechPhase:
        """One frame later."""
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
class State:
    """What a stream remembers of the other's voice."""

    ear: Ear
    phase: SpeechPhase


def start() -> State:
    """Nobody has spoken yet."""
    return State(voice_activity.start(), SpeechPhase())


def step(samples: Floats, state: State) -> tuple[Floats, State]:
    """Samples of one frame (640,), or none when there is no microphone -> features (21,), and the next state."""
    rows, (after,) = step_each([[energy_db(samples)]], [state])
    return rows[0], after


def step_each(levels_db: Sequence[Sequence[float]], states: Sequence[State]) -> tuple[Floats, list[State]]:
    """Levels of the frames of several streams, any number each -> features (N, 21) of all N frames, one stream behind
    the other, and the state of each.
    """
    counts: list[tuple[int, int, int]] = []
    after = []
    for own, state in zip(levels_db, states, strict=True):
        ear, phase = state.ear, state.phase
        for level_db in own:
            ear = voice_activity.step(level_db, ear)
            phase = phase.after(ear.active)
            counts.append((min(phase.speech, LONGEST), min(phase.silence, LONGEST), min(phase.last, LONGEST)))
        after.append(State(ear, phase))
    return _features_of(counts), after


def _features_of(counts: Sequence[tuple[int, int, int]]) -> Floats:
    """`features` (N, 21) of counts of frames up to `LONGEST`."""
    rows, places = _every_row(), np.array(counts, np.intp).reshape(-1, 3)
    parts = zip(places.T, (_OF_SPEECH, _OF_SILENCE, _OF_LAST), strict=True)
    return np.concatenate([rows[place, columns] for place, columns in parts], axis=1)


@lru_cache(maxsize=1)
def _every_row() -> Floats:
    """(LONGEST + 1, 21): `features` of each count, of all three times alike."""
    return features(FRAME_S * np.repeat(np.arange(LONGEST + 1.0)[:, None], 3, axis=1))


def of_audio(audio: Floats) -> Floats:
    """(N * 640,) samples -> features (N, 21), frame by frame what `step` gives; samples left over are not used."""
    return features(times(hear(voice_activity.levels_db(audio))))


def of_mel(rows: Floats) -> Floats:
    """(N, 4, 128) natural log-mel -> features (N, 21), for data that comes without samples."""
    return features(times(hear(voice_activity.mel_levels_db(rows))))


def hear(levels_db: Doubles) -> list[bool]:
    """Levels (N,) from the start of a stream -> is this frame speech."""
    ear, heard = voice_activity.start(), []
    for level in levels_db.tolist():
        ear = voice_activity.step(level, ear)
        heard.append(ear.active)
    return heard


def times(active: Sequence[bool] | NDArray[np.bool_]) -> Doubles:
    """Speech (N,) -> seconds (N, 3): speech so far, silence so far, length of the last phrase, as `after` counts."""
    heard = np.asarray(active, bool)
    index = np.arange(len(heard))
    newest = np.maximum.accumulate(np.where(heard, index, -1))
    silence = index - newest
    runs = (newest >= 0) & (silence < GAP_FRAMES)
    ran = np.concatenate([[False], runs])[:-1]
    began = np.maximum.accumulate(np.where(heard & ~ran, index, -1))
    ended = np.maximum.accumulate(np.where(ran & ~runs, index, -1))
    last = np.where(ended >= 0, (newest - began + 1)[ended], 0)
    return np.stack([np.where(runs, index - began + 1, 0), silence, last], axis=1) * FRAME_S


def features(times_s: Doubles) -> Floats:
    """Seconds (N, 3) -> (N, 21): hats of speech (none in silence), silence, last phrase (none before it)."""
    speech, silence, last = times_s.T
    parts = [
        hats(speech, SPEECH_KNOTS_S) * (speech > 0)[:, None],
        hats(silence, SILENCE_KNOTS_S),
        hats(last, PHRASE_KNOTS_S) * (last > 0)[:, None],
    ]
    return np.concatenate(parts, axis=1).astype(np.float32)
