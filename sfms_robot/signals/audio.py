"""Conversion of sound files and pieces of sound, of any format, rate and channel count, to mono float32 at 16 kHz."""

from __future__ import annotations

import io
import logging
import math
import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.data import archive_kind
from sfms_robot.errors import ConfigError, InputError
from sfms_robot.frames import AUDIO_HZ, NO_SOUND, Doubles, Floats, Indices

if TYPE_CHECKING:
    import soundfile

logger = logging.getLogger(__name__)

LOWEST_RATE_HZ: Final = 4_000  # a telephone has 8000
HIGHEST_RATE_HZ: Final = 384_000
LOUDEST: Final = 8.0  # full scale is 1; a file with larger samples was written in another unit
_BLOCK: Final = 65_536  # samples read from a file at once
_UNBOUNDED: Final = ("FLOAT", "DOUBLE")  # sample formats that may hold more than full scale, and NaN
_NO_SIZE: Final = 0x7FFF0000  # size in a WAV file: programs that write to a pipe write 0, or this or more
_HEAD: Final = 65_536  # bytes within which the samples of a WAV file begin
_LOST: Final = 0.3  # share of the loudest channel's energy below which the mean has lost a voice
_OPPOSITE: Final = -0.5  # correlation with the loudest channel below which a channel has the opposite sign
_STUDIED: Final = 48_000  # audible samples (louder than `_AUDIBLE`) after which a mix is decided
_AUDIBLE: Final = 1e-3


class Downmix:
    """Mix of several channels to one: their mean, unless it loses a voice.

    In a mean, a voice in one of six channels loses 15.6 dB, and a voice with opposite signs in two channels is silent.
    If the mean is 5 dB or more below the loudest channel, channels are added at the level of the loudest one, those of
    opposite sign inverted. That is decided in the first 48,000 audible samples, and logged with `name` as the sound.

    Attributes:
        decided: True once enough sound was received.
        line: the log line about a mix that is not the mean; empty before the decision, and for the mean.
    """

    def __init__(self, name: str = "sound") -> None:
        self._name = name
        self._weights: Doubles | None = None  # None: the mean
        self._moments: Doubles = np.zeros((0, 0))
        self._heard = 0
        self.decided = False
        self.line = ""

    def __call__(self, samples: Floats) -> Floats:
        """Mix finite samples (n,) or (n, channels) to (n,)."""
        if samples.ndim == 1:
            return samples
        if not self.decided or len(self._moments) != samples.shape[1]:
            self.study(samples)
        mixed = samples.mean(axis=1, dtype=np.float64) if self._weights is None else samples @ self._weights
        return mixed.astype(np.float32)

    def study(self, samples: Floats) -> None:
        """Update the mix by samples (n, channels)."""
        channels = samples.shape[1]
        if len(self._moments) != channels:
            self._moments, self._heard, self.decided = np.zeros((channels, channels)), 0, False
        self._heard += int(np.count_nonzero(np.abs(samples).max(axis=1, initial=0.0) > _AUDIBLE))
        self._moments += samples.T.astype(np.float64) @ samples
        power = self._moments.diagonal()
        loudest = int(np.argmax(power))
        self._weights = None
        if self._moments.sum() / channels**2 < _LOST * power[loudest]:
            opposite = self._moments[loudest] < _OPPOSITE * np.sqrt(power * power[loudest])
            signs = np.where(opposite, -1.0, 1.0)
            together = signs @ self._moments @ signs
            self._weights = signs * min(1.0, math.sqrt(power[loudest] / together))
        if self._heard >= _STUDIED:
            self.decide()

    def decide(self) -> None:
        """Keep the mix unchanged from now on, and log it if it is not the mean."""
        self.decided = True
        if self._weights is not None:
            turned = ", those of opposite sign turned around" if (self._weights < 0).any() else ""
            count = len(self._weights)
            self.line = f"{self._name}: the mean of {count} channels loses the voice: they are added{turned}"
            logger.warning("%s", self.line)


class Resampler:
    """A streaming resampler to 16 kHz; its pieces, joined, equal the whole signal resampled at once.

    mix: mix of several channels to one; None: a new mix, which is decided by this stream.
    """

    def __init__(self, rate_hz: float, mix: Downmix | None = None) -> None:
        self._mix = Downmix() if mix is None else mix
        self._stream: Any = None
        if rate_hz != AUDIO_HZ:
            import soxr

            self._stream = soxr.ResampleStream(rate_hz, AUDIO_HZ, 1, dtype="float32", quality="HQ")

    def push(self, samples: Floats, last: bool = False) -> Floats:
        """Resample (n,) or (n, channels) to (m,) mono, -1..1; some samples come out later, the rest with `last`."""
        mixed = self._mix(samples)
        if self._stream is not None:
            mixed = self._stream.resample_chunk(np.ascontiguousarray(mixed), last=last)
        return np.clip(mixed, -1.0, 1.0)


class AudioFile:
    """A sound file as mono 16 kHz, -1..1, read in pieces: channels mixed (`Downmix`), other rates resampled.

    Raises ConfigError, in one line, for a file that is missing, not sound, empty, of a rate outside 4 to 384 kHz, not
    finite or far beyond full scale. A file that is cut off is used up to its end, with a warning in the log.

    Attributes:
        length: number of samples at 16 kHz.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = _opened(self.path)
        try:
            _check(self._file, self.path)
        except BaseException:
            self._file.close()
            raise
        self.length = int(self._file.frames * AUDIO_HZ / self._file.samplerate + 0.5)
        self._mix = Downmix(str(path))
        self.rewind()
        while self._file.channels > 1 and not self._over and not self._mix.decided:
            self._piece()
        if not self._mix.decided:
            self._mix.decide()
        self.rewind()

    def rewind(self) -> None:
        """Read from the start again."""
        if self._file.seekable():
            self._file.seek(0)
        else:
            self._file.close()
            self._file = _opened(self.path)
        self._resampler = Resampler(self._file.samplerate, self._mix)
        self._ready = NO_SOUND
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
        except soundfile.LibsndfileError as error:  # compressed data fails only when it is read
            logger.warning("%s: cannot be read to its end: %s", self.path, error)
            samples = np.zeros((0, self._file.channels), dtype=np.float32)
        self._over = len(samples) < _BLOCK
        return self._resampler.push(samples, last=self._over)


def read_audio(path: Path | str) -> Floats:
    """Return a whole sound file as (n,) mono 16 kHz, -1..1. Raises ConfigError as `AudioFile`."""
    with closing(AudioFile(path)) as file:
        return file.read(file.length + _BLOCK)


def _opened(path: Path) -> soundfile.SoundFile:
    import soundfile

    if path.is_dir():
        raise ConfigError(f"{path}: is a folder, not a sound file")
    if not path.exists():
        raise ConfigError(f"{path}: no such file")
    if not path.is_file():
        raise ConfigError(f"{path}: is a pipe or a device: sound is read from files; write it to one first")
    try:
        with path.open("rb") as raw:
            head = raw.read(_HEAD)
        place = os.fsencode(path) if os.name == "posix" else str(path)  # the library cannot encode every path
        return soundfile.SoundFile(_whole_wav(path, head) or place)
    except (soundfile.SoundFileError, OSError, TypeError, ValueError) as error:
        if kind := archive_kind(head):
            raise ConfigError(f"{path}: is an archive ({kind}): unpack it first") from error
        known = f"WAV, FLAC, OGG, MP3, AIFF; for others: ffmpeg -i {path.name} {path.stem}.wav"
        raise ConfigError(f"{path}: not a sound file that can be read ({known})") from error


def _whole_wav(path: Path, head: bytes) -> io.BytesIO | None:
    """Return a WAV file with its true sizes if it was written to a pipe, where they are unknown; else None."""
    place = 12
    while head[:4] == b"RIFF" and place + 8 <= len(head):
        name, size = struct.unpack_from("<4sI", head, place)
        place += 8
        if name != b"data":
            place += size + size % 2
            continue
        held = path.stat().st_size - place
        if held <= 0 or (size and not size >= _NO_SIZE > held):
            return None
        data = bytearray(path.read_bytes())
        struct.pack_into("<I", data, place - 4, held)
        struct.pack_into("<I", data, 4, len(data) - 8)
        return io.BytesIO(data)
    return None


def _check(file: soundfile.SoundFile, path: Path) -> None:
    """Check the header, and every sample of formats that may hold any value. Raises ConfigError."""
    if not file.frames:
        raise ConfigError(f"{path}: holds no samples")
    if not LOWEST_RATE_HZ <= file.samplerate <= HIGHEST_RATE_HZ:
        allowed = f"{LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ}"
        raise ConfigError(f"{path}: {file.samplerate} samples a second is not a rate of speech ({allowed})")
    if "(should be" in file.extra_info:  # in libsndfile's log: a chunk is longer than its data
        logger.warning("%s: is cut off, its header promises more than the %d samples there are", path, file.frames)
    for _ in range(math.ceil(file.frames / _BLOCK)) if file.subtype in _UNBOUNDED else ():
        block = file.read(_BLOCK, dtype="float32", always_2d=True)
        if not np.isfinite(block).all():
            raise ConfigError(f"{path}: holds samples that are not finite")
        check_scale(str(path), block)


def check_scale(name: str, samples: NDArray[Any]) -> None:
    """Raise InputError for samples far beyond full scale: in another unit. Samples that are not finite are ignored."""
    peak = float(np.abs(samples).max(initial=0.0, where=np.isfinite(samples)))
    if peak > LOUDEST:
        raise InputError(f"{name}: holds samples up to {peak:g}, full scale is 1: divide them (16-bit: by 32768)")


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables while a library or a process reads them, and restore them. Not for several threads."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def finite(samples: Floats) -> tuple[Floats, int]:
    """Return the samples, with 0 for those that are not finite, and the number of those."""
    good = np.isfinite(samples)
    bad = samples.size - int(np.count_nonzero(good))
    return np.where(good, samples, np.float32(0)) if bad else samples, bad


def energy_db(samples: Floats) -> float:
    """Return the mean level of samples in dB of full scale; -100 for silence and for no samples."""
    return _db(float(np.add.reduce(np.square(samples, dtype=np.float64))), len(samples))


def energies_db(pieces: Floats) -> list[float]:
    """Return `energy_db` of each row of samples (N, n)."""
    sums: list[float] = np.add.reduce(np.square(pieces, dtype=np.float64), axis=1).tolist()
    return [_db(each, pieces.shape[1]) for each in sums]


def _db(energy: float, samples: int) -> float:
    return 10 * math.log10(max(energy / max(samples, 1), 1e-10))


# --- Interpolation between samples by a windowed sinc, for odd rates and rates that change ----------------------------

_TAPS: Final = 32
_PHASES: Final = 4096  # positions within one sample; the nearest is used, with an error of -70 dB
_BETA: Final = 8.0  # of the Kaiser window
_AROUND: Final = np.arange(1 - _TAPS // 2, 1 + _TAPS // 2)


@lru_cache(maxsize=1)
def _kernels() -> Floats:
    """Return weights (phases + 1, taps) of the samples around an instant, by its distance after the sample before."""
    behind = np.arange(_PHASES + 1)[:, None] / _PHASES - _AROUND
    inside = np.clip(1.0 - (2.0 * behind / _TAPS) ** 2, 0.0, 1.0)
    kernels = np.sinc(behind) * np.i0(_BETA * np.sqrt(inside)) / np.i0(_BETA)
    return np.asarray(kernels / kernels.sum(axis=1, keepdims=True), dtype=np.float32)


def at_positions(samples: Floats, positions: Doubles) -> Floats:
    """Return values (m,) of a signal (n,), n > 0, at `positions` (m,) in samples, whole or not; 0 outside of it.

    Exact at whole positions; elsewhere the error is below -60 dB up to 0.8 of half the signal's rate.
    """
    before = np.floor(positions)
    phases = np.rint((positions - before) * _PHASES).astype(np.intp)
    around: Indices = before.astype(np.intp)[:, None] + _AROUND
    known = (around >= 0) & (around < len(samples))
    taken = np.where(known, samples[np.clip(around, 0, len(samples) - 1)], np.float32(0))
    signal: Floats = np.einsum("mt,mt->m", _kernels()[phases], taken)
    return signal
