"""Recorded speech, cut at its pauses, to be laid on other people's talk.

A talk segment of the meeting is filled with the speech that *ends* at a phrase end of the recording, so that the fall
of the voice at the end of a phrase falls where the meeting's phrase ended; earlier phrases fill up the beginning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import oaconvolve

from sfms_robot.corpora.compose.motions import SHAPE, facegood_mouth
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_SAMPLES, SHAPES, Floats
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.events import runs, voice_activity
from sfms_robot.signals.tracks import read_track, resample

HELD_OUT: Final = ("1114_3_15", "katie", "audio_EN2006b_0-30s")  # whole recordings only heard in validation
_UNFIT: Final = ("katiesteve", "audio_ES2003a_0-30s")  # holds a voice kept for validation; hardly audible
_GRAIN: Final = AUDIO_HZ // 50  # 20 ms: pauses are cut out down to this
_PHRASE: Final = AUDIO_HZ // 5  # a pause this long ended a phrase
_JOIN: Final = AUDIO_HZ // 200  # 5 ms where two phrases meet
_FADE: Final = AUDIO_HZ // 50
_LEVEL: Final = 0.06  # RMS of speech


@dataclass(frozen=True)
class Voice:
    """One person's speech without its pauses.

    Attributes:
        name: of the recording.
        audio: (n,) 16 kHz, speech joined, RMS 0.06.
        origin: (n // 320,) sample of the recording at every 320th sample of `audio`.
        ends: (P,) samples of `audio` at which a phrase ends.
        mouth: (F, 52) by frame of the recording, or None.
        noise: (m,) magnitude spectrum of its pauses, flat where it has none.
        recording: (r,) 16 kHz, the recording as it is, RMS of its speech 0.06.
    """

    name: str
    audio: Floats
    origin: NDArray[np.int64]
    ends: NDArray[np.int64]
    mouth: Floats | None
    noise: NDArray[np.float64]
    recording: Floats


def find_voices(folders: Sequence[Path]) -> list[Voice]:
    """Every WAV file in the folders, or one level below them. Raises ConfigError when there is none."""
    files = [file for folder in folders for file in sorted([*folder.glob("*.wav"), *folder.glob("*/*.wav")])]
    voices = [read_voice(file) for file in files if file.stem not in _UNFIT]
    if not voices:
        raise ConfigError(f"{', '.join(map(str, folders))}: no WAV file to take voices from")
    return voices


def split_voices(voices: Sequence[Voice]) -> dict[str, list[Voice]]:
    """Whole recordings for training and for validation; a lone voice serves both."""
    held_out = [voice for voice in voices if voice.name in HELD_OUT]
    rest = [voice for voice in voices if voice.name not in HELD_OUT]
    return {"train": rest or held_out, "validation": held_out or rest[-1:]}


def read_voice(file: Path) -> Voice:
    """A WAV file, with the mouth recorded beside it (FACEGOOD weights, NAME.npz, or a face track) when there is one."""
    audio = read_audio(file)
    active = voice_activity(audio, AUDIO_HZ, _GRAIN / AUDIO_HZ)
    active = np.convolve(active, [1, 1, 1], "same") > 0  # a grain of margin: soft beginnings and endings
    speech = [(a * _GRAIN, b * _GRAIN) for a, b in runs(active) if b - a >= 5]
    if not speech:
        raise ConfigError(f"{file}: no speech found in it")
    pieces, breaks, total = [], [], 0
    for number, (start, end) in enumerate(speech):
        piece = audio[start:end].copy()
        piece[:_JOIN] *= np.linspace(0, 1, _JOIN, dtype=np.float32)
        piece[-_JOIN:] *= np.linspace(1, 0, _JOIN, dtype=np.float32)
        pieces.append(piece)
        total += len(piece)
        if number + 1 == len(speech) or speech[number + 1][0] - end >= _PHRASE:
            breaks.append(total)
    joined = np.concatenate(pieces)
    joined = _levelled(joined)
    keep = ~_lulls(joined)
    ends = np.cumsum(keep)[np.array(breaks) // _GRAIN - 1] * _GRAIN
    joined = joined.reshape(-1, _GRAIN)[keep].reshape(-1)
    origin = np.concatenate([np.arange(start, end, _GRAIN) for start, end in speech])[keep]
    name = file.parent.name.removeprefix("facegood_") if file.stem == "speech" else file.stem
    loudness = np.sqrt(np.mean(np.concatenate([audio[start:end] for start, end in speech]) ** 2))
    whole = np.asarray(np.clip(audio * (_LEVEL / loudness), -1, 1), np.float32)
    return Voice(name, joined, origin, ends, _mouth(file), _pause_spectrum(audio, active), whole)


def _levelled(speech: Floats) -> Floats:
    """Slow swings of loudness (somebody further from the microphone) mostly taken out; RMS 0.06."""
    window = AUDIO_HZ // 2
    power = uniform_filter1d(speech.astype(np.float64) ** 2, window, mode="nearest")
    even = speech * (power + 1e-4 * power.max()) ** -0.35
    return np.asarray(np.clip(even * (_LEVEL / np.sqrt(np.mean(even**2))), -1, 1), np.float32)


def _lulls(speech: Floats) -> NDArray[np.bool_]:
    """Grains (n // 320,) inside pauses that only show once loudness is levelled; 40 ms of each end of one stay."""
    out = ~voice_activity(speech, AUDIO_HZ, _GRAIN / AUDIO_HZ)
    for start, end in runs(out):
        out[start : start + 2] = out[max(start, end - 2) : end] = False
    return out


def _mouth(file: Path) -> Floats | None:
    weights = file.with_suffix(".npz")
    if weights.is_file():
        return facegood_mouth(weights)
    for track in (*sorted(file.parent.glob("*.csv.gz")), *sorted(file.parent.glob("*.csv"))):
        if track.name.split(".")[0] in (file.stem, "face"):
            shapes = resample(read_track(track), FRAME_HZ).motion[:, SHAPES]
            return np.nan_to_num(shapes)
    return None


def _pause_spectrum(audio: Floats, active: NDArray[np.bool_]) -> NDArray[np.float64]:
    grains = audio[: len(active) * _GRAIN].reshape(-1, _GRAIN)[~active]
    if len(grains) < 8 or np.sqrt(np.mean(grains**2)) < 1e-5:
        return np.ones(_GRAIN // 2 + 1)
    spectrum = np.abs(np.fft.rfft(grains * np.hanning(_GRAIN), axis=1)).mean(axis=0)
    return np.asarray(spectrum / np.sqrt(np.mean(spectrum**2)), np.float64)


def lay(
    segments_s: NDArray[np.float64], frames: int, voice: Voice, rng: np.random.Generator
) -> tuple[Floats, Floats | None]:
    """Fill talk segments (K, 2), seconds from 0, with a voice: audio (frames * 640,), mouth (frames, 52) or None."""
    audio = np.zeros(frames * FRAME_SAMPLES, np.float32)
    mouth = None if voice.mouth is None else np.zeros((frames, len(SHAPE)), np.float32)
    last = int(rng.integers(len(voice.ends)))
    for start_s, end_s in segments_s:
        start, end = (int(np.clip(round(t * AUDIO_HZ), 0, len(audio))) for t in (start_s, end_s))
        if end - start < 2 * _FADE:
            continue
        # Recordings go on where they were, a phrase or two further: the same words do not come at once again.
        last = (last + int(rng.integers(1, 4))) % len(voice.ends)
        index = np.arange(voice.ends[last] - (end - start), voice.ends[last]) % len(voice.audio)
        piece = voice.audio[index] * np.float32(rng.uniform(0.8, 1.25))
        piece[:_FADE] *= np.linspace(0, 1, _FADE, dtype=np.float32)
        piece[-_FADE:] *= np.linspace(1, 0, _FADE, dtype=np.float32)
        audio[start:end] = piece
        if mouth is not None and voice.mouth is not None:
            covered = np.arange(start // FRAME_SAMPLES, end // FRAME_SAMPLES)  # frames that end inside
            spoken = index[(covered + 1) * FRAME_SAMPLES - 1 - start] // _GRAIN
            rows = np.minimum(voice.origin[spoken] // FRAME_SAMPLES + 1, len(voice.mouth) - 1)
            mouth[covered] = voice.mouth[rows]
    return audio, None if mouth is None else _soften(mouth)


def _soften(mouth: Floats) -> Floats:
    """Short binomial smoothing: takes the edges off the joints, keeps syllables."""
    padded = np.pad(mouth, ((1, 1), (0, 0)), mode="edge")
    return np.asarray(0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:], np.float32)


def room(samples: int, voice: Voice, rng: np.random.Generator) -> Floats:
    """Noise floor with the colour of the recording's own pauses, -70 to -48 dB of full scale, slowly breathing."""
    flat = rng.standard_normal(samples, np.float32)
    kernel = np.fft.irfft(voice.noise).astype(np.float32)
    kernel = np.roll(kernel, len(kernel) // 2) * np.hanning(len(kernel)).astype(np.float32)
    coloured = oaconvolve(flat, kernel, mode="same")
    coloured /= np.sqrt(np.mean(coloured**2)) + 1e-12
    knots = np.arange(0, samples + AUDIO_HZ, AUDIO_HZ)
    level_db = rng.uniform(-70, -48) + np.interp(np.arange(samples), knots, rng.normal(0, 1, len(knots)))
    return np.asarray(coloured * 10 ** (level_db / 20), np.float32)
