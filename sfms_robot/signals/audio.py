"""Sound files and pieces of sound: any format, rate and channel count in; mono float32 at 16 kHz out."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, Floats

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
    """Pieces of sound at one rate -> pieces at 16 kHz; put together they are the whole resampled at once."""

    def __init__(self, rate_hz: float) -> None:
        self._stream: Any = None
        if rate_hz != AUDIO_HZ:
            import soxr

            self._stream = soxr.ResampleStream(rate_hz, AUDIO_HZ, 1, dtype="float32", quality="HQ")

    def push(self, samples: NDArray[np.float32], last: bool = False) -> Floats:
        """(n,) or (n, channels) -> (m,) mono, clipped to -1..1; some samples come out later, the rest with `last`."""
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
        """The next `n` samples, fewer at the end."""
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
    """A whole sound file as (n,) mono 16 kHz, -1..1, as `AudioFile` reads it. Raises what it raises."""
    file = AudioFile(path)
    try:
        return file.read(file.length + _BLOCK)
    finally:
        file.close()


def _open(path: Path) -> soundfile.SoundFile:
    import soundfile

    if not path.is_file():
        raise ConfigError(f"{path}: " + ("is a folder, not a sound file" if path.is_dir() else "no such file"))
    try:
        file = soundfile.SoundFile(str(path))
    except (soundfile.LibsndfileError, OSError, TypeError) as error:
        formats = ", ".join(("WAV", "FLAC", "OGG", "MP3", "AIFF"))
        raise ConfigError(f"{path}: not a sound file that can be read ({formats})") from error
    try:
        _check(file, path)
    except BaseException:
        file.close()
        raise
    return file


def _check(file: soundfile.SoundFile, path: Path) -> None:
    """Before anything moves: what is in the header, and of formats that can hold anything every sample."""
    if not file.frames:
        raise ConfigError(f"{path}: holds no samples")
    if not LOWEST_RATE_HZ <= file.samplerate <= HIGHEST_RATE_HZ:
        allowed = f"{LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ}"
        raise ConfigError(f"{path}: {file.samplerate} samples a second is no rate for speech ({allowed})")
    if "should be" in file.extra_info:  # libsndfile's log: a chunk is longer than what is there
        logger.warning("%s: is cut off, its header promises more than the %d samples there are", path, file.frames)
    for block in _blocks(file) if file.subtype in _UNBOUNDED else ():
        if not np.isfinite(block).all():
            raise ConfigError(f"{path}: holds samples that are not finite")
        if (peak := float(np.abs(block).max(initial=0.0))) > LOUDEST:
            raise ConfigError(f"{path}: holds samples up to {peak:g}, full scale is 1: divide them")


def _blocks(file: soundfile.SoundFile) -> Iterator[NDArray[np.float32]]:
    for _ in range(math.ceil(file.frames / _BLOCK)):
        yield file.read(_BLOCK, dtype="float32", always_2d=True)


def energy_db(samples: Floats) -> float:
    """Mean level of some samples in dB of full scale; -100 for silence and for none."""
    if not len(samples):
        return -100.0
    return _db(float(np.add.reduce(np.square(samples, dtype=np.float64))), len(samples))


def energies_db(pieces: Floats) -> list[float]:
    """`energy_db` of each of (N, n) samples."""
    sums: list[float] = np.add.reduce(np.square(pieces, dtype=np.float64), axis=1).tolist()
    return [_db(each, pieces.shape[1]) for each in sums]


def _db(energy: float, samples: int) -> float:
    return 10 * math.log10(max(energy / samples, 1e-10))
