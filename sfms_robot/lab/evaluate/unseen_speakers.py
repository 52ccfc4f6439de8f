"""`evaluate robustness`: speakers that no listener was trained on, heard and seen well and badly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from sfms_robot.config import find
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_SAMPLES
from sfms_robot.lab.corpora.compose.render_events import speaker_motion
from sfms_robot.lab.corpora.compose.voices import Voice, find_voices, mouth_over
from sfms_robot.lab.corpora.splits import Split, split_of_voice
from sfms_robot.lab.evaluate.task_pool import done_in_processes
from sfms_robot.lab.evaluation import robustness
from sfms_robot.lab.evaluation.robustness import CONDITIONS, DISPERSION, RANGES, Inputs, Speaker
from sfms_robot.lab.evaluation.rollout import rollout
from sfms_robot.listeners.registry import load_listener
from sfms_robot.ports import Listener
from sfms_robot.signals.motion_primitives import Motions, read_motions

VOICE_FOLDERS: Final = ("facegood_audio_mouth", "speech_audio", "conversation_audio", "ami_audio_clips")


@dataclass(frozen=True)
class _Task:
    """One speaker in one way.

    Attributes:
        voices: folders of WAV files; `speaker`: place of his among the voices of `split`.
    """

    folder: Path
    voices: tuple[Path, ...]
    split: Split
    speaker: int
    inputs: Inputs
    condition: int
    minutes: float
    seeds: int
    seed: int


def evaluate_robustness(
    name: str,
    data: Path | None,
    split: Split,
    speakers: int | None,
    minutes: float,
    seeds: int,
    seed: int,
    jobs: int | None,
) -> dict[str, Any]:
    """Events a minute of every speaker in every way, and how they scatter over seeds; beside people's.

    Raises ConfigError or ModelError, and for voices that were trained on.
    """
    if split == "train":
        raise ConfigError("--split train: listeners were trained on these voices; validation and test are others")
    folder = find("listeners", name, "config.yaml")
    load_listener(folder)  # what is wrong with it is said here, not by a process
    voices = voice_folders(data)
    everybody = unseen(voices, split)[:speakers]
    tasks = [
        _Task(folder, voices, split, place, inputs, CONDITIONS.index(condition), minutes, seeds, seed)
        for place, speaker in enumerate(everybody)
        for inputs, condition in robustness.cases(speaker)
    ]
    rows = done_in_processes(_play, tasks, jobs, "speakers heard")
    return {
        "listener": name,
        "split": split,
        "speakers": [speaker.name for speaker in everybody],
        "minutes": minutes,
        "seeds": seeds,
        "people": {f"{kind}s_per_minute": list(least_most) for kind, least_most in RANGES.items()},
        "people_variance_over_mean": list(DISPERSION),
        **_extremes(rows),
        "outside": [
            {**{key: row[key] for key in ("speaker", "inputs", "condition")}, "figures": wrong}
            for row in rows
            if (wrong := robustness.outside(row, row["tells_speech"]))
        ],
        "rows": rows,
    }


def voice_folders(data: Path | None) -> tuple[Path, ...]:
    """The bundled speakers, and the voices of a data folder."""
    if data is not None and not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    brought = [] if data is None else [data / name for name in VOICE_FOLDERS if (data / name).is_dir()]
    return (data_dir("sim") / "speakers", *brought)


@cache
def unseen(voices: tuple[Path, ...], split: Split = "test") -> tuple[Speaker, ...]:
    """Everybody in the folders whose voice is of `split`, by name. Raises ConfigError when there is nobody."""
    motions = read_motions(data_dir("sim") / "listeners" / "motions.npz")[split]
    kept = {voice.name: voice for voice in find_voices(voices) if split_of_voice(voice.name) == split}
    if not kept:
        raise ConfigError(f"{', '.join(map(str, voices))}: no voice that is kept for {split}")
    return tuple(_speaker(kept[name], motions, number) for number, name in enumerate(sorted(kept)))


def _speaker(voice: Voice, motions: Motions, number: int) -> Speaker:
    """His recording, and a face that says it: his own mouth where it was filmed, another's that opens with it else."""
    rng = np.random.default_rng(number)
    frames = len(voice.recording) // FRAME_SAMPLES
    mouth = voice.mouth if voice.mouth is not None else mouth_over(voice.recording, motions.talk, frames, rng)
    frames = min(frames, len(mouth))
    face = speaker_motion(mouth[:frames], motions, rng, attention=np.ones(frames, np.float32))
    return Speaker(voice.name, voice.recording[: frames * FRAME_SAMPLES], face)


def _play(task: _Task) -> dict[str, Any]:
    speaker, condition = unseen(task.voices, task.split)[task.speaker], CONDITIONS[task.condition]
    rng = np.random.default_rng([task.seed, task.speaker, task.condition])
    frames = robustness.heard_and_seen(speaker, task.inputs, condition, task.minutes, rng)
    played = rollout(_listener(task.folder), frames, range(task.seed, task.seed + task.seeds))
    counts = robustness.counted(played)
    return {
        "speaker": speaker.name,
        "inputs": task.inputs,
        "condition": condition.name,
        "tells_speech": condition.tells_speech(task.inputs),
        **robustness.rates(counts, len(frames) / FRAME_HZ / 60, robustness.listened_minutes(speaker, task.minutes)),
    }


@cache
def _listener(folder: Path) -> Listener:
    return load_listener(folder)


def _extremes(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Least and most over all speakers and ways, and the median scatter over seeds (None: nothing was done twice)."""
    found: dict[str, Any] = {}
    for kind in RANGES:
        rates = [row[f"{kind}s_per_minute"] for row in rows]
        scatter = [row[f"{kind}s_variance_over_mean"] for row in rows]
        known = [value for value in scatter if value is not None]
        found[f"{kind}s_per_minute"] = [min(rates), max(rates)]
        found[f"{kind}s_variance_over_mean"] = round(median(known), 3) if known else None
    return found
