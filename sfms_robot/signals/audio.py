"""Sound files and pieces of sound: any format, rate and channel count in; mono float32 at 16 kHz out."""

from __future__ import annotations

import logging
import math
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, Doubles, Floats

if TYPE_CHECKING:
    import soundfile

logger = logging.getLogger(__name__)

LOWEST_RATE_HZ: Final = 4_000  # a telephone has 8000
HIGHEST_RATE_HZ: Final = 384_000
LOUDEST: Final = 8.0  # full scale is 1; a file that goes beyond this was written in another unit
_BLOCK: Final = 65_536  # samples of a file at once
_UNBOUNDED: Final = ("FLOAT", "DOUBLE")  # sample formats that hold more than full scale, and NaN
_NONE: Final = np.zeros(0, dtype=np.float32)


class Resampler:
    """A stream from one rate to 16 kHz; its pieces, put together, equal the whole resampled at once."""

    def __init__(self, rate_hz: float) -> None:
        self._stream: Any = None
        if rate_hz != AUDIO_HZ:
            import soxr

            self._stream = soxr.ResampleStream(rate_hz, AUDIO_HZ, 1, dtype="float32", quality="HQ")

    def push(self, samples: NDArray[np.float32], last: bool = False) -> Floats:
        """Return (m,) mono, -1..1, of samples (n,) or (n, channels); some come out later, the rest with `last`."""
        mixed = samples.mean(axis=1, dtype=np.float64).astype(np.float32) if samples.ndim > 1 else samples
        if self._stream is not None:
            mixed = self._stream.resample_chunk(np.ascontiguousarray(mixed), last=last)
        clipped: Floats = np.clip(mixed, -1.0, 1.0)
        return clipped


class AudioFile:
    """A sound file as mono 16 kHz, -1..1, read in pieces: channels averaged, other rates resampled.

    Raises ConfigError, in one line, for a file that is missing, no sound, empty, of a rate outside 4 to 384 kHz, not
    finite or far beyond full scale. One that is cut off is used as far as it goes, and the log says so.

    Attributes:
        length: samples at 16 kHz.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = _open(self.path)
        self.length = int(self._file.frames * AUDIO_HZ / self._file.samplerate + 0.5)
        self.rewind()

    def rewind(self) -> None:
        """Read from the start again."""
        self._file.seek(0)
        self._resampler = Resampler(self._file.samplerate)
        self._ready = _NONE
        self._over = False

    def read(self, n: int) -> Floats:
        """Return the next `n` samples, fewer at the end."""
        pieces, have = [self._ready], len(self._ready)
        while have < n and not self._over:
            pieces.append(self._piece())
            have += len(pieces[-1])
        ready = np.concatenate(pieces)
        self._ready = ready[n:]
        return ready[:n]

    def close(self) -> None:
        self._file.close()

    def _piece(self) -> Floats:
        import soundfile

        try:
            samples = self._file.read(_BLOCK, dtype="float32", always_2d=True)
        except soundfile.LibsndfileError as error:  # what is compressed tells only now
            logger.warning("%s: cannot be read to its end: %s", self.path, error)
            samples = np.zeros((0, self._file.channels), dtype=np.float32)
        self._over = len(samples) < _BLOCK
        return self._resampler.push(samples, last=self._over)


def read_audio(path: Path | str) -> Floats:
    """Return a whole sound file as (n,) mono 16 kHz, -1..1. Raises ConfigError as `AudioFile`."""
    with closing(AudioFile(path)) as file:
        return file.read(file.length + _BLOCK)


def _open(path: Path) -> soundfile.SoundFile:
    import soundfile

    if not path.is_file():
        raise ConfigError(f"{path}: " + ("is a folder, not a sound file" if path.is_dir() else "no such file"))
    try:
        file = soundfile.SoundFile(str(path))
    except (soundfile.LibsndfileError, OSError, TypeError) as error:
        raise ConfigError(f"{path}: not a sound file that can be read (WAV, FLAC, OGG, MP3, AIFF)") from error
    try:
        _check(file, path)
    except BaseException:
        file.close()
        raise
    return file


def _check(file: soundfile.SoundFile, path: Path) -> None:
    """Check the header, and every sample of formats that may hold any value. Raises ConfigError."""
    if not file.frames:
        raise ConfigError(f"{path}: holds no samples")
    if not LOWEST_RATE_HZ <= file.samplerate <= HIGHEST_RATE_HZ:
        allowed = f"{LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ}"
        raise ConfigError(f"{path}: {file.samplerate} samples a second is not a rate of speech ({allowed})")
    if "should be" in file.extra_info:  # libsndfile's log: a chunk is longer than what is there
        logger.warning("%s: is cut off, its header promises more than the %d samples there are", path, file.frames)
    for _ in range(math.ceil(file.frames / _BLOCK)) if file.subtype in _UNBOUNDED else ():
        block = file.read(_BLOCK, dtype="float32", always_2d=True)
        if not np.isfinite(block).all():
            raise ConfigError(f"{path}: holds samples that are not finite")
        if (peak := float(np.abs(block).max(initial=0.0))) > LOUDEST:
            raise ConfigError(f"{path}: holds samples up to {peak:g}, full scale is 1: divide them")


def energy_db(samples: Floats) -> float:
    """Return the mean level of samples in dB of full scale; -100 for silence and for no samples."""
    if not len(samples):
        return -100.0
    return _db(float(np.add.reduce(np.square(samples, dtype=np.float64))), len(samples))


def energies_db(pieces: Floats) -> list[float]:
    """Return `energy_db` of each row of samples (N, n)."""
    sums: list[float] = np.add.reduce(np.square(pieces, dtype=np.float64), axis=1).tolist()
    return [_db(each, pieces.shape[1]) for each in sums]


def _db(energy: float, samples: int) -> float:
    return 10 * math.log10(max(energy / samples, 1e-10))


# --- A sampled signal between its samples, by a windowed sinc: for odd rates, and rates that change -------------------

_TAPS: Final = 32
_PHASES: Final = 4096  # of one sample: the nearest is taken, which is 70 dB exact
_BETA: Final = 8.0  # of the Kaiser window
_AROUND: Final = np.arange(1 - _TAPS // 2, 1 + _TAPS // 2)


@lru_cache(maxsize=1)
def _kernels() -> Floats:
    """Return (phases + 1, taps): weights of the samples around an instant, by its distance behind the one before."""
    behind = np.arange(_PHASES + 1)[:, None] / _PHASES - _AROUND
    inside = np.clip(1.0 - (2.0 * behind / _TAPS) ** 2, 0.0, 1.0)
    kernels = np.sinc(behind) * np.i0(_BETA * np.sqrt(inside)) / np.i0(_BETA)
    return np.asarray(kernels / kernels.sum(axis=1, keepdims=True), dtype=np.float32)


def at_positions(samples: Floats, positions: Doubles) -> Floats:
    """Return the signal (n,), n > 0, at `positions` (m,) in samples, whole or not; outside its samples it is 0.

    Exact at whole positions; elsewhere within -60 dB up to 0.8 of half its rate.
    """
    before = np.floor(positions)
    phases = np.rint((positions - before) * _PHASES).astype(np.intp)
    around: NDArray[np.intp] = before.astype(np.intp)[:, None] + _AROUND
    known = (around >= 0) & (around < len(samples))
    taken = np.where(known, samples[np.clip(around, 0, len(samples) - 1)], np.float32(0))
    signal: Floats = np.einsum("mt,mt->m", _kernels()[phases], taken)
    return signal
