"""Sound files: any format, rate and channel count in; mono float32 at 16 kHz out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, Floats


def read_audio(path: Path | str) -> Floats:
    """A sound file as (n,) mono 16 kHz, -1..1: channels averaged, other rates resampled.

    Raises ConfigError, in one line, for a file that is missing, no sound, empty or not finite.
    """
    import soundfile

    file = Path(path)
    if not file.is_file():
        raise ConfigError(f"{file}: " + ("is a folder, not a sound file" if file.is_dir() else "no such file"))
    try:
        samples, rate_hz = soundfile.read(str(file), dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, OSError) as error:
        formats = ", ".join(("WAV", "FLAC", "OGG", "MP3", "AIFF"))
        raise ConfigError(f"{file}: not a sound file that can be read ({formats})") from error
    if not len(samples):
        raise ConfigError(f"{file}: holds no samples")
    if not np.isfinite(samples).all():
        raise ConfigError(f"{file}: holds samples that are not finite")
    return mono_16k(samples, rate_hz)


def mono_16k(samples: NDArray[np.float32], rate_hz: float) -> Floats:
    """(n, channels) at `rate_hz` -> (m,) mono at 16 kHz, clipped to -1..1."""
    mixed = samples.mean(axis=1, dtype=np.float64).astype(np.float32)
    if rate_hz != AUDIO_HZ:
        import soxr

        mixed = soxr.resample(mixed, rate_hz, AUDIO_HZ, quality="HQ").astype(np.float32)
    clipped: Floats = np.clip(mixed, -1.0, 1.0)
    return clipped


def energy_db(samples: Floats) -> float:
    """Mean level of some samples in dB of full scale; -100 for silence and for none."""
    if not len(samples):
        return -100.0
    return float(10 * np.log10(max(float(np.mean(np.square(samples, dtype=np.float64))), 1e-10)))
