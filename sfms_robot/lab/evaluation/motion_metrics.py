"""`evaluate metrics`: the papers' metrics of any motion compared with recorded motion, from files.

The prediction may come from another system: arrays and face tracks are scored by the same code as our tables. Earlier
work uses the same names for different definitions, so every row states its definition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app.progress import tracked
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Doubles
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.collection import npy
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.intervals import estimates, quotient
from sfms_robot.lab.evaluation.metrics import CLUSTERS, NEEDED_FRAMES, PARTS
from sfms_robot.signals.events import MOTION_EVENTS
from sfms_robot.signals.tracks import read_track, resample

ATTRIBUTES: Final = "attributes25"  # of the REACT challenge: 15 action units, valence, arousal, 8 expressions
WIDTHS: Final = {"arkit58": 58, "faceverse58": 58, "deca56": 56, ATTRIBUTES: 25}
_SPACES: Final = ", ".join(f"{channels} ({space})" for space, channels in WIDTHS.items())
_TRACKS: Final = (".csv", ".csv.gz")
_SHOWN: Final = 3  # names shown in a message


@dataclass(frozen=True)
class _Scored:
    """Clips (N, T, D) of one length, with the speaker's if given, and the K answers (N, K, T, D) to them."""

    space: str
    truth: Doubles
    answers: Doubles
    speaker: Doubles | None


def evaluate_metrics(
    truth: Path,
    prediction: Path,
    speaker: Path | None = None,
    *,
    space: str | None = None,
    frames: int | None = None,
    seed: int = 1,
) -> Figures:
    """Return rows of `name`, `part`, `definition`, `value` and `interval`: 95 % over clips, None if clips are pooled.

    Files are `.npy` arrays, face tracks (CSV, also gzipped), or folders of face tracks, matched by name. Values are
    means over the answers to a clip.

    Args:
        truth: (T, D) or (N, T, D).
        prediction: Like truth, or (N, K, T, D), K answers to every clip.
        speaker: Like truth; None: metrics that need it are left out.
        space: A key of `WIDTHS`; None: by the number of channels, where 58 means arkit58.
        frames: Length of the clips; None: that of the shortest clip.
        seed: Seed of the intervals.

    Raises ConfigError for files that do not match.
    """
    scored = _read(truth, prediction, speaker, space, frames)
    rows: list[Figures] = []
    for part, where in tracked(PARTS.get(scored.space, {}).items(), "scoring motion"):
        rows += [{"part": part} | row for row in _part_rows(scored, part, where, seed)]
    rows += [{"part": "all"} | row for row in _react_rows(scored)]
    if scored.space == "arkit58":
        rows += [{"part": "all"} | row for row in _event_rows(scored, seed)]
    clips, samples, frames, _ = scored.answers.shape
    return {"space": scored.space, "clips": clips, "frames": frames, "samples": samples, "rows": rows}


# --- files ----------------------------------------------------------------------------------------------------------


def _read(
    truth_file: Path, prediction_file: Path, speaker_file: Path | None, space: str | None, frames: int | None
) -> _Scored:
    truth, prediction = _clips(truth_file), _clips(prediction_file)
    given = {truth_file: truth, prediction_file: prediction}
    if speaker_file is not None:
        given[speaker_file] = _clips(speaker_file)
    width = next(iter(truth.values())).shape[-1]
    space = space or next((name for name, channels in WIDTHS.items() if channels == width), None)
    if space is None:
        raise ConfigError(f"{truth_file}: {width} channels, not {_SPACES}")
    if space not in WIDTHS:
        raise ConfigError(f"--space {space}: not one of {', '.join(WIDTHS)}")
    for path, clips in given.items():
        if list(clips) != list(truth):
            raise ConfigError(f"{path}: its clips ({_names(clips)}) are not those of {truth_file} ({_names(truth)})")
        for name, clip in clips.items():
            if clip.ndim > 3 or (clip.ndim == 3 and clips is not prediction):
                few = "only a prediction has several answers to a clip"
                raise ConfigError(f"{path}: clip {name} has shape {clip.shape}; {few}")
            if clip.shape[-1] != WIDTHS[space]:
                wrong = f"{clip.shape[-1]} channels, not {WIDTHS[space]}"
                raise ConfigError(f"{path}: clip {name} has {wrong}; known: {_SPACES}")
            if not np.isfinite(clip).all():
                raise ConfigError(f"{path}: clip {name} has values that are not finite (a face that was lost?)")
    lengths = {name: min(clips[name].shape[-2] for clips in given.values()) for name in truth}
    shortest = min(lengths.values())
    if frames is not None and frames > shortest:
        raise ConfigError(f"--frames {frames}: the shortest clip has {shortest}")

    def cut_alike(clips: dict[str, Doubles]) -> Doubles:
        return metrics.cut([clip[..., : lengths[name], :] for name, clip in clips.items()], frames or shortest)

    answers = cut_alike(prediction)
    return _Scored(
        space,
        cut_alike(truth),
        answers if answers.ndim == 4 else answers[:, None],
        None if speaker_file is None else cut_alike(given[speaker_file]),
    )


def _clips(path: Path) -> dict[str, Doubles]:
    """Return clips by name: the number in an array, or the names of a folder's files without their endings."""
    if path.is_dir():
        tracks = sorted(file for file in path.iterdir() if file.name.endswith(_TRACKS))
        if not tracks:
            raise ConfigError(f"{path}: no face track ({', '.join(_TRACKS)}) in this folder")
        return {file.name.split(".csv")[0]: _track(file) for file in tracks}
    if path.name.endswith(_TRACKS):
        return {"0": _track(path)}
    if path.suffix != ".npy":
        raise ConfigError(f"{path}: not a .npy array, a face track ({', '.join(_TRACKS)}) or a folder of face tracks")
    array = np.asarray(npy(path), np.float64)
    if not 2 <= array.ndim <= 4:
        raise ConfigError(f"{path}: shape {array.shape}, not (T, D), (N, T, D) or (N, K, T, D)")
    return {str(number): clip for number, clip in enumerate(array[None] if array.ndim == 2 else array)}


def _track(file: Path) -> Doubles:
    """Return (T, 58) at 25 Hz."""
    return resample(read_track(file), FRAME_HZ).motion.astype(np.float64)


def _names(clips: dict[str, Doubles]) -> str:
    names = list(clips)
    return ", ".join(names[:_SHOWN]) + (f", ... {len(names)} in all" if len(names) > _SHOWN else "")


# --- rows -----------------------------------------------------------------------------------------------------------


def _part_rows(scored: _Scored, part: str, where: slice, seed: int) -> Iterator[Figures]:
    """Yield the Learning2Listen line's metrics of a part of the face."""
    truth, answers = scored.truth[..., where], scored.answers[..., where]
    by_clip: dict[str, Callable[[Doubles, Doubles], float]] = {  # of truth and answer of a clip
        "L2: distance over channels": metrics.l2,
        "MSE: mean squared error": metrics.mse,
        "FD: of a clip's frames": metrics.frechet_distance,
        "Var: over time": lambda _, one: metrics.variance(one, "time"),
    }
    pooled: dict[str, Callable[[Doubles], float]] = {  # of the answers (N, T, D) to all clips
        "FD: of all frames": partial(metrics.frechet_distance, truth),
        "Var: of everything": metrics.variance,
        "Var: summed over channels": partial(metrics.variance, definition="sum"),
        "STS: of the clips end to end": partial(metrics.sts, truth),
    }
    if truth.shape[0] * truth.shape[1] >= CLUSTERS[part]:
        centres = metrics.cluster_centres(truth, CLUSTERS[part])
        pooled["SI: nats"] = partial(metrics.shannon_index, centres=centres)
    for name, score in by_clip.items():
        yield _over_clips(
            name, [[score(true, one) for one in clip] for true, clip in zip(truth, answers, strict=True)], seed
        )
    if scored.speaker is not None:
        speaker = scored.speaker[..., where]
        distance = metrics.paired_frechet_distance
        clips = zip(truth, answers, speaker, strict=True)
        paired = [[distance(true, one, person) for one in clip] for true, clip, person in clips]
        yield _over_clips("P-FD: of a clip's frames", paired, seed)
        pooled["P-FD: of all frames"] = lambda every: distance(truth, every, speaker)
        pooled["RPCC: flattened"] = lambda every: metrics.rpcc_flat(truth, every, speaker)
        pooled["RPCC: by clip and channel"] = lambda every: metrics.rpcc_channels(truth, every, speaker)
    for name, over_all in pooled.items():
        yield _row(name, float(np.mean([over_all(answers[:, k]) for k in range(answers.shape[1])])))


def _react_rows(scored: _Scored) -> Iterator[Figures]:
    """Yield the REACT challenge's metrics."""
    answers, truth, samples = scored.answers, scored.truth, scored.answers.shape[1]
    correlation = metrics.frc(answers, truth)
    if scored.space == ATTRIBUTES:
        distance = metrics.frd(answers, truth)
        yield _row("FRCorr: mean of the answers", correlation)
        yield _row("FRCorr: sum of the answers", samples * correlation)
        yield _row("FRDist: mean of the answers", distance)
        yield _row("FRDist: sum of the answers", samples * distance)
    else:
        yield _row("FRCorr: on coefficients, without ReactFace's factor of 10", correlation)
        yield _row("FRDist: ReactFace's, times 10", metrics.reactface_frd(answers, truth))
    yield _row("FRDiv: between answers", metrics.frdiv(answers))
    yield _row("FRVar: over time", metrics.frvar(answers))
    yield _row("FRDvs: between clips", metrics.frdvs(answers))
    if scored.speaker is not None and truth.shape[1] >= NEEDED_FRAMES[2]:
        yield _row("FRSyn: frames, as the challenge counts", metrics.frsyn(answers, scored.speaker))
        lag = metrics.frsyn(answers, scored.speaker, as_challenge=False)
        yield _row("FRSyn: frames, constant channels left out", lag if np.isfinite(lag) else None)


def _event_rows(scored: _Scored, seed: int) -> Iterator[Figures]:
    """Yield nods, blinks and smiles per minute of the prediction and of the truth, by this project's detectors."""
    minutes = scored.truth.shape[1] / FRAME_HZ / 60.0
    for event, kind in MOTION_EVENTS.items():
        for whose, clips in (("prediction", scored.answers), ("truth", scored.truth[:, None])):
            rates = [[len(kind.find(one, FRAME_HZ)) / minutes for one in clip] for clip in kind.signal(clips)]
            yield _over_clips(f"{event}s a minute: {whose}", rates, seed)


def _over_clips(name: str, values: Sequence[Sequence[float]], seed: int) -> Figures:
    """Return the mean over (N, K) values, with its interval over clips."""
    clips = [{"sum": np.array([float(np.mean(answers)), 1.0])} for answers in values]
    found = estimates({"mean": quotient("sum")}, clips, seed)["mean"]
    return _row(name, found.value, found.interval)


def _row(name: str, value: float | None, interval: tuple[float, float] | None = None) -> Figures:
    metric, definition = name.split(": ", 1)
    return {"name": metric, "definition": definition, "value": value, "interval": interval and list(interval)}
