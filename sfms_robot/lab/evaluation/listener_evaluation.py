"""`evaluate listener`, and `evaluate tokenizer` without a table: weights and dyads in, figures out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from rich.console import Console
from rich.progress import Progress

from sfms_robot import config
from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Doubles
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Dataset, Order, usable
from sfms_robot.lab.corpora.conversion import at_frame_rate
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.evaluation.behaviour_stats import behaviour
from sfms_robot.lab.evaluation.intervals import people_of
from sfms_robot.lab.evaluation.listener_tables import FRAMES, NEEDED_FRAMES, Clips, table
from sfms_robot.lab.evaluation.metrics import cut
from sfms_robot.lab.evaluation.rollout import (
    frames_of_dyad,
    load_at_hop,
    offline_rollout,
    rollout,
    rollouts,
    whole_clips,
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

_PLACEMENTS: tuple[Strategy, ...] = ("exact", "penalised", "static", "static_paper", "learned")
_TRAIN_DYADS: Final = 200  # from which the heuristics take their means


def evaluate_tokenizer(name: str, data: Path, order: Order | None = None) -> dict[str, Any]:
    """Return the held-out reconstruction error of a listener's tokenizer, by keyframe placement."""
    folder = find("listeners", name, "config.yaml")
    settings, listener = config.load(config.Sfms, folder / CONFIG), load_folder(folder, "torch")
    model = listener.model
    dyads = open_for(listener.space.name, data, "validation", order)
    corpus = gather(dyads, model.tokenizer.window, listener.space, None, settings)
    placements = [
        each for each in _PLACEMENTS if (each == "penalised") == (settings.placement == "penalised")
        and (each != "learned" or model.tokenizer.score is not None)
    ]  # fmt: skip
    return {
        "listener": name,
        "window": model.tokenizer.window,
        "rows": [{"name": each, "mse": reconstruction_error(model, corpus, each)} for each in placements],
    }


def evaluate_listener(
    names: Sequence[str], data: Path, seed: int, order: Order | None = None, hop: int | None = None
) -> dict[str, Any]:
    """Stream the held-out speakers of `data` through listeners; return their behaviour beside that of the dyads.

    For an SFMS listener the rows also have its keyframe scores. `hop`: see `load_at_hop`.
    """
    dyads = [at_frame_rate(dyad) for dyad in usable(open_for("arkit58", data, "validation", order))]
    if not dyads:
        raise ConfigError(f"{data}: no dyad of validation can be read")
    rows: list[dict[str, Any]] = []
    for name in names:
        listener = load_at_hop(name, hop)
        with bar(name, len(dyads)) as advance:
            motions = [one.motion[0] for one in rollouts(listener, dyads, seed, advance)]
        figures = behaviour(motions, dyads)
        if isinstance(listener, SfmsListener):
            settings = listener.settings
            corpus = gather(dyads, settings.window_frames, listener.space, listener.frontend, settings)
            figures |= keyframe_scores(listener.model, corpus, settings)
        rows.append({"name": name, "hop": listener.hop, **figures})
    rows.append({"name": "dyads", **behaviour([dyad.listener for dyad in dyads], dyads)})
    return {
        "listeners": list(names),
        "dyads": len(dyads),
        "rows": [
            {
                key: None if isinstance(value, float) and not math.isfinite(value) else value
                for key, value in row.items()
            }
            for row in rows
        ],
    }


@contextmanager
def bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on stderr; yield the function that advances it."""
    with Progress(console=Console(stderr=True)) as progress:
        yield partial(progress.advance, progress.add_task(title, total=total))


def listener_table(
    number: int,
    listeners: Mapping[str, Listener],
    data: Path,
    *,
    samples: int,
    limit: int | None,
    seed: int,
    order: Order | None = None,
) -> dict[str, Any]:
    """Return table 1 or 2 of the SFMS paper for listeners by name, on the validation split of any known data set.

    At most `limit` dyads, spread evenly. Raises ConfigError when the listeners do not share a motion space.
    """
    space = shared_space(listeners)
    heard = {one.frontend.audio for one in listeners.values() if isinstance(one, SfmsListener)}
    train, held_out = (
        spread_clips(open_for(space.name, data, split, order, heard), most)
        for split, most in (("train", _TRAIN_DYADS), ("validation", limit))
    )
    with bar("listening", len(held_out) * len(listeners)) as advance:
        found, given = collect(number, listeners, space, train, held_out, range(seed, seed + samples), advance)
    return table(number, found, given, samples, seed)


def shared_space(listeners: Mapping[str, Listener]) -> MotionSpace:
    """Return the motion space of all listeners; of one that decides events, that of its model of motion.

    Raises ConfigError when there are several.
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
    each: Callable[[], None] = lambda: None,
) -> tuple[Clips, dict[str, Doubles]]:
    """Return the clips of a table, and the answers of every listener (N, K, T, D), K seeds.

    A listener hears a dyad from its beginning; clips are cut out of its answer. Calls `each()` after every dyad of
    every listener. Raises ConfigError when the dyads are too short for the table's metrics.
    """
    learned = [np.asarray(in_space(dyad, dyad.listener, space)) for dyad in train]
    heard = [frames_of(dyad, space) for dyad in held_out]
    longest = max(len(one.motion) for one in heard)
    frames = min(FRAMES[number], longest, max(len(one) for one in learned))
    if frames < NEEDED_FRAMES[number]:
        raise ConfigError(f"table {number} needs clips of {NEEDED_FRAMES[number]} frames, the longest has {longest}")
    rest = torch.tensor(space.neutral, dtype=torch.float32)
    faces = [np.asarray(torch.where(one.face_known[:, None], one.face, rest)) for one in heard]  # unknown: at rest
    clips = Clips(
        space=space.name,
        truth=cut([np.asarray(one.motion) for one in heard], frames),
        speaker=cut(faces, frames),
        train=cut(learned, frames),
        people=people_of(held_out, [len(one.motion) for one in heard], frames),
    )
    answered = {}
    for name, listener in listeners.items():
        motions = []
        for dyad in held_out:
            motions.append(_answered(listener, space, dyad, seeds, frames))
            each()
        answered[name] = cut(motions, frames)
    return clips, answered


def _answered(listener: Listener, space: MotionSpace, dyad: Dyad, seeds: Sequence[int], frames: int) -> Doubles:
    """Return (S, N, D) in the space; the end that does not fill a clip may be missing."""
    if isinstance(listener, SfmsListener):
        return np.asarray(offline_rollout(listener, dyad, seeds).motion)
    if dyad.space != "arkit58":
        raise ConfigError(f"dyad {dyad.name}: space {dyad.space}; listeners of other kinds than sfms need arkit58")
    if dyad.fps != FRAME_HZ:
        raise ConfigError(
            f"dyad {dyad.name}: {dyad.fps:g} frames a second; listeners of other kinds than sfms need {FRAME_HZ}"
        )
    heard = whole_clips(frames_of_dyad(dyad), frames)
    return np.stack([space.encode(one) for one in rollout(listener, heard, seeds).motion])
