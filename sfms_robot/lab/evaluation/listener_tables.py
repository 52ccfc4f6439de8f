"""Tables I and II of the SFMS paper, on any data: listeners and heuristics, with the paper's rows.

The paper does not state how its numbers were computed; each choice is stated where it is made. Table 1 has the metrics
of the Learning2Listen line, separately for expression and rotation. Table 2 has the metrics of the REACT challenge,
which scores 25 attributes that no public code derives from coefficients. Here it is computed on the coefficients, with
ReactFace's FRDist. FRRea needs rendered pictures and is out of scope. The paper's rows (`configs/papers.yaml`) come
from other data and spaces, so only the shapes of the tables can be compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch

from sfms_robot import config
from sfms_robot.app.progress import tracked
from sfms_robot.config import find
from sfms_robot.config.base import read
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, SPACE_CHANNELS, Doubles
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Dataset, Order, usable
from sfms_robot.lab.corpora.external.l2l import l2l_mean_std
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.detection import behaviour
from sfms_robot.lab.evaluation.intervals import Chosen, bootstrap, finite, intervals, people_of
from sfms_robot.lab.evaluation.metrics import cut
from sfms_robot.lab.evaluation.rollout import (
    frames_of_dyad,
    load_at_hop,
    offline_rollout,
    rollout,
    rollouts,
    streamable,
)
from sfms_robot.lab.learning.corpus import in_space
from sfms_robot.lab.learning.sfms.features import frames_of, gather
from sfms_robot.lab.learning.sfms.predictor_trainer import keyframe_scores
from sfms_robot.lab.learning.sfms.tokenizer_trainer import reconstruction_error
from sfms_robot.listeners.checkpoint import CONFIG
from sfms_robot.listeners.registry import load_folder
from sfms_robot.listeners.sfms.placement import Strategy
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.ports import Listener

FRAMES: Final = {1: 64, 2: 750}  # frames of a clip by table: Learning2Listen's and REACT's
_LEAST_SPREAD: Final = 1e-6  # smaller spreads would divide by nearly nothing

PRINTED: Final = read(data_dir("configs") / "papers.yaml")
Score = Callable[[Chosen], Figures]  # figures of some of the clips


def paper_rows(table: str) -> dict[str, dict[str, float | None]]:
    """Return the printed rows of a paper's table by name, with their figures by column; None for a missing figure."""
    printed = PRINTED[table]
    return {name: dict(zip(printed["columns"], row, strict=True)) for name, row in printed["rows"].items()}


@dataclass(frozen=True, kw_only=True)
class Clips:
    """Clips of one length in one motion space.

    Attributes:
        truth, speaker: (N, T, D); train: (M, T, D) listeners of the training set.
        people: (N,) the listener of each clip; empty if no intervals are wanted.
    """

    space: str
    truth: Doubles
    speaker: Doubles
    train: Doubles
    people: Sequence[str] = ()


def table(number: int, clips: Clips, answers: Mapping[str, Doubles], samples: int, seed: int = 0) -> Figures:
    """Return table 1 or 2: rows of truth, heuristics, `answers` (N, K, T, D) by name, and the paper's.

    A row has `source` "here" or "paper"; `features` names the feature space of the numbers from here.
    """
    score_of = _table_1(clips) if number == 1 else partial(_table_2, clips)
    guesses = {"Ground truth": clips.truth[:, None], **heuristics(clips, samples, seed)}
    if number == 2:
        guesses["Last frame held"] = held(clips.truth)[:, None]
    rows = []
    for name, motion in {**guesses, **answers}.items():
        score = score_of(motion)
        over = intervals(bootstrap(score, clips.people)) if name in answers else {}
        rows.append({"name": name, "source": "here", **score(np.arange(len(clips.truth))), "interval": over})
    rows += [{"name": name, "source": "paper", **row} for name, row in paper_rows(f"sfms-{number}").items()]
    return {
        "table": number,
        "space": clips.space,
        "features": _features(number, clips.space),
        "clips": len(clips.truth),
        "frames": clips.truth.shape[1],
        "samples": samples,
        "rows": [finite(row) for row in rows],
    }


def _features(number: int, space: str) -> str:
    if number == 1 and space == "deca56":
        return "L2L-standardised: less the mean, over the deviation between clips of their deviations"
    if number == 1:
        return f"{space}, less the mean of training"
    return f"{space}, raw coefficients; appropriate is the own listener alone"


def heuristics(clips: Clips, samples: int, seed: int) -> dict[str, Doubles]:
    """Return the answers (N, K, T, D) of listeners without training; all but Random return K equal answers.

    Random, Mime and MeanFr as in `run_baselines` of the REACT challenge (baseline_react2023 @ c5a8ff85), Median as
    Learning2Listen names it. Random draws every number uniformly from its channel's range (0..1 for blendshapes, else
    that of training): FRVar is 1/12, FRDiv and FRDvs 1/6 in units of it.
    """
    shapes = np.array([channel in BLENDSHAPES for channel in SPACE_CHANNELS[clips.space]])
    low = np.where(shapes, 0.0, clips.train.min(axis=(0, 1)))
    high = np.where(shapes, 1.0, clips.train.max(axis=(0, 1)))
    n, t, d = clips.speaker.shape
    still = {
        "Median": np.median(clips.train, axis=(0, 1)),
        "Mime": clips.speaker,
        "MeanFr": clips.train.mean(axis=(0, 1)),
    }
    answers = {"Random": np.random.default_rng(seed).uniform(low, high, (n, samples, t, d))}
    for name, motion in still.items():
        answers[name] = np.repeat(np.broadcast_to(motion, (n, t, d))[:, None], samples, axis=1)
    return answers


def held(truth: Doubles, frames: int = 8) -> Doubles:
    """Return clips (N, T, D) in which the last true frame before each plan of `frames` frames is repeated.

    Such an answer contains only the true past: a value that it reaches in a figure does not require any listener.
    """
    at = np.arange(truth.shape[1])
    return truth[:, np.maximum(at // frames * frames - 1, 0)]


def _table_1(clips: Clips) -> Callable[[Doubles], Score]:
    """Return the score of table 1: means over the samples. FD, P-FD and SI pool all clips; Var and RPCC are DIM's."""
    scaled = _scale(clips)
    truth, speaker = scaled(clips.truth), scaled(clips.speaker)
    centres = metrics.centres_of(truth, metrics.PARTS[clips.space], metrics.CLUSTERS)

    def score(pred: Doubles, chosen: Chosen) -> Figures:
        row: Figures = {}
        for part, where in metrics.PARTS[clips.space].items():
            own, person = truth[chosen][..., where], speaker[chosen][..., where]
            samples = [
                {
                    "L2": metrics.l2(own, guess),
                    "FD": metrics.frechet_distance(own, guess),
                    "Var": metrics.variance(guess),
                    "SI": metrics.shannon_index(guess, centres[part]),
                    "P-FD": metrics.paired_frechet_distance(own, guess, person),
                    "RPCC": metrics.rpcc_flat(own, guess, person) if np.ptp(guess) else np.nan,
                }
                for guess in (scaled(pred[chosen, k])[..., where] for k in range(pred.shape[1]))
            ]
            row |= {f"{part} {name}": float(np.mean([one[name] for one in samples])) for name in samples[0]}
        return row

    return lambda pred: partial(score, pred)


def _scale(clips: Clips) -> Callable[[Doubles], Doubles]:
    """Return a function that scales L2L's coefficients to the units of its numbers, else subtracts the training mean.

    Var and RPCC treat all channels as one signal: if a head rests at pi about x, this offset would determine them.
    """
    if clips.space != "deca56":
        rest = clips.train.mean(axis=(0, 1))
        return lambda motion: motion - rest
    mean, spread = l2l_mean_std(clips.train)
    if (spread < _LEAST_SPREAD).all():
        raise ConfigError(f"L2L's units need training clips that differ, there is {len(clips.train)}")
    spread = np.where(spread < _LEAST_SPREAD, np.inf, spread)
    return lambda motion: (motion - mean) / spread


def _table_2(clips: Clips, pred: Doubles) -> Score:
    """Return the score of table 2. FRCorr is the challenge's sum over the samples; FRSyn skips constant channels.

    All but FRDvs are means over the clips: the numbers of each clip are computed once for any choice of clips.
    """
    by_clip = np.array(
        [
            (metrics.frc(made, true), metrics.reactface_frd(made, true), metrics.frdiv(made), metrics.frvar(made))
            for made, true in zip(pred[:, None], clips.truth[:, None], strict=True)
        ]
    )
    lags = metrics.synchrony_lags(pred, clips.speaker, as_challenge=False)

    def score(chosen: Chosen) -> Figures:
        correlation, distance, diverse, varied = by_clip[chosen].mean(axis=0).tolist()
        return {
            "FRCorr": correlation * pred.shape[1],
            "FRDist": distance,
            "FRDiv": diverse,
            "FRVar": varied,
            "FRDvs": metrics.frdvs(pred[chosen]),
            "FRSyn": metrics.mean_known(lags[chosen]),
            "FRCorr per sample": correlation,
        }

    return score


# --- The commands ----------------------------------------------------------------------------------------------------

_PLACEMENTS: tuple[Strategy, ...] = ("exact", "penalised", "static", "static_paper", "learned")


def evaluate_tokenizer(name: str, data: Path, order: Order | None = None, split: str = "test") -> Figures:
    """Return the held-out reconstruction error of a listener's tokenizer, by keyframe placement."""
    folder = find("listeners", name, "config.yaml")
    settings, listener = config.load(config.Sfms, folder / CONFIG), load_folder(folder, "torch")
    model = listener.model
    dyads = open_for(listener.space.name, data, split, order)
    corpus = gather(dyads, model.tokenizer.window, listener.space, None, settings)
    placements = [
        each for each in _PLACEMENTS if (each == "penalised") == (settings.placement == "penalised")
        and (each != "learned" or model.tokenizer.score is not None)
    ]  # fmt: skip
    return {
        "listener": name,
        "split": split,
        "window": model.tokenizer.window,
        "rows": [
            {"name": each, "mse": reconstruction_error(model, corpus, each)}
            for each in tracked(placements, "restoring motion")
        ],
    }


def evaluate_listener(
    names: Sequence[str],
    data: Path,
    seed: int,
    order: Order | None = None,
    hop: int | None = None,
    split: str = "test",
) -> Figures:
    """Stream the held-out speakers of `data` through listeners; return their behaviour and that of the dyads.

    Rows of SFMS listeners also have their keyframe scores. `hop`: see `load_at_hop`.
    """
    dyads = [*streamable(data, split, order)]
    if not dyads:
        raise ConfigError(f"{data}: no dyad of {split} can be read")
    rows: list[Figures] = []
    for name in names:
        listener = load_at_hop(name, hop)
        motions = [motion for motion, _ in rollouts(listener, dyads, seed, name)]
        figures = behaviour(motions, dyads)
        if isinstance(listener, SfmsListener):
            settings = listener.settings
            corpus = gather(dyads, settings.window_frames, listener.space, listener.frontend, settings)
            figures |= keyframe_scores(listener.model, corpus)
        rows.append({"name": name, "hop": listener.hop, **figures})
    rows.append({"name": "dyads", **behaviour([dyad.listener for dyad in dyads], dyads)})
    return {
        "listeners": list(names),
        "split": split,
        "dyads": len(dyads),
        "rows": [finite(row) for row in rows],
    }


def shared_space(listeners: Mapping[str, Listener]) -> MotionSpace:
    """Return the motion space of all listeners; for one that decides events, the space of its motion model.

    Raises ConfigError if there are several.
    """
    spaces = {
        name: getattr(getattr(listener, "how", listener), "space", MotionSpace("arkit58", np.zeros(58)))
        for name, listener in listeners.items()
    }
    if len({space.name for space in spaces.values()}) > 1:
        named = ", ".join(f"{name}: {space.name}" for name, space in spaces.items())
        raise ConfigError(f"one table has one motion space, these have several ({named}): evaluate them one by one")
    return next(iter(spaces.values()))


def spread_clips(dyads: Dataset, most: int | None) -> list[Dyad]:
    """Return at most `most` dyads, spread evenly; those that cannot be read are skipped with a warning.

    Raises ConfigError when none can be read.
    """
    step = 1.0 if most is None else max(1.0, len(dyads) / most)
    chosen = replace(dyads, clips=tuple(dyads.clips[int(at)] for at in np.arange(0, len(dyads), step)))
    found = list(usable(chosen))
    if not found:
        raise ConfigError(f"{dyads.layout} {dyads.split}: none of {len(chosen)} clips can be read")
    return found


def collect(
    number: int,
    listeners: Mapping[str, Listener],
    space: MotionSpace,
    train: Sequence[Dyad],
    held_out: Sequence[Dyad],
    seeds: Sequence[int],
) -> tuple[Clips, dict[str, Doubles]]:
    """Return the clips of a table, and the answers of every listener (N, K, T, D), K seeds.

    A listener gets each dyad from its beginning; clips are cut out of its answer. Raises ConfigError if the dyads are
    too short for the table's metrics.
    """
    learned = [np.asarray(in_space(dyad, dyad.listener, space)) for dyad in train]
    heard = [frames_of(dyad, space) for dyad in held_out]
    longest = max(len(one.motion) for one in heard)
    frames = min(FRAMES[number], longest, max(len(one) for one in learned))
    if frames < metrics.NEEDED_FRAMES[number]:
        raise ConfigError(
            f"table {number} needs clips of {metrics.NEEDED_FRAMES[number]} frames, the longest has {longest}"
        )
    rest = torch.tensor(space.neutral, dtype=torch.float32)
    faces = [np.asarray(torch.where(one.face_known[:, None], one.face, rest)) for one in heard]  # at rest if unknown
    clips = Clips(
        space=space.name,
        truth=cut([np.asarray(one.motion) for one in heard], frames),
        speaker=cut(faces, frames),
        train=cut(learned, frames),
        people=people_of(held_out, [len(one.motion) for one in heard], frames),
    )
    answers = {
        name: cut([_answered(listener, space, dyad, seeds) for dyad in tracked(held_out, name)], frames)
        for name, listener in listeners.items()
    }
    for name, listener in listeners.items() if number == 2 else ():
        if isinstance(listener, SfmsListener) and hasattr(listener.engine, "model"):
            rolled = (offline_rollout(listener, dyad, seeds, true_past=True) for dyad in held_out)
            answers[f"{name}, true past"] = cut([np.asarray(one.motion) for one in rolled], frames)
    return clips, answers


def _answered(listener: Listener, space: MotionSpace, dyad: Dyad, seeds: Sequence[int]) -> Doubles:
    """Return the answers (S, N, D) in the space."""
    if isinstance(listener, SfmsListener):
        return np.asarray(offline_rollout(listener, dyad, seeds).motion)
    if dyad.space != "arkit58":
        raise ConfigError(f"dyad {dyad.name}: space {dyad.space}; listeners of other kinds than sfms need arkit58")
    if dyad.fps != FRAME_HZ:
        raise ConfigError(
            f"dyad {dyad.name}: {dyad.fps:g} frames a second; listeners of other kinds than sfms need {FRAME_HZ}"
        )
    played = rollout(listener, frames_of_dyad(dyad), seeds)
    return np.stack([space.encode(one) for one in played.motion])
