"""Behind `evaluate interaction` and the ARIG tables of `evaluate listener`: listeners played, and what they did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.progress import Progress

from sfms_robot import config
from sfms_robot.config import find, parse_training
from sfms_robot.config.listener import STATES
from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.conversational_states import UNKNOWN
from sfms_robot.lab.evaluate.as_written import as_written, training_file
from sfms_robot.lab.evaluation import interaction as scores
from sfms_robot.lab.evaluation.paper import arig_tables as tables
from sfms_robot.lab.evaluation.paper.listener_clips import spread
from sfms_robot.lab.evaluation.paper.listener_tables import cut
from sfms_robot.lab.evaluation.paper.over_people import people_of
from sfms_robot.lab.evaluation.rollout import Rollout, rollouts
from sfms_robot.lab.learning.arig.features import open_scenes
from sfms_robot.lab.learning.arig.trainer import train_arig
from sfms_robot.lab.learning.resume import checkpoint_file
from sfms_robot.lab.learning.train_runs import TrainOptions, run_of, train_settings
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.registry import load_listener
from sfms_robot.ports import Listener

TABLES: Final = ("arig-1", "arig-2", "arig-4")


@dataclass(frozen=True)
class AblationOptions:
    """Where listeners of the tables alone are, and how those that are missing are trained.

    `training`: None is the paper as written. `steps`: not the file's. `train`: whether any is; False: rows of those
    that are not there are left out.
    """

    models: Path | None = None
    training: Path | None = None
    steps: int | None = None
    train: bool = True


def evaluate_interaction(name: str, data: Path, clips: int | None, seed: int) -> dict[str, Any]:
    """States, lips, chunk borders and the end of speech on the validation sets of `data`, at most `clips` of each.

    Raises ConfigError for a listener that knows no states, or data without a set that speaks.
    """
    listener = load_listener(find("listeners", name, "config.yaml"))
    settings = getattr(getattr(listener, "how", listener), "settings", None)
    if not isinstance(settings, config.Arig):
        raise ConfigError(f"--listener {name}: does not speak; this looks at listeners of kind arig")
    held_out = {scene: spread(dyads, clips) for scene, dyads in open_scenes(data, "validation").items()}
    played = _played(name, listener, held_out, seed)
    every = [one for scene in held_out for one in played[scene]]
    dyads = [dyad for each in held_out.values() for dyad in each]
    motions = [one.motion[0] for one in every]
    return {
        "listener": name,
        "dyads": {scene: len(each) for scene, each in held_out.items()},
        "chunk_border_acceleration_ratio": scores.border_ratio(motions, settings.chunk_frames),
        "dyads_border_acceleration_ratio": scores.border_ratio([one.listener for one in dyads], settings.chunk_frames),
        **_states(every, dyads, data, clips),
        **_lips(played, held_out),
        "jaw_left_a_second_after_speech": scores.listening_again(motions, dyads),
        "people_jaw_left_a_second_after_speech": scores.listening_again([dyad.listener for dyad in dyads], dyads),
    }


def _states(played: Sequence[Rollout], dyads: Sequence[Dyad], data: Path, clips: int | None) -> dict[str, Any]:
    """The listener's answers, and beside them what training labels, where there are any, make of voices alone."""
    pairs = zip(played, dyads, strict=True)
    labelled = [(one.states[0], dyad, dyad.states) for one, dyad in pairs if dyad.states is not None]
    if not labelled or (np.concatenate([said for said, _, _ in labelled]) < 0).all():
        return {}
    said = np.concatenate([said for said, _, _ in labelled])
    truth = np.concatenate([states for _, _, states in labelled])
    truth = np.where(said < 0, UNKNOWN, truth).astype(np.int8)  # the first frame of a stream is given
    voices = np.concatenate([scores.voice_tracks(dyad) for _, dyad, _ in labelled])
    tables_of = {"state": scores.confusion(said, truth)}
    tables_of |= {name: scores.confusion(answers, truth) for name, answers in _by_rule(voices, data, clips).items()}
    found: dict[str, Any] = {}
    for name, table in tables_of.items():
        found[f"{name}_accuracy"] = scores.accuracy(table)
        found[f"{name}_balanced_accuracy"] = scores.balanced_accuracy(table)
    return {**found, "confusion": {"states": list(STATES), "label_by_answer": tables_of["state"].tolist()}}


def _by_rule(voices: scores.Bools, data: Path, clips: int | None) -> dict[str, scores.States]:
    """The most frequent state and the best rule on voice activity, both of the training set, for voices (N, 2)."""
    learned = [d for each in open_scenes(data, "train").values() for d in spread(each, clips) if d.states is not None]
    states = np.concatenate([np.zeros(0, np.int8), *(dyad.states for dyad in learned if dyad.states is not None)])
    if not (states >= 0).any():
        return {}
    majority = np.full(len(voices), np.bincount(states[states >= 0]).argmax(), np.int8)
    rule = scores.VoiceRule.of(np.concatenate([scores.voice_tracks(dyad) for dyad in learned]), states)
    return {"majority": majority, "voice_rule": rule(voices)}


def _lips(played: Mapping[str, Sequence[Rollout]], held_out: Mapping[str, Sequence[Dyad]]) -> dict[str, Any]:
    """On filmed recordings, and on the agent's talk in interaction."""
    found: dict[str, Any] = {}
    for scene in ("speaking", "interaction"):
        if scene in held_out:
            one = scores.jaw_tracking(
                [each.motion[0] for each in played[scene]], [dyad.listener for dyad in held_out[scene]]
            )
            found |= {
                f"lips_{scene}_correlation": one.correlation,
                f"lips_{scene}_lag_frames": one.lag_frames,
                f"lips_{scene}_correlation_at_lag": one.best,
                f"lips_{scene}_jaw_spread": one.spread,
            }
    return found


def arig_table(
    name: str, names: Sequence[str], data: Path, clips: int | None, seed: int, ablations: AblationOptions
) -> dict[str, Any]:
    """`arig-2`: `names` side by side on the listening set. `arig-1`, `arig-4`: ablations on the interaction set, too.

    With a folder for models the paper as written is in each of them. Raises ConfigError.
    """
    if name not in TABLES:
        raise ConfigError(f"--table {name}: is not one of {', '.join(TABLES)}")
    scenes = open_scenes(data, "validation")
    number = int(name.removeprefix("arig-"))
    scene = "listening" if number == 2 else "interaction"
    if scene not in scenes:
        raise ConfigError(f"{data / scene}: no validation dyads there, which --table {name} is about")
    held_out = [dyad for dyad in spread(scenes[scene], clips) if len(dyad.listener) >= tables.CLIP_FRAMES]
    if not held_out:
        raise ConfigError(f"{data}: no validation dyad is as long as a clip of {tables.CLIP_FRAMES} frames")
    folders = {one: find("listeners", one, "config.yaml") for one in names}
    if number != 2 and ablations.train:
        folders = _ablated(number, data, ablations) | folders
    elif ablations.models is not None:
        folders |= as_written("arig", data, ablations.models, ablations.steps)
    truth = cut([dyad.listener for dyad in held_out], tables.CLIP_FRAMES)
    speaker = cut([dyad.speaker for dyad in held_out], tables.CLIP_FRAMES)
    answers = {}
    for label, folder in folders.items():
        played = _played(label, load_listener(folder), {scene: held_out}, seed, tables.CLIP_FRAMES)[scene]
        answers[label] = cut([one.motion[0] for one in played], tables.CLIP_FRAMES)
    people = people_of(held_out, [len(dyad.listener) for dyad in held_out], tables.CLIP_FRAMES)
    rows = (
        tables.table_2(truth, speaker, answers, people)
        if number == 2
        else tables.ablation_table(number, truth, speaker, answers, people)
    )
    return {"table": name, "clips": len(truth), "frames": tables.CLIP_FRAMES, "rows": rows}


def _ablated(number: int, data: Path, options: AblationOptions) -> dict[str, Path]:
    """Folders of the full model and the table's ablations, trained alike where they are missing."""
    if options.models is None:
        raise ConfigError(f"--table arig-{number}: needs --models DIR, where its listeners are trained and kept")
    file = options.training or training_file("arig")
    base = train_settings(TrainOptions(file, data, options.models, steps=options.steps))
    if not isinstance(base, config.ArigTraining):
        raise ConfigError(f"{file}: listener.kind is not arig")
    folders = {}
    variants: dict[str, Mapping[str, Any]] = {"ARIG": {}, **tables.ABLATIONS[number]}
    for label, changes in variants.items():
        unchanged = "arig-as-written" if options.training is None else "arig"
        out = options.models / (label.replace("/", "").replace(" ", "-").lower() if changes else unchanged)
        folders[label] = out
        if (out / checkpoint.WEIGHTS).is_file():
            continue
        raw = base.model_dump(mode="json")
        raw["listener"] |= changes
        begun = checkpoint_file(out, "arig").is_file()
        _train(parse_training(raw, file), TrainOptions(file, data, out, resume=begun, tensorboard=False))
    return folders


def _train(settings: config.Training | config.ArigTraining, options: TrainOptions) -> None:
    if not isinstance(settings, config.ArigTraining):
        raise ValueError("ablations are of kind arig")
    with run_of(options) as run:
        train_arig(settings, options.data, options.out, run)


def _played(
    name: str, listener: Listener, held_out: Mapping[str, Sequence[Dyad]], seed: int, clip_frames: int = 1
) -> dict[str, list[Rollout]]:
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task(name, total=sum(len(each) for each in held_out.values()))
        advance = partial(progress.advance, task)
        return {scene: rollouts(listener, dyads, seed, advance, clip_frames) for scene, dyads in held_out.items()}
