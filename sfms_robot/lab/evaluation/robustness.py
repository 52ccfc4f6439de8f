"""`evaluate robustness`: events of a listener with unknown speakers, whose sound and face are good or degraded.

A speaker looks at the head all the time. Each is played as a voice, as a face, and as both, as recorded and degraded in
one way at a time; the streams of a listener differ only by their seeds. The events visible in its motion and its
decisions are counted, and have to stay as frequent as people's. Events that only answer a speaker are counted per
minute in which the speaker talks or stopped less than two seconds ago. Without evidence of speech (no microphone, a
mouth that does not move) no answer is expected.

Returned smiles (`returned_smiles`): all speakers kept out of training smile four times a minute, or never, and the
decisions for them are counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import starmap
from pathlib import Path
from statistics import median
from typing import Final, Literal

import numpy as np
import soxr
from numpy.typing import NDArray
from scipy.signal import oaconvolve

from sfms_robot.app.progress import tracked
from sfms_robot.config import Calmness
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    AUDIO_HZ,
    CHANNEL_INDEX,
    FRAME_HZ,
    FRAME_S,
    FRAME_SAMPLES,
    POSE,
    SHAPES,
    Doubles,
    FaceFrame,
    Floats,
    SpeakerFrame,
    clip_shapes,
)
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import Split, split_of_voice
from sfms_robot.lab.corpora.compose.motions import Rng
from sfms_robot.lab.corpora.compose.render_events import lay_smile, speaker_motion
from sfms_robot.lab.corpora.compose.voices import VOICE_FOLDERS, find_voices, mouth_over
from sfms_robot.lab.corpora.phrase_timing import listening_mask, minutes_of, voice_activity
from sfms_robot.lab.evaluation.detection import seen
from sfms_robot.lab.evaluation.intervals import mean_interval, rounded
from sfms_robot.lab.evaluation.rollout import Rollout, rollout, run_in_processes, speaker_frames
from sfms_robot.lab.evaluation.whole_recordings import decisions, event_spans, heard_in, scene_in
from sfms_robot.listeners.events.evidence import AT
from sfms_robot.listeners.events.model import ALWAYS, EventModel
from sfms_robot.listeners.registry import load_listener
from sfms_robot.signals import event_sizes as sizes
from sfms_robot.signals.events import MOTION_EVENTS
from sfms_robot.signals.motion_primitives import Motions, read_motions

Inputs = Literal["voice", "face", "both"]
Folders = tuple[Path, ...]
Degrade = Callable[[Floats, Rng], Floats]

# Events per minute of people in conversation: nods of AMI's listeners, median person and speaker-rich meetings.
RANGES: Final = {"nod": (3.0, 7.0), "blink": (10.0, 25.0), "smile": (0.5, 1.5)}
_DISPERSION: Final = (0.7, 2.0)  # variance over mean of counts: 1 is Poisson's
_NOISE_DB: Final = -10.0  # relative to speech
_RT60_S: Final = 0.6


def evaluate_robustness(
    name: str,
    data: Path | None,
    *,
    split: Split,
    speakers: int | None,
    minutes: float,
    seeds: int,
    seed: int,
    jobs: int | None,
) -> Figures:
    """Return events per minute for every speaker in every condition, their scatter over seeds, and people's figures.

    Raises ConfigError, also for voices that listeners were trained on, or ModelError.
    """
    if split == "train":
        raise ConfigError("--split train: listeners were trained on these voices; validation and test are others")
    load_listener(name)  # raises its errors here, not in a process
    voices = voice_folders(data)
    everybody = unseen(voices, split)[:speakers]
    tasks = [(place, inputs, number) for place in range(len(everybody)) for inputs, number in cases()]
    work = partial(_play, name, voices, split, minutes, range(seed, seed + seeds))
    rows = run_in_processes(work, tasks, jobs, "speakers heard")
    found: Figures = {"returned_smiles": returned_smiles(voices, speakers, minutes, range(seed, seed + seeds))}
    for kind in RANGES:
        rate_key, scatter_key = f"{kind}s_per_minute", f"{kind}s_variance_over_mean"
        values = [row[rate_key] for row in rows]
        known = [row[scatter_key] for row in rows if row[scatter_key] is not None]
        found |= {rate_key: [min(values), max(values)], scatter_key: round(median(known), 3) if known else None}
    return {
        "listener": name,
        "split": split,
        "speakers": [speaker.name for speaker in everybody],
        "minutes": minutes,
        "seeds": seeds,
        "people": {f"{kind}s_per_minute": list(least_most) for kind, least_most in RANGES.items()},
        "people_variance_over_mean": list(_DISPERSION),
        **found,
        "outside": [
            {**{key: row[key] for key in ("speaker", "inputs", "condition")}, "figures": wrong}
            for row in rows
            if (wrong := outside(row, row["tells_speech"]))
        ],
        "rows": rows,
    }


def _play(
    listener: str, voices: Folders, split: Split, minutes: float, seeds: range, task: tuple[int, Inputs, int]
) -> Figures:
    """Play one speaker in one condition; `task`: place among the voices of `split`, inputs, place in `CONDITIONS`."""
    place, inputs, number = task
    speaker, condition = unseen(voices, split)[place], CONDITIONS[number]
    frames = heard_and_seen(speaker, inputs, condition, minutes, np.random.default_rng([seeds.start, place, number]))
    voice = np.resize(speaker.voice, len(frames) * FRAME_SAMPLES)  # as recorded
    listened = minutes_of(listening_mask(voice_activity(voice)))
    return {
        "speaker": speaker.name,
        "inputs": inputs,
        "condition": condition.name,
        "tells_speech": inputs != "face" or condition.mouth_moves,
        **rates(counted(rollout(_listener(listener), frames, seeds)), len(frames) / FRAME_HZ / 60, listened),
    }


_listener = cache(load_listener)


# --- speakers -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class UnseenSpeaker:
    """A person who talks: voice (N * 640,) at 16 kHz, and face (N, 58) at 25 frames a second."""

    name: str
    voice: Floats
    face: Floats


def motions_of(split: Split) -> Motions:
    """Return the bundled motions of a part of the people."""
    return read_motions(data_dir("sim") / "listeners" / "motions.npz")[split]


def voice_folders(data: Path | None) -> Folders:
    """Return the folders of the bundled speakers and of the voices in a data folder."""
    if data is not None and not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    brought = [] if data is None else [data / name for name in VOICE_FOLDERS if (data / name).is_dir()]
    return (data_dir("sim") / "speakers", *brought)


def unseen(voices: Folders, split: Split = "test") -> tuple[UnseenSpeaker, ...]:
    """Return all speakers in the folders whose voice is of `split`, by name. Raises ConfigError without any."""
    found = _kept(voices, split)
    if not found:
        raise ConfigError(f"{', '.join(map(str, voices))}: no voice that is kept for {split}")
    return found


@cache
def _kept(voices: Folders, split: Split) -> tuple[UnseenSpeaker, ...]:
    """Return the speakers of `unseen`; empty if no voice is kept for the split.

    The face has the speaker's own mouth if it was filmed, else another person's mouth that opens with the voice.
    """
    motions = motions_of(split)
    kept = {voice.name: voice for voice in find_voices(voices) if split_of_voice(voice.name) == split}

    def speaker(number: int, name: str) -> UnseenSpeaker:
        rng, recording, mouth = np.random.default_rng(number), kept[name].recording, kept[name].mouth
        frames = len(recording) // FRAME_SAMPLES
        mouth = (mouth_over(recording, motions.talk, frames, rng) if mouth is None else mouth)[:frames]
        face = speaker_motion(mouth, motions, rng, attention=np.ones(len(mouth), np.float32))
        return UnseenSpeaker(name, recording[: len(mouth) * FRAME_SAMPLES], face)

    return tuple(starmap(speaker, enumerate(sorted(kept))))


# --- conditions -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class InputCondition:
    """One way in which a microphone or a camera is not ideal.

    Attributes:
        voice, face: Functions that change the samples, which are clipped afterwards, and the motion.
        attention: Number of frames -> (frames,); if None, the speaker looks at the head all the time.
        mouth_moves: The face still shows speech.
    """

    name: str
    voice: Degrade | None = None
    face: Degrade | None = None
    attention: Callable[[int], Floats] | None = None
    mouth_moves: bool = True


def noise(voice: Floats, rng: Rng) -> Floats:
    """Add noise that falls by 3 dB an octave, 10 dB below the voice."""
    spectrum = np.fft.rfft(rng.standard_normal(len(voice)))
    spectrum /= np.sqrt(np.maximum(np.arange(len(spectrum)), 1))
    pink = np.fft.irfft(spectrum, len(voice))
    level = _rms(voice) * 10 ** (_NOISE_DB / 20) / _rms(pink)
    return voice + (level * pink).astype(np.float32)


def quiet(voice: Floats, rng: Rng) -> Floats:
    """Attenuate by 20 dB, as from across a room."""
    return voice * 0.1


def loud(voice: Floats, rng: Rng) -> Floats:
    """Amplify by 12 dB, beyond what a microphone can give."""
    return voice * 4.0


def room(voice: Floats, rng: Rng) -> Floats:
    """Add as much sound from the walls as from the mouth, decaying by 60 dB in 0.6 s."""
    samples = round(_RT60_S * AUDIO_HZ)
    tail = rng.standard_normal(samples) * 10 ** (-3 * np.arange(samples) / samples)
    walls: Floats = oaconvolve(voice, tail / np.sqrt(np.sum(tail**2)))[: len(voice)].astype(np.float32)
    return (voice + walls) * math.sqrt(0.5)


def telephone(voice: Floats, rng: Rng) -> Floats:
    """Resample through 8 kHz."""
    narrow = soxr.resample(soxr.resample(voice, AUDIO_HZ, AUDIO_HZ // 2), AUDIO_HZ // 2, AUDIO_HZ)
    return np.pad(narrow, (0, max(0, len(voice) - len(narrow))))[: len(voice)]


def jitter(face: Floats, rng: Rng) -> Floats:
    """Add the scatter of a tracker: 0.3 degrees, 2 mm, 0.03 of a blendshape."""
    sizes = np.r_[np.full(3, np.deg2rad(0.3)), np.full(3, 2e-3), np.full(52, 0.03)]
    out = face + sizes * rng.standard_normal(face.shape)
    clip_shapes(out)
    return np.asarray(out, np.float32)


def lost(face: Floats, rng: Rng) -> Floats:
    """Lose the face for every second second."""
    out = face.copy()
    out[np.arange(len(face)) // FRAME_HZ % 2 == 1] = np.nan
    return out


def constant(face: Floats, rng: Rng) -> Floats:
    """Hold the first frame, like a tracker that hangs."""
    return np.repeat(face[:1], len(face), axis=0)


def saturated(face: Floats, rng: Rng) -> Floats:
    """Set every blendshape to its maximum."""
    out = face.copy()
    out[:, SHAPES] = 1.0
    return out


def upside_down(face: Floats, rng: Rng) -> Floats:
    """Turn the camera upside down."""
    out = face.copy()
    out[:, POSE] *= -1
    out[:, CHANNEL_INDEX["roll"]] += np.pi
    return out


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(np.asarray(values, np.float64) ** 2))) + 1e-12


CONDITIONS: Final = (
    InputCondition(name="as recorded"),
    *(InputCondition(name=each.__name__, voice=each) for each in (noise, quiet, loud, room, telephone)),
    *(
        InputCondition(
            name=f"face {each.__name__.replace('_', ' ')}", face=each, mouth_moves=each not in (constant, saturated)
        )
        for each in (jitter, lost, constant, saturated, upside_down)
    ),
    InputCondition(name="attention flickers", attention=lambda frames: (np.arange(frames) % 2).astype(np.float32)),
)


def cases() -> Iterator[tuple[Inputs, int]]:
    """Yield inputs of a speaker with the place of each condition that changes them or changes nothing at all."""
    inputs: Inputs
    for inputs in ("voice", "face", "both"):
        for number, how in enumerate(CONDITIONS):
            changed = {"face"} if how.face or how.attention else {"voice"} if how.voice else {"voice", "face"}
            if inputs == "both" or inputs in changed:
                yield inputs, number


def heard_and_seen(
    speaker: UnseenSpeaker, inputs: Inputs, condition: InputCondition, minutes: float, rng: Rng
) -> list[SpeakerFrame]:
    """Return `minutes` of the speaker, repeated from the beginning if the recording is shorter."""
    frames = round(60 * minutes * FRAME_HZ)
    voice = np.resize(speaker.voice, frames * FRAME_SAMPLES).astype(np.float32)
    if condition.voice:
        voice = np.clip(condition.voice(voice, rng), -1, 1).astype(np.float32)
    face = np.full((frames, len(CHANNEL_INDEX)), np.nan, np.float32)
    if inputs != "voice":
        face = np.resize(speaker.face, face.shape).astype(np.float32)
        face = condition.face(face, rng) if condition.face else face
    attention = condition.attention(frames) if condition.attention else np.ones(frames, np.float32)
    return speaker_frames(None if inputs == "face" else voice, face, attention=attention)


# --- smiles that are returned ---------------------------------------------------------------------------------------

THEIR_SMILES_A_MINUTE: Final = 4
ANSWER_S: Final = 1.5  # longest time from the onset of the speaker's smile to an answer
SHIFT_S: Final = 60.0
LEAST_MINUTES: Final = 3.0


def returned_smiles(voices: Folders, speakers: int | None, minutes: float, seeds: Sequence[int]) -> Figures:
    """Return figures of the smiles decided for speakers who smile four times a minute, or who never smile.

    `answered`: share of the speakers' smiles that are followed by a smile of the head within 1.5 s; `shifted`: the same
    with the speakers' smiles moved by a minute; `difference` of both, with its interval over speakers and seeds.
    `never_smiles_per_minute`: the head's smiles if the same speakers never smile; `false_per_minute`: those that follow
    a smile seen in a talking mouth.
    """
    people = [speaker for split in ("validation", "test") for speaker in _kept(voices, split)][:speakers]
    model, motions = EventModel.load(), motions_of("test")
    length_s, calm = 60 * max(minutes, LEAST_MINUTES), Calmness()
    answered, rates_a_minute, false = [], [], []
    for place, speaker in enumerate(tracked(people, "smiles returned")):
        rng = np.random.default_rng([seeds[0], place])
        plain = heard_and_seen(speaker, "both", CONDITIONS[0], length_s / 60, rng)
        face = np.array([frame.face.motion for frame in plain if frame.face is not None], np.float32)
        every_s = 60 / THEIR_SMILES_A_MINUTE
        onsets_s = np.arange(every_s / 2, len(face) * FRAME_S - every_s / 2, every_s)
        onsets_s += rng.uniform(-every_s / 4, every_s / 4, len(onsets_s))
        for start_s in onsets_s.tolist():
            lay_smile(face[:, SHAPES], start_s, sizes.smile_s(rng), rng.uniform(*sizes.THEIR_SMILE), 0.1, motions, rng)
        clip_shapes(face)
        pairs = zip(plain, face, strict=True)
        smiling = [replace(frame, face=FaceFrame.of(frame.time_s, row)) for frame, row in pairs]
        for own in decisions(model, heard_in(scene_in(smiling)), seeds, calm):
            begun_s = event_spans(own, "smile")[:, 0]
            moved_s = (onsets_s + SHIFT_S) % length_s
            answered.append([_share_followed(at_s, begun_s) for at_s in (onsets_s, moved_s)])
        heard = heard_in(scene_in(plain))
        seen_s = np.asarray(np.flatnonzero(heard[:, AT["others_smile_s"]] == 0) * FRAME_S, np.float64)
        for own in decisions(model, heard, seeds, calm):
            begun_s = event_spans(own, "smile")[:, 0]
            rates_a_minute.append(len(begun_s) / length_s * 60)
            false.append(_share_followed(seen_s, begun_s) * len(seen_s) / length_s * 60)
    shares = np.array(answered)
    difference = shares[:, 0] - shares[:, 1]
    return {
        "split": "validation and test",
        "speakers": [speaker.name for speaker in people],
        "minutes": length_s / 60,
        "answered": rounded(shares[:, 0].mean()),
        "shifted": rounded(shares[:, 1].mean()),
        "difference": rounded(difference.mean()),
        "interval": mean_interval(difference),
        "never_smiles_per_minute": rounded(float(np.mean(rates_a_minute))),
        "false_per_minute": rounded(float(np.mean(false))),
    }


def _share_followed(at_s: Doubles, begun_s: Doubles) -> float:
    """Return the share of instants `at_s` with a beginning within `ANSWER_S` after them; 0 without instants."""
    if not len(at_s):
        return 0.0
    first = np.searchsorted(begun_s, at_s)
    gaps_s = np.r_[begun_s, np.inf][first] - at_s
    return float((gaps_s <= ANSWER_S).mean())


# --- counts ---------------------------------------------------------------------------------------------------------


def counted(played: Rollout) -> dict[str, list[int]]:
    """Return the number of events of each kind per stream: visible in the motion, and `decided_`."""
    kinds = sorted({event.kind for events in played.events for event in events})
    decided = {
        f"decided_{kind}": [sum(event.kind == kind for event in events) for events in played.events] for kind in kinds
    }
    return {kind: [len(seen(motion, kind)) for motion in played.motion] for kind in MOTION_EVENTS} | decided


def rates(counts: Mapping[str, Sequence[int]], minutes: float, listened: float) -> dict[str, float | None]:
    """Return the mean per minute and the variance over the mean of counts over streams; None if undefined.

    Events that only answer a speaker are counted per minute of `listened`: the speaker talks, or stopped less than 2 s
    ago.
    """
    figures: dict[str, float | None] = {}
    for kind, numbers in counts.items():
        mean = float(np.mean(numbers))
        time = minutes if kind.removeprefix("decided_") in ALWAYS else max(listened, FRAME_S / 60)
        figures[f"{kind}s_per_minute"] = round(mean / time, 3)
        several = mean > 0 and len(numbers) > 1
        figures[f"{kind}s_variance_over_mean"] = round(float(np.var(numbers, ddof=1)) / mean, 3) if several else None
    return figures


def outside(row: Figures, tells_speech: bool = True) -> list[str]:
    """Return the figures of a row outside people's ranges; without evidence of speech, 0 is inside."""
    return [
        f"{kind}s_per_minute"
        for kind, (least, most) in RANGES.items()
        if not (least if tells_speech or kind in ALWAYS else 0.0) <= row[f"{kind}s_per_minute"] <= most
    ]
