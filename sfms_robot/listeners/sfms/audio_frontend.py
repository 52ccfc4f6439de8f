"""The speaker's voice as a listener takes it in: features of the sound, and the place in a phrase. Frame by frame.

One path offline and streaming: `rows` of a whole recording gives what `step` gives frame by frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, Floats
from sfms_robot.signals import mel, mfcc, phase
from sfms_robot.signals.audio import energies_db

if TYPE_CHECKING:  # transformers, which only a listener of this kind needs
    from sfms_robot.signals.wav2vec2 import Wav2Vec2

Audio = Literal["mel", "mfcc78", "wav2vec2"]
# Rows per frame and numbers per row of every kind of sound feature.
SHAPES: Final[Mapping[Audio, tuple[int, int]]] = {
    "mel": (mel.ROWS_PER_FRAME, mel.MEL_BINS),
    "mfcc78": (1, mfcc.DIM),
    "wav2vec2": (1, 768),
}
_SILENCE: Final = np.zeros(FRAME_SAMPLES, np.float32)


@dataclass(frozen=True)
class AudioState:
    """What a stream of sound has to remember: samples that unfinished rows need, and the phrase so far."""

    sound: Floats
    phase: phase.State | None


@dataclass(frozen=True)
class AudioFrontend:
    """How sound becomes features: `audio` names them; with `phased`, the place in a phrase as well.

    `model` makes the features of wav2vec2; without it they have to come with the data.
    """

    audio: Audio = "mel"
    phased: bool = False
    model: Wav2Vec2 | None = None

    @classmethod
    def of(cls, settings: config.Sfms, folder: Path | None = None) -> AudioFrontend:
        """A relative model folder is looked for in the listener's `folder`. Raises ConfigError or ModelError."""
        if settings.wav2vec2 is None:
            return cls(settings.audio, settings.phase)
        from sfms_robot.signals.wav2vec2 import Wav2Vec2

        model = Wav2Vec2((folder or Path()) / settings.wav2vec2)
        if model.dim != SHAPES["wav2vec2"][1]:
            raise ConfigError(
                f"wav2vec2: {model.folder} gives {model.dim} numbers per frame, not {SHAPES['wav2vec2'][1]}"
            )
        return cls(settings.audio, settings.phase, model)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows per frame, numbers per row."""
        return SHAPES[self.audio]

    @property
    def phase_features(self) -> int:
        return phase.FEATURES if self.phased else 0

    def start(self) -> AudioState:
        """Nothing heard yet."""
        return AudioState(self._start(), phase.start() if self.phased else None)

    def step(self, sounds: Sequence[Floats], audio: AudioState) -> tuple[Floats, Floats, AudioState]:
        """Frames of samples (640,), or none in them -> rows (frames * R, bins), phase (frames, F), and what is
        remembered after them.
        """
        rows, phases, (after,) = self.step_each([sounds], [audio])
        return rows, phases, after

    def step_each(
        self, sounds: Sequence[Sequence[Floats]], before: Sequence[AudioState]
    ) -> tuple[Floats, Floats, list[AudioState]]:
        """`step` of several streams, any number of frames each: rows and phases one stream behind the other."""
        whole = [np.concatenate([sound if len(sound) else _SILENCE for sound in own]) for own in sounds]
        rows, pasts = self._rows_each(whole, [state.sound for state in before])
        if not self.phased:
            return rows, np.zeros((sum(map(len, sounds)), 0), np.float32), [AudioState(past, None) for past in pasts]
        levels = [energies_db(samples.reshape(-1, FRAME_SAMPLES)) for samples in whole]
        phases, after = phase.step_each(levels, [state.phase or phase.start() for state in before])
        return rows, phases, [AudioState(*each) for each in zip(pasts, after, strict=True)]

    def rows(self, audio: Floats) -> Floats:
        """Samples (N * 640,) -> rows (N * R, bins)."""
        return self._rows(audio, self._start())[0]

    def _start(self) -> Floats:
        if self.audio == "mel":
            return mel.start()
        return np.zeros(0, np.float32) if self.model is None else self.model.start()

    def _rows_each(self, samples: Sequence[Floats], pasts: Sequence[Floats]) -> tuple[Floats, list[Floats]]:
        if self.audio == "mel":
            return mel.log_mel_each(samples, pasts)
        found = [self._rows(*each) for each in zip(samples, pasts, strict=True)]
        return np.concatenate([rows for rows, _ in found]), [past for _, past in found]

    def _rows(self, samples: Floats, past: Floats) -> tuple[Floats, Floats]:
        if self.audio == "mel":
            return mel.log_mel(samples, past)
        if self.audio == "mfcc78":
            return mfcc.mfcc78(samples), past
        if self.model is None:
            raise ConfigError(
                "audio: wav2vec2 needs its model's folder (the key wav2vec2) or data that ships the feature"
            )
        return self.model.step(samples, past)
