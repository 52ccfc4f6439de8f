"""`evaluate naturalness`: a listener's motion beside that of people whose motion it was never trained on."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, Doubles, Floats, SpeakerFrame
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import usable
from sfms_robot.lab.corpora.conversion import at_frame_rate
from sfms_robot.lab.corpora.formats import detect, open_for, split_names
from sfms_robot.lab.corpora.reading import speaks
from sfms_robot.lab.evaluation import manners as manner
from sfms_robot.lab.evaluation.rollout import frames_of_dyad, rollout
from sfms_robot.lab.evaluation.two_sample import FOLDS, REGIONS, Told, levelled, told_apart, windows
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.registry import engine_name, load_listener, one_thread
from sfms_robot.ports import Listener

DRIFT_S: Final = 600.0
_FIGURES: Final = ("nod_deg", "nod_s", "nod_swings", "blink_s", "smile_s", "look_s")
_LEAST_DYADS: Final = 2 * FOLDS


def evaluate_naturalness(
    name: str, data: Path, split: str, clips: int | None, drift_s: float, seed: int, engine: EngineName = "auto"
) -> dict[str, Any]:
    """Roll a listener out over the dyads of `split`, and hold what it did against what their listeners did.

    Raises ConfigError for fewer than ten dyads, and for people who were trained on. Blocks for minutes; shows how far
    it is.
    """
    one_thread()
    if split == "train":
        raise ConfigError("--split train: listeners were trained on these people; validation and test are others")
    dyads = _spread([at_frame_rate(dyad) for dyad in usable(open_for("arkit58", data, split))], clips)
    if len(dyads) < _LEAST_DYADS:
        raise ConfigError(f"{data}: {len(dyads)} dyads of {split}; people are told apart in {_LEAST_DYADS} or more")
    listener = load_listener(find("listeners", name, "config.yaml"), engine=engine)
    heard = [frames_of_dyad(dyad) for dyad in dyads]
    with Progress(console=Console(stderr=True)) as progress:
        playing = progress.add_task(f"{name} listens", total=len(dyads) + 1)
        ours = []
        for number, speaker in enumerate(heard):
            ours.append(rollout(listener, speaker, [seed + number]).motion[0])
            progress.advance(playing)
        drift = long_run(listener, heard, drift_s, seed)
        progress.advance(playing)
        theirs, taught = [dyad.listener for dyad in dyads], of_training(data, len(dyads))
        judging = progress.add_task("telling apart", total=2 * (4 if taught else 2) * len(REGIONS) * FOLDS)
        told = two_samples(listening(dyads, ours), listening(dyads, theirs), taught, lambda: progress.advance(judging))
    addressed = [asked_for(dyad) for dyad in dyads]
    return {
        "listener": name,
        "engine": engine_name(listener),
        "split": split,
        "dyads": len(dyads),
        "minutes": round(sum(map(len, ours)) * FRAME_S / 60, 1),
        **told,
        **figures(manner.manners(ours, addressed), manner.manners(theirs, addressed)),
        **drifted(drift, theirs),
        "notes": list(notes(dyads, taught)),
    }


def notes(dyads: Sequence[Dyad], taught: Sequence[Floats]) -> Iterator[str]:
    """What the figures do not say by themselves."""
    unknown = sum(dyad.attention is None for dyad in dyads)
    if unknown:
        yield f"nobody knows where the person looks in {unknown} dyads: gaze counts all the time there"
    if not taught:
        yield "too few dyads of training: how well its people are told from these is not known"


def listening(dyads: Sequence[Dyad], motions: Sequence[Floats]) -> list[Floats]:
    """Windows (W, 50, 58) of each motion (N, 58) in which the dyad's listener says nothing: a mouth that talks is
    judged by its words (`evaluate interaction`).
    """
    rng = np.random.default_rng(0)
    return [windows(motion, rng, silent(dyad)[: len(motion)]) for dyad, motion in zip(dyads, motions, strict=True)]


def silent(dyad: Dyad) -> NDArray[np.bool_]:
    """(N,) frames in which the dyad's listener says nothing."""
    frames = len(dyad.listener)
    return np.ones(frames, bool) if dyad.agent_audio is None else ~speaks(dyad.agent_audio, frames, FRAME_HZ)


def of_training(data: Path, count: int) -> list[Floats]:
    """Windows, as of `listening`, of as many listeners of the training part; none where there are not so many."""
    if "train" not in split_names(*detect(data, "auto")):
        return []
    every = open_for("arkit58", data, "train")
    rows = np.linspace(0, len(every) - 1, min(count, len(every))).round().astype(int).tolist()
    some = [at_frame_rate(dyad) for dyad in usable(replace(every, clips=tuple(every.clips[row] for row in rows)))]
    return listening(some, [dyad.listener for dyad in some]) if len(some) == count else []


def _spread(dyads: Sequence[Dyad], most: int | None) -> list[Dyad]:
    if most is None or most >= len(dyads):
        return list(dyads)
    return [dyads[int(index)] for index in np.linspace(0, len(dyads) - 1, most).round()]


def asked_for(dyad: Dyad) -> NDArray[np.bool_]:
    """(N,) frames in which the person looks at the listener; all of them where nobody knows."""
    if dyad.attention is None:
        return np.ones(len(dyad.listener), bool)
    return np.asarray(dyad.attention > 0.5, bool)


def long_run(listener: Listener, heard: Sequence[Sequence[SpeakerFrame]], drift_s: float, seed: int) -> Floats:
    """(N, 58): one stream that hears one person after the other for so long."""
    frames: list[SpeakerFrame] = []
    while len(frames) < drift_s * FRAME_HZ:
        for speaker in heard:
            frames += speaker
    kept = frames[: round(drift_s * FRAME_HZ)]
    told = [_at(frame, (index + 1) * FRAME_S) for index, frame in enumerate(kept)]
    motion: Floats = rollout(listener, told, [seed]).motion[0]
    return motion


def _at(frame: SpeakerFrame, time_s: float) -> SpeakerFrame:
    return SpeakerFrame(time_s, frame.audio, frame.face, frame.agent_audio, frame.attention, frame.place_m)


def two_samples(
    ours: Sequence[Floats], theirs: Sequence[Floats], taught: Sequence[Floats], each: Callable[[], object]
) -> dict[str, Any]:
    """By region, `two_sample_auc` of windows by dyad, each with its interval over dyads; and for scale others.

    People against other people of the same part, and, where those `taught` are given, people of training against them:
    who imitates those without a flaw is told from these as often. How well it does is `imitated_two_sample_auc`, ours
    against people of training. `levelled_`: each motion by its own mean and deviation.
    """
    half = 2 * (len(theirs) // 2)
    pairs: dict[str, tuple[Sequence[Floats], ...]] = {
        "two_sample_auc": (ours, theirs),
        "person_two_sample_auc": (theirs[0:half:2], theirs[1:half:2]),
    }
    if taught:
        pairs["training_two_sample_auc"] = taught, theirs
        pairs["imitated_two_sample_auc"] = ours, taught
    pairs |= {f"levelled_{name}": tuple([*map(levelled, one)] for one in pair) for name, pair in pairs.items()}
    found = {
        name: {region: told_apart(one, other, region, each) for region in REGIONS}
        for name, (one, other) in pairs.items()
    }
    return {
        **{name: {region: round(told.auc, 3) for region, told in one.items()} for name, one in found.items()},
        "interval": {name: _intervals(one) for name, one in found.items()},
    }


def _intervals(found: Mapping[str, Told]) -> dict[str, list[float]]:
    return {region: [round(told.low, 3), round(told.high, 3)] for region, told in found.items()}


def figures(ours: manner.Manners, theirs: manner.Manners) -> dict[str, Any]:
    """Medians of both, the ratio of nod sizes, gaze, sway by band; None where nothing was found."""
    told: dict[str, Any] = {"nod_amplitude_ratio": _or_none(manner.ratio(ours.nod_deg, theirs.nod_deg))}
    for prefix, found in (("", ours), ("people_", theirs)):
        for figure in _FIGURES:
            told[prefix + figure] = _median(getattr(found, figure))
        told[f"{prefix}gaze_on_person"] = _or_none(found.on_person)
        told[f"{prefix}gaze_shifts_per_minute"] = _or_none(found.shifts_per_minute)
        for (low, high), power in zip(manner.SWAY_BANDS_HZ, found.sway_db, strict=True):
            told[f"{prefix}sway_db_{low:g}_{high:g}_hz"] = _or_none(float(power))
    return told


def drifted(motion: Floats, theirs: Sequence[Floats]) -> dict[str, Any]:
    """How far from the middle the head is at the end of a long run, and whether people's 1 to 99 % reach there."""
    end = np.median(manner.slow_poses_deg([motion])[-6:], axis=0)
    low, high = np.percentile(manner.slow_poses_deg(theirs), [1, 99], axis=0)
    outside = np.maximum(np.maximum(low - end, end - high), 0.0)
    return {
        "drift_deg": round(float(np.abs(end).max()), 2),
        "drift_outside_people_deg": round(float(outside.max()), 2),
        "people_pose_deg": {name: [round(float(a), 2), round(float(b), 2)] for name, a, b in
                            zip(("roll", "pitch", "yaw"), low, high, strict=True)},
    }  # fmt: skip


def _median(values: Doubles) -> float | None:
    return round(float(np.median(values)), 3) if len(values) else None


def _or_none(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
