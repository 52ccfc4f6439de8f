"""When a listener nods, against when people did: meetings are played to it, its nods laid beside the annotated ones.

Of a meeting participant everything but himself is kept: what the others said, and when, becomes a voice and a face as
in composed dyads. The listener hears it several times, once for each seed. Everything is counted the same way for both:
nod onsets per minute of time of a kind (`kinds_of_time`), and how well a score ranks the instants of his nods above
the listening instants without one (`NodRanks`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.corpora.compose.ami import Person
from sfms_robot.corpora.compose.composed import Stretch, active, cast, speaker_of
from sfms_robot.corpora.compose.motions import Motions
from sfms_robot.corpora.compose.voices import Voice
from sfms_robot.corpora.splits import series
from sfms_robot.evaluation.nod_table import Counts, Ints, NodTable, cells
from sfms_robot.evaluation.rollout import speaker_frames
from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, Doubles, Floats, SpeakerFrame
from sfms_robot.signals import events, phase
from sfms_robot.signals.events import Bools
from sfms_robot.signals.gaze_kinematics import EYE_PAN_RAD, EYE_TILT_RAD

WITHIN_S: Final = 0.5  # a generated nod this close counts for an instant
LEAST_NODS: Final = 3  # of a person, to be ranked
_NOD_S: Final = 0.8  # length of the nods that the sampled table makes

Rates = dict[str, tuple[float, float]]  # kind of time -> onsets, minutes


@dataclass(frozen=True)
class Scene:
    """A stretch of a meeting around one listener: N frames of what he hears and sees, and what he did.

    Attributes:
        nods_s: (K, 2) his nods, seconds of the stretch.
        others, own, unseen: (N,) others speak, he speaks, his head is off camera.
        laughs, gaze_shifts: how often; gaze_shifts None where nobody annotated his gaze.
    """

    name: str
    series: str
    speaker: tuple[SpeakerFrame, ...]
    nods_s: Doubles
    others: Bools
    own: Bools
    unseen: Bools
    laughs: int
    gaze_shifts: int | None

    @property
    def minutes(self) -> float:
        return len(self.others) / FRAME_HZ / 60

    @property
    def listening(self) -> Bools:
        """(N,) others spoke in the last 2 s, he is silent and in view."""
        return events.listening_mask(self.others, FRAME_HZ, self.own) & ~self.unseen

    @property
    def cell(self) -> Ints:
        """(N,) cell of the nod table, counted from the beginning of the stretch."""
        return cells(phase.times(self.others.tolist()))

    @property
    def onsets(self) -> Ints:
        """(K,) frames at which he begins to nod."""
        return np.round(self.nods_s[:, 0] * FRAME_HZ).astype(np.int64).clip(0, len(self.others) - 1)


def choose_people(people: Sequence[Person], most: int | None) -> list[Person]:
    """At most that many people, spread evenly over the meetings."""
    if most is None or most >= len(people):
        return list(people)
    return [people[int(index)] for index in np.linspace(0, len(people) - 1, most).round()]


def scene(
    person: Person, minutes: float | None, voices: Sequence[Voice], motions: Motions, rng: np.random.Generator
) -> Scene:
    """The middle `minutes` of the time in which his head was annotated (all of it if None), voiced."""
    length = person.until_s if minutes is None else min(person.until_s, 60 * minutes)
    begin = round((person.until_s - length) / 2 * FRAME_HZ) / FRAME_HZ
    stretch = Stretch(person, begin, begin + length)
    audio, face = speaker_of(stretch, cast(voices, rng), motions, rng)
    shifts = None
    if person.gaze is not None:
        shifts = sum(begin <= start < begin + length for start, _, _ in person.gaze)
    return Scene(
        f"{person.meeting}_{person.agent}",
        series(person.meeting),
        tuple(speaker_frames(audio, face)),
        _starting_in(person.nods, stretch),
        active(person.others, stretch),
        active(person.talk, stretch),
        active(person.unseen, stretch),
        len(_starting_in(person.laughs, stretch)),
        shifts,
    )


def _starting_in(spans: Doubles, stretch: Stretch) -> Doubles:
    return spans[(spans[:, 0] >= stretch.start_s) & (spans[:, 0] < stretch.end_s)] - stretch.start_s


# --- rates ------------------------------------------------------------------------------------------------------


def kinds_of_time(one: Scene) -> dict[str, Bools]:
    """Masks (N,) of the times that nods are counted in; all within listening but the last.

    `after_phrase` and `later` are the two windows of the phrase-end ratio; the others are where people nod most and
    least: right after a phrase of over 3 s, in the first second of one, eight seconds into one, and in long silence.
    """
    frames, listening = len(one.others), one.listening
    spoken = events.runs(one.others)
    ends = events.phrase_ends(one.others, FRAME_HZ)
    long_ends = [end / FRAME_HZ for start, end in spoken if end - start > 3 * FRAME_HZ and end < frames]
    speech_s, silence_s, _ = phase.times(one.others.tolist()).T
    return {
        "listening": listening,
        "after_phrase": events.window_after(ends, events.AFTER_S, frames, FRAME_HZ) & listening,
        "later": events.window_after(ends, events.LATER_S, frames, FRAME_HZ) & listening,
        "after_long_phrase": events.window_after(long_ends, (0.0, 0.4), frames, FRAME_HZ) & listening,
        "first_second": (speech_s > 0) & (speech_s <= 1) & listening,
        "late_in_phrase": (speech_s > 8) & listening,
        "long_silence": (silence_s > 2) & ~one.own & ~one.unseen,
    }


def count(one: Scene, onsets: Ints, times: int = 1) -> Rates:
    """Onsets and minutes of every kind of time, for onsets of `times` runs."""
    return {
        kind: (float(mask[onsets].sum()), times * float(mask.sum()) / FRAME_HZ / 60)
        for kind, mask in kinds_of_time(one).items()
    }


def add(parts: Iterable[Rates]) -> Rates:
    """The sum over scenes."""
    total: Rates = {}
    for part in parts:
        for kind, (nods, minutes) in part.items():
            before = total.get(kind, (0.0, 0.0))
            total[kind] = (before[0] + nods, before[1] + minutes)
    return total


def per_minute(counted: Rates, kind: str) -> float:
    """Nods a minute; NaN where there was no such time."""
    nods, minutes = counted.get(kind, (0.0, 0.0))
    return nods / minutes if minutes else float("nan")


def phrase_end_ratio(counted: Rates) -> float:
    return events.ratio_of((*counted["after_phrase"], *counted["later"]))


# --- what the listener did --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Answer:
    """What a listener did in a scene, over S seeds.

    Attributes:
        nods_s: per seed (K, 2); nod_sizes_rad: of all, peak to peak.
        blinks, smiles, gaze_shifts: of all seeds together.
    """

    nods_s: tuple[Doubles, ...]
    nod_sizes_rad: tuple[float, ...]
    blinks: int
    smiles: int
    gaze_shifts: int

    @property
    def onsets(self) -> Ints:
        """Frames at which a nod begins, of all seeds."""
        starts = np.concatenate([nods[:, 0] for nods in self.nods_s])
        return np.round(starts * FRAME_HZ).astype(np.int64)


def observe(motions: Floats) -> Answer:
    """What is to be seen in motion (S, N, 58)."""
    nods = [events.find_nods(motion[:, CHANNEL_INDEX["pitch"]], FRAME_HZ) for motion in motions]
    return Answer(
        tuple(np.array([event[:2] for event in found], np.float64).reshape(-1, 2) for found in nods),
        tuple(size for found in nods for _, _, size in found),
        sum(len(events.find_blinks(motion[:, CHANNEL_INDEX["eyeBlinkLeft"]], FRAME_HZ)) for motion in motions),
        sum(len(events.find_smiles(motion[:, CHANNEL_INDEX["mouthSmileLeft"]], FRAME_HZ)) for motion in motions),
        sum(len(events.find_gaze_shifts(*gaze_rad(motion), FRAME_HZ)) for motion in motions),
    )


def gaze_rad(motion: Floats) -> tuple[Doubles, Doubles]:
    """Yaw and pitch (N,) of the gaze of motion (N, 58), head and eyes together."""

    def shape(name: str) -> Floats:
        return motion[:, CHANNEL_INDEX[name]]

    left = (shape("eyeLookOutLeft") + shape("eyeLookInRight") - shape("eyeLookInLeft") - shape("eyeLookOutRight")) / 2
    down = (shape("eyeLookDownLeft") + shape("eyeLookDownRight") - shape("eyeLookUpLeft") - shape("eyeLookUpRight")) / 2
    yaw = motion[:, CHANNEL_INDEX["yaw"]] + EYE_PAN_RAD * left
    pitch = motion[:, CHANNEL_INDEX["pitch"]] + EYE_TILT_RAD * down
    return np.asarray(yaw, np.float64), np.asarray(pitch, np.float64)


# --- ranking ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NodRanks:
    """AUCs of one person: how a score ranks the onsets of his nods above listening instants without a nod.

    Attributes:
        listener: share of seeds with a nod within 0.5 s of the instant.
        table: rate of the nod table, fitted on other people.
        sampled_table: what the table would get if it, too, nodded by lot, as often and with as many seeds as the
            listener: so much of the distance to `table` is due to so few seeds, not to timing.
        phase: rate by speech phase of the listener's own nods, all seeds and scenes together: timing without the lot.
    """

    listener: float
    table: float
    sampled_table: float
    phase: float


def nod_ranks(
    one: Scene, answer: Answer, rates: Doubles, own_rates: Doubles, rng: np.random.Generator
) -> NodRanks | None:
    """`rates` (CELLS,) are the table's, `own_rates` those of the listener's nods; None for a person of few nods."""
    frames, listening, cell = len(one.others), one.listening, one.cell
    onsets = one.onsets[listening[one.onsets]]
    if len(onsets) < LEAST_NODS:
        return None
    without = listening & ~events.near(one.nods_s, frames, FRAME_HZ, WITHIN_S)

    def auc(scores: Doubles) -> float:
        return events.rank_auc(scores, onsets, without)

    seeds = len(answer.nods_s)
    chance = rates[cell] / 60 / FRAME_HZ
    if chance.any():
        chance = chance * len(answer.onsets) / (seeds * chance.sum())
    sampled = [np.flatnonzero(rng.random(frames) < chance) / FRAME_HZ for _ in range(seeds)]
    return NodRanks(
        auc(nod_share(answer.nods_s, frames)),
        auc(rates[cell]),
        auc(nod_share([np.stack([at, at + _NOD_S], axis=1) for at in sampled], frames)),
        auc(own_rates[cell]),
    )


def nod_share(nods_s: Sequence[Doubles], frames: int) -> Doubles:
    """(frames,) share of the runs with a nod within 0.5 s: the nod probability of every instant."""
    runs = [events.near(nods, frames, FRAME_HZ, WITHIN_S) for nods in nods_s]
    return np.asarray(np.mean(runs, axis=0), np.float64)


def fit_table(people: Sequence[Person]) -> NodTable:
    """The nod table of everybody's whole annotated time."""
    parts: dict[str, list[Counts]] = {}
    for person in people:
        whole = Stretch(person, 0.0, person.until_s)
        others, own, unseen = (active(spans, whole) for spans in (person.others, person.talk, person.unseen))
        listening = events.listening_mask(others, FRAME_HZ, own) & ~unseen
        onsets = np.round(person.nods[:, 0] * FRAME_HZ).astype(np.int64)
        counts = Counts.of(cells(phase.times(others.tolist())), onsets, listening)
        parts.setdefault(series(person.meeting), []).append(counts)
    return NodTable({name: Counts.total(found) for name, found in parts.items()})


# --- all together -----------------------------------------------------------------------------------------------


def summary(
    scenes: Sequence[Scene], answers: Sequence[Answer], table: NodTable, seed: int
) -> tuple[dict[str, float | None], list[NodRanks]]:
    """Figures of the listener and, with the prefix people_, of the people; None where nothing could be counted."""
    runs = len(answers[0].nods_s)
    ours = add(count(one, answer.onsets, runs) for one, answer in zip(scenes, answers, strict=True))
    theirs = add(count(one, one.onsets) for one in scenes)
    pairs = list(zip(scenes, answers, strict=True))
    own_rates = Counts.total(Counts.of(one.cell, answer.onsets, one.listening) for one, answer in pairs).rates()
    rng = np.random.default_rng(seed)
    ranked = [nod_ranks(one, answer, table.rates_for(one.series), own_rates, rng) for one, answer in pairs]
    ranks = [rank for rank in ranked if rank is not None]
    minutes = sum(one.minutes for one in scenes)
    watched = [one for one in scenes if one.gaze_shifts is not None]
    sizes = [size for answer in answers for size in answer.nod_sizes_rad]

    def mean(pick: Callable[[NodRanks], float]) -> float:
        return float(np.mean([pick(rank) for rank in ranks])) if ranks else float("nan")

    found = {
        **_nod_rates(ours, ""),
        "nod_deg": float(np.degrees(np.median(sizes))) if sizes else float("nan"),
        "nod_auc": mean(lambda rank: rank.listener),
        "table_nod_auc": mean(lambda rank: rank.table),
        "sampled_table_nod_auc": mean(lambda rank: rank.sampled_table),
        "phase_nod_auc": mean(lambda rank: rank.phase),
        "blinks_per_minute": sum(answer.blinks for answer in answers) / runs / minutes,
        "smiles_per_minute": sum(answer.smiles for answer in answers) / runs / minutes,
        "gaze_shifts_per_minute": sum(answer.gaze_shifts for answer in answers) / runs / minutes,
        **_nod_rates(theirs, "people_"),
        "people_laughs_per_minute": sum(one.laughs for one in scenes) / minutes,
        "people_gaze_shifts_per_minute": sum(one.gaze_shifts or 0 for one in watched)
        / (sum(one.minutes for one in watched) or float("nan")),
    }
    return {key: round(value, 4) if np.isfinite(value) else None for key, value in found.items()}, ranks


def _nod_rates(counted: Mapping[str, tuple[float, float]], prefix: str) -> dict[str, float]:
    rates = dict(counted)
    return {
        f"{prefix}nods_per_minute": per_minute(rates, "listening"),
        f"{prefix}phrase_end_ratio": phrase_end_ratio(rates),
        f"{prefix}nods_after_long_phrase": per_minute(rates, "after_long_phrase"),
        f"{prefix}nods_first_second": per_minute(rates, "first_second"),
        f"{prefix}nods_late_in_phrase": per_minute(rates, "late_in_phrase"),
        f"{prefix}nods_long_silence": per_minute(rates, "long_silence"),
    }
