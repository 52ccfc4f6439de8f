"""A listener left to itself: stream held-out speakers through it and compare what it does with what people did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sfms_robot.corpora.clips import Dyad
from sfms_robot.frames import (
    CHANNEL_INDEX,
    FRAME_HZ,
    FRAME_S,
    FRAME_SAMPLES,
    MOTION_DIM,
    FaceFrame,
    Floats,
    Plan,
    SpeakerFrame,
)
from sfms_robot.ports import Listener
from sfms_robot.signals import events as timing

ROTATIONS = slice(0, 3)


@dataclass(frozen=True)
class Behaviour:
    """How a set of faces behaves. Rates are per minute, nods over listening time.

    Attributes:
        phrase_end_ratio: nod onsets just after phrase ends over those later on (`metrics.timing`).
        nod_deg: median peak to peak of a nod.
        still_share: share of seconds in which the head turns less than 0.1 degree.
        speed_deg_s: 99.9th percentile of head speed; acceleration_deg_s2, jerk_deg_s3: its differences, likewise.
    """

    nods: float
    nod_deg: float
    phrase_end_ratio: float
    blinks: float
    smiles: float
    still_share: float
    speed_deg_s: float
    acceleration_deg_s2: float
    jerk_deg_s3: float

    def __str__(self) -> str:
        return "  ".join(f"{field.name} {getattr(self, field.name):.2f}" for field in fields(self))


def speaker_frames(dyad: Dyad) -> list[SpeakerFrame]:
    """The speaker of a dyad as a source would give it."""
    return frames_of(dyad.audio, dyad.speaker)


def frames_of(audio: Floats | None, face: Floats) -> list[SpeakerFrame]:
    """Sound (N * 640,) and face (N, 58) by frame; a face of NaN is None, no sound at all is no microphone."""
    heard = audio if audio is not None and audio.any() else np.zeros(0, np.float32)
    frames = []
    for index, row in enumerate(face):
        time_s = (index + 1) * FRAME_S
        sound = heard[index * FRAME_SAMPLES : (index + 1) * FRAME_SAMPLES]
        frames.append(SpeakerFrame(time_s, sound, FaceFrame.of(time_s, row) if np.isfinite(row).all() else None))
    return frames


def roll_out(listener: Listener, speaker: Sequence[SpeakerFrame], seed: int) -> Floats:
    """(N, 58) what the listener's face did while `speaker` (N frames) was heard: each plan until the next one."""
    memory = listener.start(seed)
    motion = np.zeros((len(speaker) + listener.horizon, MOTION_DIM), dtype=np.float32)
    for index, frame in enumerate(speaker):
        plan, memory = listener.step(frame, memory)
        if plan is not None:
            motion[index + 1 : index + 1 + listener.horizon] = plan.frames
    return motion[: len(speaker)]


@runtime_checkable
class ManyStreams(Protocol):
    """A listener that steps several streams of one speaker at once."""

    def step_many(self, speaker: SpeakerFrame, memories: Sequence[Any]) -> tuple[Sequence[Plan], Sequence[Any]]:
        """`Listener.step` of streams that have heard the same from the start; no plans between hops."""


def roll_out_many(listener: Listener, speaker: Sequence[SpeakerFrame], seeds: Sequence[int]) -> Floats:
    """(S, N, 58) `roll_out` of every seed, side by side where the listener offers it."""
    if not isinstance(listener, ManyStreams):
        return np.stack([roll_out(listener, speaker, seed) for seed in seeds])
    memories: Sequence[Any] = [listener.start(seed) for seed in seeds]
    motion = np.zeros((len(seeds), len(speaker) + listener.horizon, MOTION_DIM), dtype=np.float32)
    for index, frame in enumerate(speaker):
        plans, memories = listener.step_many(frame, memories)
        for row, plan in enumerate(plans):
            motion[row, index + 1 : index + 1 + listener.horizon] = plan.frames
    return motion[:, : len(speaker)]


def behaviour(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> Behaviour:
    """Figures of listeners (N, 58), each beside the dyad it belongs to."""
    onsets, minutes, sizes = 0.0, 0.0, []
    counts = np.zeros(4)
    blinks = smiles = total = 0.0
    for motion, dyad in zip(motions, dyads, strict=True):
        nods = timing.find_nods(motion[:, CHANNEL_INDEX["pitch"]], FRAME_HZ)
        starts = [start for start, _, _ in nods]
        listened = float(dyad.listening.sum()) / FRAME_HZ / 60
        onsets += sum(bool(dyad.listening[int(start * FRAME_HZ)]) for start in starts)
        minutes += listened
        sizes += [size for _, _, size in nods]
        spoke = np.zeros(len(motion), bool) if dyad.audio is None else timing.voice_activity(dyad.audio)
        ends = timing.phrase_ends(spoke, FRAME_HZ)
        counts += timing.phrase_end_counts(starts, ends, dyad.listening, FRAME_HZ)
        blinks += len(timing.find_blinks(motion[:, CHANNEL_INDEX["eyeBlinkLeft"]], FRAME_HZ))
        smiles += len(timing.find_smiles(motion[:, CHANNEL_INDEX["mouthSmileLeft"]], FRAME_HZ))
        total += len(motion) / FRAME_HZ / 60
    return Behaviour(
        nods=onsets / minutes if minutes else float("nan"),
        nod_deg=float(np.degrees(np.median(sizes))) if sizes else float("nan"),
        phrase_end_ratio=timing.ratio_of([float(count) for count in counts]),
        blinks=blinks / total,
        smiles=smiles / total,
        still_share=_still(motions),
        speed_deg_s=_differences(motions, 1),
        acceleration_deg_s2=_differences(motions, 2),
        jerk_deg_s3=_differences(motions, 3),
    )


def _still(motions: Sequence[Floats]) -> float:
    """Share of seconds, mean over the motions; NaN when none lasts a second."""
    shares = []
    for motion in motions:
        if seconds := len(motion) // FRAME_HZ:
            turns = np.degrees(motion[: seconds * FRAME_HZ, ROTATIONS]).reshape(seconds, FRAME_HZ, 3)
            shares.append((np.ptp(turns, axis=1).max(axis=1) < 0.1).mean())
    return float(np.mean(shares)) if shares else float("nan")


def _differences(motions: Sequence[Floats], order: int) -> float:
    values = [np.linalg.norm(np.diff(motion[:, ROTATIONS].astype(float), order, axis=0), axis=1) for motion in motions]
    pooled = np.concatenate(values)
    return float(np.degrees(np.percentile(pooled, 99.9)) * FRAME_HZ**order) if len(pooled) else float("nan")


def evaluate_rollout(
    listener: Listener,
    dyads: Sequence[Dyad],
    seed: int = 1,
    each: Callable[[int, int], None] | None = None,
) -> tuple[Behaviour, Behaviour, list[Floats]]:
    """What the listener does, what the dyads' own listeners did, and the listener's motions.

    `each(done, of)` is called after every dyad.
    """
    motions = []
    for index, dyad in enumerate(dyads):
        motions.append(roll_out(listener, speaker_frames(dyad), seed + index))
        if each is not None:
            each(index + 1, len(dyads))
    return behaviour(motions, dyads), behaviour([dyad.listener for dyad in dyads], dyads), motions
