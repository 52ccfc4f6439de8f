"""`evaluate timing`: meetings are played to a listener, and its behaviour is compared with that of the people.

The hazards of a listener, if it has any, are computed for the whole of every meeting, and its motion for some minutes.
Each process plays one person's meeting at a time. Random numbers depend only on the seed and on the person's place in
the tables, so the figures do not depend on the number of processes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Final, Self

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Doubles, Floats, SpeakerFrame, changed
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import Split
from sfms_robot.lab.corpora.compose.ami import MeetingPerson, read_people, split_series
from sfms_robot.lab.corpora.compose.voices import VoiceClip, find_laughter, find_voices, split_voices
from sfms_robot.lab.evaluation import timing
from sfms_robot.lab.evaluation.detection import Detected, DetectorCalibration, Sightings, added_up, asked_and_seen
from sfms_robot.lab.evaluation.intervals import LEVEL, Estimate, Sums, estimates, rounded
from sfms_robot.lab.evaluation.listener_meetings import (
    SHIFT_S,
    listener_meeting,
    part,
    shifted,
)
from sfms_robot.lab.evaluation.robustness import motions_of, voice_folders
from sfms_robot.lab.evaluation.rollout import load_at_hop, rollout, run_in_processes, spread
from sfms_robot.lab.evaluation.whole_recordings import (
    Scene,
    decisions,
    hazards_in,
    heard_in,
    one_voice,
    scene_in,
    unspoken,
)
from sfms_robot.lab.learning.events.event_trainer import (
    STUDY,
    Logistic,
    inputs,
    meeting_scene,
    muted,
    student,
    teach,
)
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.eventful import EventfulListener
from sfms_robot.listeners.events.evidence import HEARD
from sfms_robot.listeners.events.model import (
    STEP_FRAMES,
    STEP_S,
    EventModel,
)
from sfms_robot.listeners.registry import engine_name
from sfms_robot.ports import Listener
from sfms_robot.signals import phase
from sfms_robot.signals.motion_primitives import Motions

_PREFIXES: Final = {who: f"{who.lower()}_" for who in ("annotated", "one_voice", "decided", "people", "R2")}


@dataclass(frozen=True, kw_only=True)
class TimingOptions:
    """Options of the command.

    Attributes:
        listener: Shipped name, folder, or a file of hazards (`train events`), which has no motion.
        split: Split of the people; "train" needs `allow_training`, since listeners were trained on these people.
        meetings: Largest number of meetings to play, spread over all; None: all.
        minutes: Length of motion, from the middle of each meeting; 0: none, which takes minutes instead of hours.
        seeds: Number of free runs of the listener in each meeting.
        jobs: Processes; None: as many as there are cores.
        hop, engine: See `load_at_hop`.
        own_voice: In free runs the listener speaks when the person did; else it never speaks.
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
class _Played:
    participant: str
    minutes: float
    sums: Sums
    sightings: Mapping[str, Sightings]


def evaluate_timing(options: TimingOptions) -> Figures:
    """Return figures with their intervals over people; None where the meetings or the listener have too little data.

    Raises ConfigError or ModelError.
    """
    listener = _listener(options)  # raises its errors here, not in a process
    people = read_people(tables(options.data))
    chosen = spread(people_of(people, options.split, options.allow_training), options.meetings)
    training = split_series(people)["train"]
    baselines = (timing.table_rates(training), ReferenceHazard.of(training)) if training else None
    calibration = DetectorCalibration.of(motions_of(options.split))
    tasks = [(people.index(person), person) for person in chosen]
    played = run_in_processes(partial(_play, options, baselines, calibration), tasks, options.jobs, "people listening")
    sums = timing.per_person((one.participant, one.sums) for one in played)
    found = estimates(timing.figures_of(sums[0]), sums, options.seed)
    lacking = {
        "nod_hazard_auc": "this listener has no hazards to evaluate: there is no nod_hazard_auc",
        "nods_per_minute": "no motion was played",
        "r2_nod_hazard_auc": "the tables have no training people to fit the reference on",
    }
    notes = ["people's smiles and blinks were not annotated; laughs are compared with laughs only"]
    if options.own_voice:
        notes.append("it spoke when the person did, so the contingency of its own nods on the others is unknown")
    notes += [told for name, told in lacking.items() if name not in found]
    return {
        "listener": options.listener,
        "split": options.split,
        "people": len(sums),
        "meetings": len(played),
        "minutes": round(sum(one.minutes for one in played), 2),
        "minutes_of_motion_each": options.minutes,
        "own_voice": options.own_voice,
        "seeds": options.seeds,
        "hop": None if isinstance(listener, EventModel) else listener.hop,
        "engine": None if isinstance(listener, EventModel) else engine_name(listener),
        **{name: rounded(one.value) for name, one in found.items()},
        "people_smiles_per_minute": None,
        "people_blinks_per_minute": None,
        "interval": {name: one.interval and [round(end, 4) for end in one.interval] for name, one in found.items()},
        "interval_level": LEVEL,
        "detector": calibration.report(),
        "asked_and_seen": calibration.report_of(added_up(one.sightings for one in played)),
        "notes": notes,
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


def _play(
    options: TimingOptions,
    baselines: tuple[Doubles, ReferenceHazard] | None,
    calibration: DetectorCalibration,
    task: tuple[int, MeetingPerson],
) -> _Played:
    """Play one meeting: the person's events, the listener's hazards, decisions and motion.

    `baselines` are of training people: nods per minute (CELLS,) by speech phase, and the reference. `task`: The place
    in the tables, and the person.
    """
    number, person = task
    voices, laughter, motions = _material(options.split, options.data)
    one = listener_meeting(person, voices, laughter, motions, np.random.default_rng([options.seed, number]))
    listener = _listener(options)
    first, frames = middle(one.frames, 0.0 if isinstance(listener, EventModel) else options.minutes)
    played = np.zeros(one.frames, bool)
    played[first : first + frames] = True
    sums = timing.people_sums(one, played)
    if baselines is not None:
        rates, reference = baselines
        sums["table_nod_auc"] = timing.ranked(rates[timing.cells(phase.times(one.others))], one)
        sums |= timing.hazard_sums("r2_", one, *reference.scores(person, one.frames))
    seeds = range(1000 * (options.seed + number), 1000 * (options.seed + number) + options.seeds)
    model: object = listener
    calmness = Calmness()
    if isinstance(listener, EventfulListener):
        model, calmness = listener.when, listener.calmness
    if isinstance(model, EventModel):
        # The hazards, given the person's history, rank the person's events. They are also computed from the
        # annotations, without the losses of sensing, and from annotations in which all others are one person, as for a
        # single microphone.
        hazards = partial(hazards_in, model, own=one.history, calmness=calmness)
        with_voice, heard = sensed(one.speaker, calmness)
        speaking, silent = delayed(hazards(with_voice)), hazards(heard)
        other = hazards(sensed(shifted(one.speaker), calmness)[1])
        sums |= timing.hazard_sums("", one, speaking["nod"], silent["nod"], other["nod"])
        scene, _ = meeting_scene(person)
        for who, seen in (("annotated_", scene), ("one_voice_", one_voice(scene))):
            sums |= timing.hazard_sums(who, one, *(hazards(each)["nod"] for each in annotated(seen, one.frames)))
        for kind in timing.ANNOTATED:
            sums[f"{kind}_hazard_auc"] = timing.ranked(speaking[kind], one, kind)
        streams = decisions(model, with_voice if options.own_voice else heard, seeds, calmness)
        sums |= timing.decided_sums(one, streams, options.own_voice)
    sums |= timing.differences(sums)
    sightings: Mapping[str, Sightings] = {}
    if frames and not isinstance(listener, EventModel):
        speaker = part(one.speaker, first, frames)
        if not options.own_voice:
            speaker = [changed(frame, agent_audio=None) for frame in speaker]
        rolled = rollout(listener, speaker, seeds)
        detected = [Detected.of(motion) for motion in rolled.motion]
        sums |= timing.motion_sums(one, rolled.motion, detected, first, calibration, options.own_voice)
        both = zip(rolled.events, detected, strict=True)
        sightings = added_up(asked_and_seen(events, each, calibration.lag_s) for events, each in both)
    return _Played(one.participant, one.frames / FRAME_HZ / 60, sums, sightings)


def middle(frames: int, minutes: float) -> tuple[int, int]:
    """Return the first frame and the number of frames of the middle `minutes`, or of all frames if they are fewer."""
    wanted = min(frames, round(60 * minutes * FRAME_HZ))
    return (frames - wanted) // 2, wanted


@cache
def _listener(options: TimingOptions) -> Listener | EventModel:
    name = options.listener
    return EventModel.load(Path(name)) if name.endswith(".yaml") else load_at_hop(name, options.hop, options.engine)


@cache
def _material(split: Split, data: Path) -> tuple[Sequence[VoiceClip], Sequence[Floats], Motions]:
    """Return voices, laughter and motions of the split."""
    folders = voice_folders(data)
    return split_voices(find_voices(folders))[split], find_laughter(folders)[split], motions_of(split)


# --- the report -----------------------------------------------------------------------------------------------------


def _rows(name: str, found: Mapping[str, Estimate]) -> list[Figures]:
    """Return one row per figure: that of the motion or the hazards, and the same figure of the other sources."""

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


# --- Decisions without motion ----------------------------------------------------------------------------------------
#
# A listener is evaluated in two ways. In a free run it decides, and its history consists of its own decisions. Given a
# person's history it decides nothing: only its hazards are computed, at every instant, as if the person's events so far
# were its own. These are ranked against the person's next events, because nods drawn from good hazards with a few seeds
# rank hardly better than chance.
#
# `ReferenceHazard` is the reference: the information about nods in the annotations themselves. It is a logistic hazard
# of speech and its length, of looks, laughs and nods, and of the person's earlier nods, fitted on training people and
# evaluated at every instant of another person's meeting. Its input is exactly what the annotators saw, while a head has
# a microphone and a camera. It is fitted and evaluated once with the person's own speech, and once without.

_SILENT: Final = {name: knots for name, knots in STUDY.items() if name not in ("floor_mine", "own_voice_s")}


def sensed(speaker: Sequence[SpeakerFrame], calmness: Calmness) -> tuple[Doubles, Doubles]:
    """Return the evidence (N, len(HEARD)) of the person in the frames: with the listener's own voice, and without."""
    scene = scene_in(speaker, calmness.addressed)
    return heard_in(scene), heard_in(unspoken(scene))


def annotated(scene: Scene, frames: int) -> tuple[Doubles, Doubles, Doubles]:
    """Return the evidence (frames, len(HEARD)) from annotations in place of a microphone and a camera.

    There are three: with the listener's own voice, without it, and without it and with the others a minute off.
    """
    own, alone = heard_in(scene), heard_in(unspoken(scene))
    at = np.minimum(np.arange(frames), len(own) - 1)
    return own[at], alone[at], np.roll(alone, round(SHIFT_S * FRAME_HZ), axis=0)[at]


def delayed(hazards_hz: dict[str, Doubles]) -> dict[str, Doubles]:
    """Return hazards one frame late: a head gets its own voice a frame early, which would reveal its "mm-hm"."""
    return {kind: np.concatenate([values[:1], values[:-1]]) for kind, values in hazards_hz.items()}


@dataclass(frozen=True)
class ReferenceHazard:
    """Log-odds of a nod, from two fits: with the person's own speech, and without."""

    speaking: Logistic
    silent: Logistic

    @classmethod
    def of(cls, people: Sequence[MeetingPerson]) -> Self:
        """Fit on these people; takes some seconds for a hundred meetings."""
        taught = [student(person, np.random.default_rng(0)) for person in people]
        return cls(teach(taught, "nod", STUDY), teach(map(muted, taught), "nod", _SILENT))

    def scores(self, person: MeetingPerson, frames: int) -> tuple[Doubles, Doubles, Doubles]:
        """Return (frames,) each: with the own speech, without it, and without it and with the others a minute off."""
        one = student(person, np.random.default_rng(0))
        heard, alone = one.evidence, muted(one).evidence
        other = alone.copy()
        other[:, : len(HEARD)] = np.roll(alone[:, : len(HEARD)], round(SHIFT_S / STEP_S), axis=0)
        by_step = (
            self.speaking.log_odds(inputs(heard, STUDY)),
            self.silent.log_odds(inputs(alone, _SILENT)),
            self.silent.log_odds(inputs(other, _SILENT)),
        )
        # (M,) known at the beginning of each step -> (frames,) known at the end of each frame
        at = ((np.arange(frames) + 1) // STEP_FRAMES).clip(0, len(heard) - 1)
        speaking, silent, shifted = (np.asarray(steps[at]) for steps in by_step)
        return speaking, silent, shifted
