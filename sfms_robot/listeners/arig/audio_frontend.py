"""What the model hears of one track: 533 numbers per frame, and whether it is speech. One path offline and streaming.

Four log-mel rows (512) tell what the voice does in these 40 ms, `signals.phase` (21) how long it has spoken or been
silent. wav2vec2 features (768), where the data brings them, take the place of the mel rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import FRAME_SAMPLES, Floats
from sfms_robot.signals import mel, phase, voice_activity
from sfms_robot.signals.audio import energies_db

MEL_WIDTH: Final = mel.ROWS_PER_FRAME * mel.MEL_BINS
WIDTHS: Final = {"mel": MEL_WIDTH + phase.FEATURES, "wav2vec2": 768 + phase.FEATURES}  # numbers per frame
_SILENCE: Final = np.zeros(FRAME_SAMPLES, np.float32)


@dataclass(frozen=True)
class AudioState:
    """What a stream remembers of one track: samples that unfinished mel rows need, and the phrase."""

    past: Floats
    phase: phase.State

    @property
    def voiced(self) -> bool:
        """Whether the newest frame is speech."""
        return self.phase.ear.active


def start() -> AudioState:
    """Silence so far."""
    return AudioState(mel.start(), phase.start())


def hear(samples: Floats | None, before: AudioState) -> tuple[Floats, bool, AudioState]:
    """One frame: (640,) samples, or none when nothing can be heard -> features (533,), present, and the next state.

    Samples that are not finite are silence. Raises ValueError for another length.
    """
    features, (present,), (after,) = hear_each([samples], [before])
    return features[0], present, after


def hear_each(
    samples: Sequence[Floats | None], before: Sequence[AudioState]
) -> tuple[Floats, list[bool], list[AudioState]]:
    """`hear` of N tracks, one frame of each -> features (N, 533), which are present, and the next states."""
    present = [each is not None and len(each) > 0 for each in samples]
    clean = [_SILENCE if each is None or not len(each) else _finite(each) for each in samples]
    for each in clean:
        if len(each) != FRAME_SAMPLES:
            raise ValueError(f"a frame at 16000 Hz has {FRAME_SAMPLES} samples or none, got {len(each)}")
    rows, pasts = mel.log_mel_each(clean, [state.past for state in before])
    levels_db = [[level] for level in energies_db(np.stack(clean))]
    spoken, phases = phase.step_each(levels_db, [state.phase for state in before])
    features = np.concatenate([rows.reshape(len(clean), MEL_WIDTH), spoken], axis=1)
    return features, present, [*map(AudioState, pasts, phases)]


def track(samples: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """A whole recording (n,) -> features (N, 533) and speech (N,), N = n // 640: frame by frame what `hear` gives."""
    frames = len(samples) // FRAME_SAMPLES
    clean = _finite(samples[: frames * FRAME_SAMPLES])
    rows = mel.log_mel(clean, mel.start())[0].reshape(frames, MEL_WIDTH)
    voiced = phase.hear(voice_activity.levels_db(clean))
    return np.concatenate([rows, phase.features(phase.times(voiced))], axis=1), np.array(voiced, dtype=np.bool_)


def of_mel(rows: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Natural log-mel (N, 4, 128) of a recording, for data without samples -> as `track`."""
    voiced = phase.hear(voice_activity.mel_levels_db(rows))
    features = np.concatenate([rows.reshape(len(rows), -1), phase.features(phase.times(voiced))], axis=1)
    return features, np.array(voiced, dtype=np.bool_)


def _finite(samples: Floats) -> Floats:
    finite = np.isfinite(samples)
    return samples if finite.all() else np.where(finite, samples, np.float32(0))


def fit_frame(samples: Floats | None) -> Floats | None:
    """Samples of the agent's track cut or filled up with silence to one frame, or None.

    Its clock is not the microphone's: at 200 ppm a frame has a sample too many or too few every 8 s.
    """
    if samples is None or not len(samples):
        return None
    out = np.zeros(FRAME_SAMPLES, dtype=np.float32)
    out[: min(len(samples), FRAME_SAMPLES)] = samples[:FRAME_SAMPLES]
    return out
