"""`evaluate timing`: listeners hear meetings, and their behaviour is compared with that of the people.

The hazards of a listener, if it has any, are computed for the whole of every meeting, and its motion for some minutes.
Each process takes one person's meeting; randomness depends on the seed and on the person's place in the tables alone,
so the figures do not depend on the number of processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Doubles, Floats
from sfms_robot.lab.corpora.clips import Split
from sfms_robot.lab.corpora.compose.ami import MeetingPerson, read_people, split_series
from sfms_robot.lab.corpora.compose.voices import VoiceClip, find_laughter, find_voices, split_voices
from sfms_robot.lab.evaluation import timing
from sfms_robot.lab.evaluation.detection import Detected, DetectorCalibration, Sightings, added_up, asked_and_seen
from sfms_robot.lab.evaluation.hazard_scores import ReferenceHazard, annotated, decisions, delayed, sensed
from sfms_robot.lab.evaluation.intervals import LEVEL, Estimate, Sums, estimates
from sfms_robot.lab.evaluation.listener_meetings import (
    ListenerMeeting,
    listener_meeting,
    part,
    shifted,
    without_own_voice,
)
from sfms_robot.lab.evaluation.robustness import voice_folders
from sfms_robot.lab.evaluation.rollout import load_at_hop, rollout, run_in_processes, spread
from sfms_robot.lab.evaluation.whole_recordings import hazards_in
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.eventful import EventfulListener
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.listeners.registry import engine_name
from sfms_robot.ports import Listener
from sfms_robot.signals.motion_primitives import Motions, read_motions

_PREFIXES: Final = {"annotated": "annotated_", "decided": "decided_", "people": "people_", "R2": "r2_"}


@dataclass(frozen=True, kw_only=True)
class TimingOptions:
    """Options of the command.

    Attributes:
        listener: Shipped name, folder, or a file of hazards (`train events`), which has no motion.
        split: Of the people; "train" needs `allow_training`, since listeners were trained on these people.
        meetings: Most meetings to play, spread over all; None: all.
        minutes: Of motion, from the middle of each meeting; 0: none, which takes minutes instead of hours.
        seeds: How often a listener is left to itself in each.
        jobs: Processes; None: as many as there are cores.
        hop, engine: See `load_at_hop`.
        own_voice: A listener that is left to itself speaks when the person did; else it never speaks.
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


@dataclass(frozen=True, kw_only=True)
class _MeetingTask:
    """One person's meeting.

    Attributes:
        number: Place in the tables.
        table: (CELLS,) nods per minute by speech phase, and `reference`: of training people; None without any.
    """

    options: TimingOptions
    person: MeetingPerson
    number: int
    table: Doubles | None
    reference: ReferenceHazard | None
    calibration: DetectorCalibration


@dataclass(frozen=True)
class _Played:
    participant: str
    minutes: float
    sums: Sums
    sightings: Mapping[str, Sightings]


def evaluate_timing(options: TimingOptions) -> dict[str, Any]:
    """Return figures with their intervals over people; None where the meetings or the listener have too little data.

    Raises ConfigError or ModelError.
    """
    listener = _listener(options)  # report its errors here, not from a process
    everybody = read_people(tables(options.data))
    chosen = spread(people_of(everybody, options.split, options.allow_training), options.meetings)
    training = split_series(everybody)["train"]
    table = timing.table_rates(training) if training else None
    reference = ReferenceHazard.of(training) if training else None
    calibration = DetectorCalibration.of(_motions(options.split))
    tasks = [
        _MeetingTask(
            options=options,
            person=person,
            number=everybody.index(person),
            table=table,
            reference=reference,
            calibration=calibration,
        )
        for person in chosen
    ]
    played = run_in_processes(_play, tasks, options.jobs, "people listening")
    people = timing.per_person((one.participant, one.sums) for one in played)
    found = estimates(timing.figures_of(people[0]), people, options.seed)
    return {
        "listener": options.listener,
        "split": options.split,
        "people": len(people),
        "meetings": len(played),
        "minutes": round(sum(one.minutes for one in played), 2),
        "minutes_of_motion_each": options.minutes,
        "own_voice": options.own_voice,
        "seeds": options.seeds,
        "hop": None if isinstance(listener, EventModel) else listener.hop,
        "engine": None if isinstance(listener, EventModel) else engine_name(listener),
        **{name: _rounded(one.value) for name, one in found.items()},
        "people_smiles_per_minute": None,
        "people_blinks_per_minute": None,
        "interval": {name: one.interval and [_rounded(end) for end in one.interval] for name, one in found.items()},
        "interval_level": LEVEL,
        "detector": calibration.report(),
        "asked_and_seen": calibration.report_of(added_up(one.sightings for one in played)),
        "notes": list(_notes(found, options.own_voice)),
        "rows": _rows(options.listener, found),
    }


def people_of(everybody: Sequence[MeetingPerson], split: Split, allow_training: bool) -> list[MeetingPerson]:
    """Return the people of a split. Raises ConfigError if listeners were trained on them, or there are none."""
    if split == "train" and not allow_training:
        raise ConfigError(
            "--split train: listeners were trained on these people; --split validation and test are others, "
            "--allow-training plays them anyway"
        )
    parts = split_series(everybody)
    if not parts[split]:
        there = ", ".join(f"{name} {len(people)}" for name, people in parts.items() if people)
        raise ConfigError(f"--split {split}: the tables have no people of this split ({there})")
    return parts[split]


def tables(data: Path) -> Path:
    """Return the folder of AMI tables: `data`, or its ami_listener_annotations."""
    if not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    inside = data / "ami_listener_annotations"
    return inside if inside.is_dir() else data


# --- playing --------------------------------------------------------------------------------------------------------


def _play(task: _MeetingTask) -> _Played:
    """Play one meeting: the person's events, the listener's hazards, decisions and motion."""
    options, (voices, laughter, motions) = task.options, _material(task.options.split, task.options.data)
    rng = np.random.default_rng([options.seed, task.number])
    one = listener_meeting(task.person, voices, laughter, motions, rng)
    listener = _listener(options)
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
        detected, known = [Detected.of(motion) for motion in rolled.motion], task.calibration
        sums |= timing.motion_sums(one, rolled.motion, detected, first, known, options.own_voice)
        streams = zip(rolled.events, detected, strict=True)
        sightings = added_up(asked_and_seen(events, each, known.lag_s) for events, each in streams)
    return _Played(one.participant, one.frames / FRAME_HZ / 60, sums, sightings)


def middle(frames: int, minutes: float) -> tuple[int, int]:
    """Return the first frame and the number of frames of the middle `minutes`, or of all frames if they are fewer."""
    wanted = min(frames, round(60 * minutes * FRAME_HZ))
    return (frames - wanted) // 2, wanted


def _by_events(
    model: EventModel,
    calmness: Calmness,
    person: MeetingPerson,
    one: ListenerMeeting,
    seeds: Sequence[int],
    own_voice: bool,
) -> Sums:
    """Return how the hazards, given the person's history, rank the person's events; and the listener's decisions.

    The hazards are also computed from the annotations, without the losses of sensing.
    """

    def hazards(heard: Doubles) -> dict[str, Doubles]:
        return hazards_in(model, heard, one.history, calmness)

    with_voice, heard = sensed(one.speaker, calmness)
    speaking, silent = delayed(hazards(with_voice)), hazards(heard)
    other = hazards(sensed(shifted(one.speaker), calmness)[1])
    sums = timing.hazard_sums("", one, speaking["nod"], silent["nod"], other["nod"])
    sums |= timing.hazard_sums("annotated_", one, *(hazards(each)["nod"] for each in annotated(person, one.frames)))
    for kind in timing.ANNOTATED:
        sums[f"{kind}_hazard_auc"] = timing.ranked(speaking[kind], one, kind)
    streams = decisions(model, with_voice if own_voice else heard, seeds, calmness)
    return sums | timing.decided_sums(one, streams, own_voice)


def _listener(options: TimingOptions) -> Listener | EventModel:
    return _load(options.listener, options.hop, options.engine)


@cache
def _load(name: str, hop: int | None, engine: EngineName) -> Listener | EventModel:
    return EventModel.load(Path(name)) if name.endswith(".yaml") else load_at_hop(name, hop, engine)


@cache
def _material(split: Split, data: Path) -> tuple[Sequence[VoiceClip], Sequence[Floats], Motions]:
    """Return voices, laughter and motions of the split."""
    folders = voice_folders(data)
    return split_voices(find_voices(folders))[split], find_laughter(folders)[split], _motions(split)


def _motions(split: Split) -> Motions:
    return read_motions(data_dir("sim") / "listeners" / "motions.npz")[split]


# --- the report -----------------------------------------------------------------------------------------------------


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _notes(found: Mapping[str, Estimate], own_voice: bool) -> Iterator[str]:
    """Yield what a reader of the figures has to know."""
    yield "people's smiles and blinks were not annotated; laughs are compared with laughs only"
    if own_voice:
        yield "it spoke when the person did, so the contingency of its own nods on the others is unknown"
    if "nod_hazard_auc" not in found:
        yield "this listener has no hazards to evaluate: there is no nod_hazard_auc"
    if "nods_per_minute" not in found:
        yield "no motion was played"
    if "r2_nod_hazard_auc" not in found:
        yield "the tables have no training people to fit the reference on"


def _rows(name: str, found: Mapping[str, Estimate]) -> list[dict[str, Any]]:
    """Return one row per figure: of the motion or the hazards, beside the same figure of the other sources."""

    def bare(key: str) -> str:
        return next((key.removeprefix(prefix) for prefix in _PREFIXES.values() if key.startswith(prefix)), key)

    def cell(key: str) -> str | None:
        one = found.get(key)
        if one is None or one.value is None:
            return None
        ends = "" if one.interval is None else f" [{one.interval[0]:.3g}, {one.interval[1]:.3g}]"
        return f"{one.value:.3g}{ends}"

    return [
        {"figure": key.replace("_", " "), name: cell(key)}
        | {who: cell(prefix + key) for who, prefix in _PREFIXES.items()}
        for key in dict.fromkeys(map(bare, found))
    ]
