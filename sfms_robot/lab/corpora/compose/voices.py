"""Recorded speech, cut at its pauses, that replaces the speech of people in a meeting.

A talk segment of the meeting is filled with speech that *ends* at a phrase end of the recording, so that the fall of
the voice at the end of a phrase comes where the meeting's phrase ended; earlier phrases fill the beginning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, uniform_filter1d
from scipy.signal import oaconvolve

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, BLENDSHAPES, FRAME_HZ, FRAME_SAMPLES, SHAPES, Bools, Doubles, Floats
from sfms_robot.lab.corpora.clips import SPLITS, Split, by_split, split_of_voice
from sfms_robot.lab.corpora.collection import columns
from sfms_robot.lab.corpora.compose.motions import SHAPE, Rng, pick
from sfms_robot.lab.corpora.phrase_timing import voice_activity
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.events import runs
from sfms_robot.signals.tracks import read_track, resample

VOICE_FOLDERS: Final = (
    "facegood_audio_mouth",
    "speech_audio",
    "conversation_audio",
    "ami_audio_clips",
)  # of a data folder
_SOUNDS: Final = (".wav", ".flac")
# Not used: two people in one track, hardly audible, hardly any speech, or people talking over one another.
_UNFIT: Final = (
    "katiesteve", "audio_ES2003a", "audio_EN2001b", "audio_EN2001d", "audio_EN2002", "audio_EN2009b", "pair_",
)  # fmt: skip
_LAUGH_S: Final = 0.4  # shorter laughs are only a puff of breath
_GRAIN: Final = AUDIO_HZ // 50  # 20 ms, the resolution at which pauses are cut out
_PHRASE: Final = AUDIO_HZ // 5  # a pause of this length ends a phrase
_JOIN: Final = AUDIO_HZ // 200  # 5 ms, fade where two pieces are joined
_FADE: Final = AUDIO_HZ // 50
_LEVEL: Final = 0.06  # RMS of speech


@dataclass(frozen=True, kw_only=True)
class VoiceClip:
    """One person's speech without its pauses.

    Attributes:
        name: of the recording.
        audio: (n,) 16 kHz, speech joined, RMS 0.06.
        origin: (n // 320,) sample of the recording at every 320th sample of `audio`.
        ends: (P,) samples of `audio` at which a phrase ends.
        mouth: (F, 52) by frame of the recording, or None.
        noise: (m,) magnitude spectrum of its pauses; flat if they are too short or silent.
        recording: (r,) 16 kHz, the whole recording, RMS of its speech 0.06.
    """

    name: str
    audio: Floats
    origin: NDArray[np.int64]
    ends: NDArray[np.int64]
    mouth: Floats | None
    noise: Doubles
    recording: Floats


def find_voices(folders: Sequence[Path]) -> list[VoiceClip]:
    """Read every WAV and FLAC file in the folders, or one level below. Raises ConfigError when there is none."""
    files = [file for folder in folders for file in sorted([*folder.glob("*"), *folder.glob("*/*")])]
    voices = [read_voice(file) for file in files if file.suffix in _SOUNDS and not file.stem.startswith(_UNFIT)]
    if not voices:
        raise ConfigError(f"{', '.join(map(str, folders))}: no WAV or FLAC file to take voices from")
    return voices


def split_voices(voices: Sequence[VoiceClip]) -> dict[Split, list[VoiceClip]]:
    """Return whole recordings by split (`clips.VOICES`); a split without any recording gets all of them."""
    parts = by_split((split_of_voice(voice.name), voice) for voice in voices)
    return {split: parts[split] or list(voices) for split in SPLITS}


def find_laughter(folders: Sequence[Path]) -> dict[Split, list[Floats]]:
    """Return annotated laughs without speech over them, (n,) 16 kHz each, by split; may be empty.

    Reads the table words.csv.gz (clip, start_s, end_s, kind, text) in the folder of the clips, if there is one. Raises
    ConfigError for a broken table or clip.
    """
    found: list[tuple[Split, Floats]] = []
    for folder in folders:
        file = folder / "words.csv.gz"
        rows = columns(file) if file.is_file() else {}
        if not {"clip", "start_s", "end_s", "kind", "text"} <= rows.keys():
            continue
        spans_s = (map(float, rows[name]) for name in ("start_s", "end_s"))
        said = list(zip(rows["clip"], *spans_s, rows["kind"], rows["text"], strict=True))
        for clip, start, end, _, text in said:
            spoken_into = any(c == clip and kind == "w" and a < end and b > start for c, a, b, kind, _ in said)
            if text == "laugh" and end - start >= _LAUGH_S and not spoken_into and (folder / clip).is_file():
                audio = read_audio(folder / clip)[int(start * AUDIO_HZ) : int(end * AUDIO_HZ)]
                if audio.any():  # a laugh after the end of its clip is empty
                    gain = _LEVEL / np.sqrt(np.mean(audio**2))
                    found.append((split_of_voice(Path(clip).stem), _eased(np.clip(audio * gain, -1, 1))))
    return by_split(found)


def laugh(speech: Floats, spans_s: Doubles, laughter: Sequence[Floats], rng: Rng) -> Floats:
    """Return speech (n,) with laughs in the spans (K, 2), or unchanged if `laughter` is empty."""
    out = speech.copy()
    for start_s, end_s in spans_s if laughter else ():
        at, end = (int(np.clip(t * AUDIO_HZ, 0, len(out))) for t in (start_s, end_s))
        while end - at > _FADE:
            piece = pick(laughter, rng)[: end - at]
            out[at : at + len(piece)] += np.float32(rng.uniform(0.5, 1.2)) * _eased(piece)
            at += len(piece)
    return out


def _eased(sound: Floats, longest: int = _FADE) -> Floats:
    """Return sound (n,) that fades in and out over `longest` samples, or over half its length if it is short."""
    ramp = np.ones(len(sound), np.float32)
    fade = min(longest, len(sound) // 2)
    ramp[:fade] = np.linspace(0, 1, fade)
    ramp[len(ramp) - fade :] = np.linspace(1, 0, fade)
    return sound * ramp


def read_voice(file: Path) -> VoiceClip:
    """Read a sound file, and the mouth recorded with it, if any (FACEGOOD weights, NAME.npz, or a face track)."""
    audio = read_audio(file)
    active = voice_activity(audio, _GRAIN / AUDIO_HZ)
    active = binary_dilation(active)  # one grain of margin keeps soft beginnings and endings
    speech = [(a * _GRAIN, b * _GRAIN) for a, b in runs(active) if b - a >= 5]
    if not speech:
        raise ConfigError(f"{file}: no speech found in it")
    pieces, breaks, total = [], [], 0
    for number, (start, end) in enumerate(speech):
        pieces.append(_eased(audio[start:end], _JOIN))
        total += end - start
        if number + 1 == len(speech) or speech[number + 1][0] - end >= _PHRASE:
            breaks.append(total)
    joined = _levelled(np.concatenate(pieces))
    keep = ~_lulls(joined)
    ends = np.cumsum(keep)[np.array(breaks) // _GRAIN - 1] * _GRAIN
    origin = np.concatenate([np.arange(start, end, _GRAIN) for start, end in speech])[keep]
    loudness = np.sqrt(np.mean(np.concatenate([audio[start:end] for start, end in speech]) ** 2))
    return VoiceClip(
        name=file.parent.name.removeprefix("facegood_") if file.stem == "speech" else file.stem,
        audio=joined.reshape(-1, _GRAIN)[keep].ravel(),
        origin=origin,
        ends=ends,
        mouth=_mouth(file),
        noise=_pause_spectrum(audio, active),
        recording=np.clip(audio * (_LEVEL / loudness), -1, 1),
    )


def _levelled(speech: Floats) -> Floats:
    """Return the sound with slow swings of loudness (distance to the microphone) mostly removed; RMS 0.06."""
    window = AUDIO_HZ // 2
    power = uniform_filter1d(speech.astype(np.float64) ** 2, window, mode="nearest")
    even = speech * (power + 1e-4 * power.max()) ** -0.35
    return np.asarray(np.clip(even * (_LEVEL / np.sqrt(np.mean(even**2))), -1, 1), np.float32)


def _lulls(speech: Floats) -> Bools:
    """Return a mask (n // 320,) of pauses that appear only after levelling, without 40 ms at each of their ends."""
    out = ~voice_activity(speech, _GRAIN / AUDIO_HZ)
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


# FACEGOOD's mouth controls and their weights, by ARKit channel. mouth_oh_c has half the weight because it reaches 1 in
# ordinary speech. If several controls drive a channel, the largest counts.
FACEGOOD: Final = {
    "jawOpen": (("mouth_stretch_c", 1.0),),
    "jawLeft": (("jaw_sideways_l", 1.0),),
    "mouthFunnel": (("mouth_funnel_", 1.0),),
    "mouthPucker": (("mouth_oh_c", 0.5), ("mouth_pucker_", 1.0), ("mouth_oo_c", 1.0)),
    "mouthSmile": (("mouth_lipCornerPull_", 1.0), ("mouth_lipCornerPullOpen_", 1.0)),
    "mouthStretch": (("mouth_lipStretch_", 1.0),),
    "mouthDimple": (("mouth_dimple_", 1.0),),
    "mouthPress": (("mouth_press_", 1.0),),
    "mouthRollLower": (("mouth_suck_d", 1.0),),
    "mouthRollUpper": (("mouth_suck_u", 1.0),),
    "mouthLowerDown": (("mouth_lowerLipDepress_", 1.0),),
    "mouthUpperUp": (("mouth_upperLipRaise_", 1.0),),
}


def facegood_mouth(file: Path) -> Floats:
    """Return mouth weights of a FACEGOOD take as (N, 52) at 25 fps. Raises ConfigError."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            weights, names, fps = arrays["weights"], arrays["names"], float(arrays["fps"])
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: not a file of mouth weights: {error}") from error
    shapes = np.zeros((len(weights), len(BLENDSHAPES)), np.float32)
    for control, values in zip(names.tolist(), weights.T, strict=True):
        side = {"_l": "Left", "_r": "Right"}.get(control[-2:], "")
        for channel, controls in FACEGOOD.items():
            at = SHAPE.get(channel, SHAPE.get(channel + side))
            for prefix, gain in controls:
                if at is not None and control.startswith(prefix):
                    shapes[:, at] = np.maximum(shapes[:, at], gain * values)
    return at_25_hz(np.arange(len(shapes)) / fps, np.clip(shapes, 0, 1))


def at_25_hz(times_s: NDArray[np.floating], values: Floats) -> Floats:
    """Interpolate values (M, C) to 25 fps from times_s[0] on; return (N, C)."""
    grid = np.arange(times_s[0], times_s[-1], 1 / FRAME_HZ)
    return np.stack([np.interp(grid, times_s, column) for column in values.T], axis=1).astype(np.float32)


def _pause_spectrum(audio: Floats, active: Bools) -> Doubles:
    grains = audio[: len(active) * _GRAIN].reshape(-1, _GRAIN)[~active]
    if len(grains) < 8 or np.sqrt(np.mean(grains**2)) < 1e-5:
        return np.ones(_GRAIN // 2 + 1)
    spectrum = np.abs(np.fft.rfft(grains * np.hanning(_GRAIN), axis=1)).mean(axis=0)
    return np.asarray(spectrum / np.sqrt(np.mean(spectrum**2)))


def lay(segments_s: Doubles, frames: int, voice: VoiceClip, rng: Rng) -> tuple[Floats, Floats | None]:
    """Fill talk segments (K, 2) [s] with a voice; return audio (frames * 640,), and mouth (frames, 52) or None."""
    audio = np.zeros(frames * FRAME_SAMPLES, np.float32)
    mouth = None if voice.mouth is None else np.zeros((frames, len(SHAPE)), np.float32)
    last = rng.integers(len(voice.ends))
    for start_s, end_s in segments_s:
        start, end = (int(np.clip(round(t * AUDIO_HZ), 0, len(audio))) for t in (start_s, end_s))
        if end - start < 2 * _FADE:
            continue
        # Continue one to three phrases further in the recording, so that the same words are not repeated at once.
        last = (last + rng.integers(1, 4)) % len(voice.ends)
        index = np.arange(voice.ends[last] - (end - start), voice.ends[last]) % len(voice.audio)
        audio[start:end] = _eased(voice.audio[index] * np.float32(rng.uniform(0.8, 1.25)))
        if mouth is not None and voice.mouth is not None:
            covered = np.arange(start // FRAME_SAMPLES, end // FRAME_SAMPLES)  # frames that end inside the segment
            spoken = index[(covered + 1) * FRAME_SAMPLES - 1 - start] // _GRAIN
            rows = np.minimum(voice.origin[spoken] // FRAME_SAMPLES + 1, len(voice.mouth) - 1)
            mouth[covered] = voice.mouth[rows]
    return audio, None if mouth is None else _soften(mouth)


def _soften(mouth: Floats) -> Floats:
    """Smooth over three frames (binomial): joins lose their edges, syllables stay."""
    padded = np.pad(mouth, ((1, 1), (0, 0)), mode="edge")
    return np.asarray(0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:], np.float32)


def room(samples: int, voice: VoiceClip, rng: Rng) -> Floats:
    """Return a noise floor with the spectrum of the recording's pauses, drifting, at -70 to -48 dB of full scale."""
    kernel = np.fft.irfft(voice.noise).astype(np.float32)
    kernel = np.roll(kernel, len(kernel) // 2) * np.hanning(len(kernel)).astype(np.float32)
    coloured = oaconvolve(rng.standard_normal(samples, np.float32), kernel, mode="same")
    coloured /= np.sqrt(np.mean(coloured**2)) + 1e-12
    knots = np.arange(0, samples + AUDIO_HZ, AUDIO_HZ)
    level_db = rng.uniform(-70, -48) + np.interp(np.arange(samples), knots, rng.normal(0, 1, len(knots)))
    return np.asarray(coloured * 10 ** (level_db / 20), np.float32)


def reverberant(speech: Floats, rng: Rng) -> Floats:
    """Return speech in a room of 0.12 to 0.4 s reverberation, 6 to 16 dB below the direct sound."""
    length_s = rng.uniform(0.12, 0.4)
    times = np.arange(int(length_s * AUDIO_HZ)) / AUDIO_HZ
    tail = rng.standard_normal(len(times)) * 10 ** (-3 * times / length_s)
    tail *= 10 ** (-rng.uniform(6, 16) / 20) / np.sqrt(np.sum(tail**2))
    return np.asarray(speech + oaconvolve(speech, tail)[: len(speech)], np.float32)


def mouth_over(speech: Floats, talk: Sequence[Floats], frames: int, rng: Rng) -> Floats:
    """Return a mouth (frames, 52) for a voice that was not filmed: a recorded mouth that opens when the voice sounds.

    It fits the words no better than any other mouth; only the time and size of its movements come from this voice.
    """
    source = pick(talk, rng)
    piece = np.roll(source, rng.integers(len(source)), axis=0)[np.arange(frames) % len(source)]
    power = uniform_filter1d(speech[: frames * FRAME_SAMPLES].astype(np.float64) ** 2, 3 * FRAME_SAMPLES)
    level_db = 10 * np.log10(power[FRAME_SAMPLES - 1 :: FRAME_SAMPLES] + 1e-10)
    open_share = np.clip((level_db - 20 * np.log10(_LEVEL) + 26) / 20, 0, 1)
    return _soften(np.asarray(piece * open_share[:, None], np.float32))
