"""`evaluate timing`: meetings are heard by a listener, and what it does is laid beside what the people did.

Of every meeting the whole is asked for hazards, where a listener has any, and some minutes for motion. Processes take
one person's meeting each; what is random about it hangs on the seed and on its place in the tables alone, so that the
figures do not depend on how many processes there are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.config import Calmness, find
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Doubles, Floats
from sfms_robot.lab.corpora.compose.ami import Person, read_people, split_series
from sfms_robot.lab.corpora.compose.voices import Voice, find_laughter, find_voices, split_voices
from sfms_robot.lab.corpora.splits import Split
from sfms_robot.lab.evaluate.hop_choice import load_at_hop
from sfms_robot.lab.evaluate.task_pool import done_in_processes
from sfms_robot.lab.evaluate.unseen_speakers import voice_folders
from sfms_robot.lab.evaluation import timing
from sfms_robot.lab.evaluation.bootstrap import LEVEL, Estimate, Sums, estimates
from sfms_robot.lab.evaluation.deciding import annotated, decisions, delayed, forced_hazards, sensed
from sfms_robot.lab.evaluation.detection import SIZES, Calibration, Sightings, added_up, asked_and_seen, figures
from sfms_robot.lab.evaluation.listener_meetings import (
    ListenerMeeting,
    listener_meeting,
    part,
    shifted,
    without_own_voice,
)
from sfms_robot.lab.evaluation.reference_hazard import ReferenceHazard
from sfms_robot.lab.evaluation.rollout import rollout
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.eventful import EventfulListener
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.listeners.registry import engine_name
from sfms_robot.ports import Listener
from sfms_robot.signals.motion_primitives import Motions, read_motions

_PREFIXES: Final = {"annotated": "annotated_", "decided": "decided_", "people": "people_", "R2": "r2_"}


@dataclass(frozen=True)
class TimingOptions:
    """What to play.

    Attributes:
        listener: shipped name, folder, or a file of hazards (`train events`), which has no motion.
        split: of the people; `allow_training` has to be said for those who were trained on.
        meetings: at most so many, spread over them all; None: all.
        minutes: of motion from the middle of each meeting; 0: none, which takes minutes instead of hours.
        seeds: how often a listener is left to itself in each.
        jobs: processes; None: as many as there are cores.
        hop, engine: see `load_at_hop`.
        own_voice: a listener that is left to itself speaks when the person did; else it never says anything.
    """

    listener: str
    data: Path
    split: Split = "test"
    allow_training: bool = False
    meetings: int | None = None
    minutes: float = 5.0
    seeds: int = 8
    seed: int = 1
    jobs: int | None = None
    hop: int | None = None
    engine: EngineName = "torch"
    own_voice: bool = False


@dataclass(frozen=True)
class _Task:
    """One person's meeting, and what he is judged by.

    Attributes:
        where: folder of the listener, or its file of hazards.
        number: place in the tables.
        table: (CELLS,) nods a minute by speech phase, and `reference`: of training people; None without any.
    """

    options: TimingOptions
    where: Path
    person: Person
    number: int
    table: Doubles | None
    reference: ReferenceHazard | None
    calibration: Calibration


@dataclass(frozen=True)
class _Played:
    participant: str
    minutes: float
    sums: Sums
    sightings: Mapping[str, Sightings]


def evaluate_timing(options: TimingOptions) -> dict[str, Any]:
    """Figures with their intervals over people; None where the meetings, or the listener, hold too little to tell.

    Raises ConfigError or ModelError.
    """
    where = Path(options.listener) if options.listener.endswith(".yaml") else None
    where = where or find("listeners", options.listener, "config.yaml")
    heard_by = _listener(where, options.hop, options.engine)  # what is wrong with it is said here, not by a process
    everybody = read_people(tables(options.data))
    chosen = spread(people_of(everybody, options.split, options.allow_training), options.meetings)
    tasks = list(_tasks(options, where, everybody, chosen))
    played = done_in_processes(_play, tasks, options.jobs, "people listening")
    people = timing.per_person((one.participant, one.sums) for one in played)
    found = estimates(timing.figures_of(people[0]), people, options.seed)
    calibration = _calibration(options.split)
    return {
        "listener": options.listener,
        "split": options.split,
        "people": len(people),
        "meetings": len(played),
        "minutes": round(sum(one.minutes for one in played), 2),
        "minutes_of_motion_each": options.minutes,
        "own_voice": options.own_voice,
        "seeds": options.seeds,
        "hop": None if isinstance(heard_by, EventModel) else heard_by.hop,
        "engine": None if isinstance(heard_by, EventModel) else engine_name(heard_by),
        **{name: _rounded(one.value) for name, one in found.items()},
        "people_smiles_per_minute": None,
        "people_blinks_per_minute": None,
        "interval": {name: one.interval and [_rounded(end) for end in one.interval] for name, one in found.items()},
        "interval_level": LEVEL,
        "detector": calibration.report(),
        "asked_and_seen": _asked(added_up(one.sightings for one in played), calibration),
        "notes": list(_notes(found, options.own_voice)),
        "rows": _rows(options.listener, found),
    }


def people_of(everybody: Sequence[Person], split: Split, allow_training: bool) -> list[Person]:
    """The people of a part of the meetings. Raises ConfigError where they were trained on, or there are none."""
    if split == "train" and not allow_training:
        raise ConfigError(
            "--split train: listeners were trained on these people; --split validation and test are others, "
            "--allow-training plays them all the same"
        )
    parts = split_series(everybody)
    if not parts[split]:
        there = ", ".join(f"{name} {len(people)}" for name, people in parts.items() if people)
        raise ConfigError(f"--split {split}: the tables hold nobody of it ({there})")
    return parts[split]


def spread(people: Sequence[Person], most: int | None) -> list[Person]:
    """At most that many, spread evenly over the meetings."""
    if most is None or most >= len(people):
        return list(people)
    return [people[int(index)] for index in np.linspace(0, len(people) - 1, most).round()]


def tables(data: Path) -> Path:
    """The folder of AMI tables: `data`, or its ami_listener_annotations."""
    if not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    inside = data / "ami_listener_annotations"
    return inside if inside.is_dir() else data


# --- playing ----------------------------------------------------------------------------------------------------


def _tasks(
    options: TimingOptions, where: Path, everybody: Sequence[Person], chosen: Sequence[Person]
) -> Iterator[_Task]:
    training = split_series(everybody)["train"]
    table = timing.table_rates(training) if training else None
    reference = ReferenceHazard.of(training) if training else None
    calibration = _calibration(options.split)
    for person in chosen:
        yield _Task(options, where, person, everybody.index(person), table, reference, calibration)


def _play(task: _Task) -> _Played:
    """One meeting: what he did, what the listener would have done, and what it did."""
    options, (voices, laughter, motions) = task.options, _material(task.options.split, task.options.data)
    rng = np.random.default_rng([options.seed, task.number])
    one = listener_meeting(task.person, voices, laughter, motions, rng)
    listener = _listener(task.where, options.hop, options.engine)
    first, frames = middle(one.frames, 0.0 if isinstance(listener, EventModel) else options.minutes)
    played = np.zeros(one.frames, bool)
    played[first : first + frames] = True
    sums = timing.people_sums(one, played)
    if task.table is not None and task.reference is not None:
        sums |= timing.table_sums(one, task.table)
        sums |= timing.hazard_sums("r2_", one, *task.reference.scores(task.person, one.frames))
    seeds = range(1000 * (options.seed + task.number), 1000 * (options.seed + task.number) + options.seeds)
    if isinstance(listener, EventfulListener):
        sums |= _by_events(listener.when, listener.calmness, task.person, one, seeds, options.own_voice)
    if isinstance(listener, EventModel):
        sums |= _by_events(listener, Calmness(), task.person, one, seeds, options.own_voice)
    sightings: Mapping[str, Sightings] = {}
    if frames and not isinstance(listener, EventModel):
        speaker = part(one.speaker, first, frames)
        rolled = rollout(listener, speaker if options.own_voice else without_own_voice(speaker), seeds)
        sums |= timing.motion_sums(one, rolled.motion, first, task.calibration, options.own_voice)
        streams = zip(rolled.events, rolled.motion, strict=True)
        sightings = added_up(asked_and_seen(events, motion, task.calibration.lag_s) for events, motion in streams)
    return _Played(one.participant, one.frames / FRAME_HZ / 60, sums, sightings)


def middle(frames: int, minutes: float) -> tuple[int, int]:
    """First frame and number of frames of the middle `minutes`, of all if there are fewer."""
    wanted = min(frames, round(60 * minutes * FRAME_HZ))
    return (frames - wanted) // 2, wanted


def _by_events(
    model: EventModel, calmness: Calmness, person: Person, one: ListenerMeeting, seeds: Sequence[int], own_voice: bool
) -> Sums:
    """How its hazards, given his own history, rank what he did, once as annotators saw the others, without what sensing
    loses; and what it decides, left to itself.
    """
    history = one.history
    with_voice, heard = sensed(one.speaker, calmness)
    _, elsewhere = sensed(shifted(one.speaker), calmness)
    speaking = delayed(forced_hazards(model, with_voice, history, calmness))
    silent = forced_hazards(model, heard, history, calmness)
    other = forced_hazards(model, elsewhere, history, calmness)
    sums = timing.hazard_sums("", one, speaking["nod"], silent["nod"], other["nod"])
    seen = [forced_hazards(model, each, history, calmness)["nod"] for each in annotated(person, one.frames)]
    sums |= timing.hazard_sums("annotated_", one, *seen)
    for kind in timing.ANNOTATED:
        sums[f"{kind}_hazard_auc"] = timing.ranked(speaking[kind], one, kind)
    streams = decisions(model, with_voice if own_voice else heard, seeds, calmness)
    return sums | timing.decided_sums(one, streams, own_voice)


@cache
def _listener(where: Path, hop: int | None, engine: EngineName) -> Listener | EventModel:
    return EventModel.load(where) if where.suffix == ".yaml" else load_at_hop(where, hop, engine)


@cache
def _material(split: Split, data: Path) -> tuple[Sequence[Voice], Sequence[Floats], Motions]:
    """Voices, laughter and motions of that part."""
    folders = voice_folders(data)
    return split_voices(find_voices(folders))[split], find_laughter(folders)[split], _motions(split)


def _motions(split: Split) -> Motions:
    return read_motions(data_dir("sim") / "listeners" / "motions.npz")[split]


@cache
def _calibration(split: Split) -> Calibration:
    return Calibration.of(_motions(split))


# --- telling ----------------------------------------------------------------------------------------------------


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _asked(told: Mapping[str, Sightings], calibration: Calibration) -> dict[str, Any]:
    """Events that the listener asked for, in its motion; beside them recorded ones of the same sizes."""
    found = {}
    for kind, one in told.items():
        if not len(one.sizes):
            continue
        known = calibration.known[kind]
        recorded = {
            "recall": known.recall_at(one.sizes, SIZES[kind]),
            "precision": known.precision,
            "offset_s": known.offset_s,
        }
        found[kind] = {
            **figures(one, SIZES[kind]),
            "recorded": {name: _rounded(value) if np.isfinite(value) else None for name, value in recorded.items()},
        }
    return found


def _notes(found: Mapping[str, Estimate], own_voice: bool) -> Iterator[str]:
    """What the figures do not say by themselves."""
    yield "people's smiles and blinks were not annotated; laughs are only laid beside laughs"
    if own_voice:
        yield "it spoke when the person did, so how its own nods hang on the others is not told"
    if "nod_hazard_auc" not in found:
        yield "this listener has no hazards that could be asked: nod_hazard_auc and its kin cannot be told"
    if "nods_per_minute" not in found:
        yield "no motion was played"
    if "r2_nod_hazard_auc" not in found:
        yield "the tables hold nobody to fit the reference on"


def _rows(name: str, found: Mapping[str, Estimate]) -> list[dict[str, Any]]:
    """One row per figure: what is seen in the motion, or asked of the hazards; beside it whatever else has it."""
    keys = dict.fromkeys(_bare(key) for key in found)
    return [
        {
            "figure": key.replace("_", " "),
            name: _cell(found.get(key)),
            **{who: _cell(found.get(prefix + key)) for who, prefix in _PREFIXES.items()},
        }
        for key in keys
    ]


def _bare(key: str) -> str:
    return next((key.removeprefix(prefix) for prefix in _PREFIXES.values() if key.startswith(prefix)), key)


def _cell(one: Estimate | None) -> str | None:
    if one is None or one.value is None:
        return None
    if one.interval is None:
        return f"{one.value:.3g}"
    return f"{one.value:.3g} [{one.interval[0]:.3g}, {one.interval[1]:.3g}]"
