"""Sound features of both listeners: features of the sound and the place in a phrase, frame by frame.

Offline and streaming use the same code: `rows` and `track` of a recording return what the streams return per frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, NO_SOUND, SILENCE, Bools, Floats
from sfms_robot.signals import mel, mfcc, phase, voice_activity
from sfms_robot.signals.audio import energies_db, finite

if TYPE_CHECKING:  # it imports transformers, which only a listener with wav2vec2 needs
    from sfms_robot.signals.wav2vec2 import Wav2Vec2

Audio = Literal["mel", "mfcc78", "wav2vec2"]
# Rows per frame and numbers per row of each kind of sound feature.
SHAPES: Final[Mapping[Audio, tuple[int, int]]] = {
    "mel": (mel.ROWS_PER_FRAME, mel.MEL_BINS),
    "mfcc78": (1, mfcc.DIM),
    "wav2vec2": (1, 768),
}


@dataclass(frozen=True)
class AudioState:
    """Memory of one track: samples that unfinished rows need, and the phrase so far (None if it is not computed)."""

    sound: Floats
    phase: phase.PhaseState | None

    @property
    def voiced(self) -> bool:
        """Return whether the newest frame is speech."""
        return self.phase is not None and self.phase.ear.active


@dataclass(frozen=True)
class AudioFrontend:
    """A way to turn sound into features.

    Attributes:
        audio: the kind of features.
        phased: True if the place in a phrase (`signals.phase`) is computed as well. Ours.
        model: Computes the features of wav2vec2; without it the data must contain them.
    """

    audio: Audio = "mel"
    phased: bool = False
    model: Wav2Vec2 | None = None

    @classmethod
    def of(cls, settings: config.Sfms, folder: Path | None = None) -> AudioFrontend:
        """Return the front end of an SFMS listener; a relative model folder is looked up in the listener's `folder`.

        Raises ConfigError or ModelError.
        """
        if settings.wav2vec2 is None:
            return cls(settings.audio, settings.phase)
        from sfms_robot.signals.wav2vec2 import Wav2Vec2

        model = Wav2Vec2((folder or Path()) / settings.wav2vec2)
        if model.dim != (wanted := SHAPES["wav2vec2"][1]):
            raise ConfigError(f"{model.folder}: hidden_size: expected {wanted} numbers per frame, got {model.dim}")
        return cls(settings.audio, settings.phase, model)

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows per frame and numbers per row."""
        return SHAPES[self.audio]

    @property
    def phase_features(self) -> int:
        """Return the number of features of the place in a phrase; 0 if it is not computed."""
        return phase.FEATURES if self.phased else 0

    def start(self) -> AudioState:
        """Return the state before any sound."""
        return AudioState(self._start(), phase.start() if self.phased else None)

    def step_each(
        self, sounds: Sequence[Sequence[Floats]], before: Sequence[AudioState]
    ) -> tuple[Floats, Floats, list[AudioState]]:
        """Return features of several streams, any number of frames each, concatenated stream by stream.

        Args:
            sounds: frames of each stream, (640,) samples each; a frame without samples counts as silence.
            before: state of each stream.

        Returns:
            Rows (frames * R, bins), phases (frames, F), and the next state of each stream.
        """
        whole = [np.concatenate([sound if len(sound) else SILENCE for sound in own]) for own in sounds]
        pasts = [state.sound for state in before]
        if self.audio == "mel":
            rows, pasts = mel.log_mel_each(whole, pasts)
        else:
            found = [self._rows(*each) for each in zip(whole, pasts, strict=True)]
            rows, pasts = np.concatenate([made for made, _ in found]), [past for _, past in found]
        if not self.phased:
            return rows, np.zeros((sum(map(len, sounds)), 0), np.float32), [AudioState(past, None) for past in pasts]
        levels = [energies_db(samples.reshape(-1, FRAME_SAMPLES)) for samples in whole]
        phases, after = phase.step_each(levels, [state.phase or phase.start() for state in before])
        return rows, phases, [AudioState(*each) for each in zip(pasts, after, strict=True)]

    def rows(self, audio: Floats) -> Floats:
        """Return rows (N * R, bins) of a recording (N * 640,)."""
        return self._rows(audio, self._start())[0]

    def _start(self) -> Floats:
        if self.audio == "mel":
            return mel.start()
        return NO_SOUND if self.model is None else self.model.start()

    def _rows(self, samples: Floats, past: Floats) -> tuple[Floats, Floats]:
        if self.audio == "mel":
            return mel.log_mel(samples, past)
        if self.audio == "mfcc78":
            return mfcc.mfcc78(samples), past
        if self.model is None:
            raise ConfigError("wav2vec2: expected the folder of a model, or data that holds the feature; got neither")
        return self.model.step(samples, past)


# --- Two tracks (ARIG) ------------------------------------------------------------------------------------------------
#
# ARIG hears the user and itself. A frame of each track has 533 numbers: four rows of log-mel (512), which describe the
# voice in these 40 ms, and the place in a phrase (21). Ours: the paper's 768 numbers of wav2vec2 replace the mel rows
# only where the data contains them.

TRACKS: Final = AudioFrontend("mel", phased=True)
MEL_WIDTH: Final = mel.ROWS_PER_FRAME * mel.MEL_BINS
WIDTHS: Final = {"mel": MEL_WIDTH + phase.FEATURES, "wav2vec2": 768 + phase.FEATURES}  # numbers per frame


def hear_each(
    samples: Sequence[Floats | None], before: Sequence[AudioState]
) -> tuple[Floats, list[bool], list[AudioState]]:
    """Return features (N, 533) of one frame of N tracks, which of them have sound, and the next states.

    `samples`: (640,) of each track, or None or empty where there is no sound, which counts as silence. Samples that are
    not finite count as silence too. Raises ValueError for another length.
    """
    clean = [SILENCE if each is None or not len(each) else finite(each)[0] for each in samples]
    for each in clean:
        check_length(each)
    rows, spoken, after = TRACKS.step_each([[each] for each in clean], before)
    features = np.concatenate([rows.reshape(len(clean), MEL_WIDTH), spoken], axis=1)
    return features, [each is not None and len(each) > 0 for each in samples], after


def track(samples: Floats) -> tuple[Floats, Bools]:
    """Return features (N, 533) and speech (N,) of a recording (n,), N = n // 640, the same as `hear_each`."""
    frames = len(samples) // FRAME_SAMPLES
    clean, _ = finite(samples[: frames * FRAME_SAMPLES])
    return _with_phrase(TRACKS.rows(clean).reshape(frames, MEL_WIDTH), phase.hear(voice_activity.levels_db(clean)))


def of_mel(rows: Floats) -> tuple[Floats, Bools]:
    """Return what `track` returns of natural log-mel (N, 4, 128), for data without samples."""
    return _with_phrase(rows.reshape(len(rows), -1), phase.hear(voice_activity.mel_levels_db(rows)))


def fit_frame(samples: Floats | None) -> Floats | None:
    """Return samples of the agent's track cut or padded with silence to one frame, or None if there are none.

    The track's clock is not the microphone's: at 200 ppm, one frame in 8 has a sample too many or too few.
    """
    if samples is None or not len(samples):
        return None
    out = SILENCE.copy()
    out[: min(len(samples), FRAME_SAMPLES)] = samples[:FRAME_SAMPLES]
    return out


def check_length(samples: Floats) -> None:
    """Raise ValueError unless these are the samples of one frame, or none."""
    if len(samples) not in (0, FRAME_SAMPLES):
        raise ValueError(f"a frame at {AUDIO_HZ} Hz has {FRAME_SAMPLES} samples or none, got {len(samples)}")


def _with_phrase(rows: Floats, voiced: list[bool]) -> tuple[Floats, Bools]:
    return np.concatenate([rows, phase.features(phase.times(voiced))], axis=1), np.array(voiced, dtype=np.bool_)
