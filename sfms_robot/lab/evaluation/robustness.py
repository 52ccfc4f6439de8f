"""Whom a listener has never met, heard and seen badly: its events have to stay as many as people's.

A speaker looks at the head all the time. Each is played as a voice, as a face, and as both, as recorded and spoilt in
one way at a time; every stream of a listener differs by its seed alone. What is counted is what is seen in its motion,
and what it has decided; of what comes only to somebody who speaks, a minute is one in which he does, or did two
seconds ago. Where nothing tells that he speaks (no microphone, a mouth that hangs) nothing has to answer him.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import soxr
from numpy.typing import NDArray
from scipy.signal import oaconvolve

from sfms_robot.frames import (
    AUDIO_HZ,
    CHANNEL_INDEX,
    FRAME_HZ,
    FRAME_S,
    FRAME_SAMPLES,
    POSE,
    SHAPES,
    Floats,
    SpeakerFrame,
)
from sfms_robot.lab.evaluation.detection import seen
from sfms_robot.lab.evaluation.phrase_timing import listening_mask, voice_activity
from sfms_robot.lab.evaluation.rollout import Rollout, speaker_frames
from sfms_robot.listeners.events.model import ALWAYS
from sfms_robot.signals.events import MOTION_EVENTS

Inputs = Literal["voice", "face", "both"]
Spoil = Callable[[Floats, np.random.Generator], Floats]

# Events a minute of people who are spoken to: nods of AMI's listeners, median person and speaker-rich meetings; blinks
# and smiles of people in conversation.
RANGES: Final[Mapping[str, tuple[float, float]]] = {"nod": (3.0, 7.0), "blink": (10.0, 25.0), "smile": (0.5, 1.5)}
DISPERSION: Final = (0.7, 2.0)  # variance over mean of counts: 1 is Poisson's
NOISE_DB: Final = -10.0  # below speech
RT60_S: Final = 0.6


@dataclass(frozen=True)
class Speaker:
    """Somebody who talks: voice (n,) 16 kHz, and face (N, 58) at 25 frames a second, or None: never filmed."""

    name: str
    voice: Floats
    face: Floats | None


@dataclass(frozen=True)
class Condition:
    """One way in which a microphone or a camera is not ideal.

    Attributes:
        voice, face: what becomes of the samples and of the motion.
        attention: number of frames -> (frames,) in place of looking at the head all the time.
        mouth_moves: it is still to be seen that he speaks.
    """

    name: str
    voice: Spoil | None = None
    face: Spoil | None = None
    attention: Callable[[int], Floats] | None = None
    mouth_moves: bool = True

    def concerns(self, inputs: Inputs) -> bool:
        """It changes something of what is heard and seen, or is what the others are compared with."""
        of_voice, of_face = self.voice is not None, self.face is not None or self.attention is not None
        nothing = not of_voice and not of_face
        return nothing or (of_voice and inputs != "face") or (of_face and inputs != "voice")

    def tells_speech(self, inputs: Inputs) -> bool:
        """Whether a listener can know that somebody speaks."""
        return inputs != "face" or self.mouth_moves


def noise(voice: Floats, rng: np.random.Generator) -> Floats:
    """Noise that falls by 3 dB an octave, 10 dB below the voice."""
    spectrum = np.fft.rfft(rng.standard_normal(len(voice)))
    spectrum /= np.sqrt(np.maximum(np.arange(len(spectrum)), 1))
    pink = np.fft.irfft(spectrum, len(voice))
    level = _rms(voice) * 10 ** (NOISE_DB / 20) / _rms(pink)
    return _clipped(voice + level * pink)


def quiet(voice: Floats, rng: np.random.Generator) -> Floats:
    """20 dB down, as from across a room."""
    return _clipped(voice * 0.1)


def loud(voice: Floats, rng: np.random.Generator) -> Floats:
    """12 dB up, cut where the converter ends."""
    return _clipped(voice * 4.0)


def room(voice: Floats, rng: np.random.Generator) -> Floats:
    """As much from the walls as from the mouth, dying away by 60 dB in 0.6 s."""
    samples = round(RT60_S * AUDIO_HZ)
    tail = rng.standard_normal(samples) * 10 ** (-3 * np.arange(samples) / samples)
    walls = oaconvolve(voice, tail / np.sqrt(np.sum(tail**2)))[: len(voice)]
    return _clipped((voice + walls) / np.sqrt(2))


def telephone(voice: Floats, rng: np.random.Generator) -> Floats:
    """Through 8 kHz."""
    narrow = soxr.resample(soxr.resample(voice, AUDIO_HZ, AUDIO_HZ // 2), AUDIO_HZ // 2, AUDIO_HZ)
    return _clipped(np.pad(narrow, (0, max(0, len(voice) - len(narrow))))[: len(voice)])


def jitter(face: Floats, rng: np.random.Generator) -> Floats:
    """A tracker's scatter: 0.3 degrees, 2 mm, 0.03 of a blendshape."""
    sizes = np.r_[np.full(3, np.deg2rad(0.3)), np.full(3, 2e-3), np.full(52, 0.03)]
    out = face + sizes * rng.standard_normal(face.shape)
    out[:, SHAPES] = out[:, SHAPES].clip(0, 1)
    return np.asarray(out, np.float32)


def lost(face: Floats, rng: np.random.Generator) -> Floats:
    """Not found for every second second."""
    out = face.copy()
    out[np.arange(len(face)) // FRAME_HZ % 2 == 1] = np.nan
    return out


def constant(face: Floats, rng: np.random.Generator) -> Floats:
    """A tracker that hangs."""
    return np.repeat(face[:1], len(face), axis=0)


def saturated(face: Floats, rng: np.random.Generator) -> Floats:
    """Every blendshape at its end."""
    out = face.copy()
    out[:, SHAPES] = 1.0
    return out


def upside_down(face: Floats, rng: np.random.Generator) -> Floats:
    """A camera the wrong way up."""
    out = face.copy()
    out[:, POSE] *= -1
    out[:, CHANNEL_INDEX["roll"]] += np.pi
    return out


def _flickering(frames: int) -> Floats:
    return (np.arange(frames) % 2).astype(np.float32)


PLAIN: Final = Condition("as recorded")
FLICKER: Final = Condition("attention flickers", attention=_flickering)
CONDITIONS: Final = (
    PLAIN,
    *(Condition(spoil.__name__.replace("_", " "), voice=spoil) for spoil in (noise, quiet, loud, room, telephone)),
    *(
        Condition(
            f"face {spoil.__name__.replace('_', ' ')}", face=spoil, mouth_moves=spoil not in (constant, saturated)
        )
        for spoil in (jitter, lost, constant, saturated, upside_down)
    ),
    FLICKER,
)


def cases(speaker: Speaker) -> Iterator[tuple[Inputs, Condition]]:
    """Everything that a speaker is played as."""
    every: tuple[Inputs, ...] = ("voice",) if speaker.face is None else ("voice", "face", "both")
    for inputs in every:
        for condition in CONDITIONS:
            if condition.concerns(inputs):
                yield inputs, condition


def heard_and_seen(
    speaker: Speaker, inputs: Inputs, condition: Condition, minutes: float, rng: np.random.Generator
) -> list[SpeakerFrame]:
    """`minutes` of the speaker, again from the beginning where they are over sooner."""
    frames = round(60 * minutes * FRAME_HZ)
    voice = np.resize(speaker.voice, frames * FRAME_SAMPLES).astype(np.float32)
    voice = condition.voice(voice, rng) if condition.voice else voice
    face = np.full((frames, len(CHANNEL_INDEX)), np.nan, np.float32)
    if inputs != "voice" and speaker.face is not None:
        face = np.resize(speaker.face, face.shape).astype(np.float32)
        face = condition.face(face, rng) if condition.face else face
    attention = condition.attention(frames) if condition.attention else np.ones(frames, np.float32)
    return speaker_frames(None if inputs == "face" else voice, face, attention=attention)


def counted(played: Rollout) -> dict[str, list[int]]:
    """How many of each kind every stream did: seen in its motion, and `decided_`."""
    kinds = sorted({event.kind for events in played.events for event in events})
    decided = {
        f"decided_{kind}": [sum(event.kind == kind for event in events) for events in played.events] for kind in kinds
    }
    return {kind: [len(seen(motion, kind)) for motion in played.motion] for kind in MOTION_EVENTS} | decided


def listened_minutes(speaker: Speaker, minutes: float) -> float:
    """Of `minutes` of the speaker those in which he speaks, or did two seconds ago; by his voice as recorded."""
    voice = np.resize(speaker.voice, round(60 * minutes * FRAME_HZ) * FRAME_SAMPLES)
    return float(listening_mask(voice_activity(voice), FRAME_HZ).sum()) / FRAME_HZ / 60


def rates(
    counts: Mapping[str, Sequence[int]], minutes: float, listened: float | None = None
) -> dict[str, float | None]:
    """Of counts over streams: their mean a minute, and their variance over their mean (None of one, or of nothing).

    A minute of what comes only while listening is one of the `listened` (all, if not said).
    """
    figures: dict[str, float | None] = {}
    for kind, numbers in counts.items():
        mean = float(np.mean(numbers))
        always = listened is None or kind.removeprefix("decided_") in ALWAYS
        time = minutes if always else max(listened or 0.0, FRAME_S / 60)
        figures[f"{kind}s_per_minute"] = round(mean / time, 3)
        told = mean > 0 and len(numbers) > 1
        figures[f"{kind}s_variance_over_mean"] = round(float(np.var(numbers, ddof=1)) / mean, 3) if told else None
    return figures


def outside(row: Mapping[str, Any], tells_speech: bool = True) -> list[str]:
    """Which figures of a row are not people's; nobody answers whom nothing tells to speak."""
    return [
        f"{kind}s_per_minute"
        for kind, (least, most) in RANGES.items()
        if not (least if tells_speech or kind in ALWAYS else 0.0) <= row[f"{kind}s_per_minute"] <= most
    ]


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(np.asarray(values, np.float64) ** 2))) + 1e-12


def _clipped(values: NDArray[np.floating]) -> Floats:
    return np.asarray(np.clip(values, -1, 1), np.float32)
