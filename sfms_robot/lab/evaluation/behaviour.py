"""How listeners behave: nods, blinks, smiles, how still and how smooth they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.evaluation import phrase_timing
from sfms_robot.signals import events

ROTATIONS = slice(0, 3)


@dataclass(frozen=True)
class Behaviour:
    """How a set of faces behaves. Rates are per minute, nods over listening time.

    Attributes:
        phrase_end_ratio: nod onsets just after phrase ends over those later on .
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


def behaviour(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> Behaviour:
    """Figures of listeners (N, 58), each beside the dyad it belongs to."""
    onsets, minutes, sizes = 0.0, 0.0, []
    counts = np.zeros(4)
    blinks = smiles = total = 0.0
    for motion, dyad in zip(motions, dyads, strict=True):
        nods = events.find_nods(motion[:, CHANNEL_INDEX["pitch"]], FRAME_HZ)
        starts = [start for start, _, _ in nods]
        listened = float(dyad.listening.sum()) / FRAME_HZ / 60
        onsets += sum(bool(dyad.listening[int(start * FRAME_HZ)]) for start in starts)
        minutes += listened
        sizes += [size for _, _, size in nods]
        spoke = np.zeros(len(motion), bool) if dyad.audio is None else phrase_timing.voice_activity(dyad.audio)
        ends = phrase_timing.phrase_ends(spoke, FRAME_HZ)
        counts += phrase_timing.phrase_end_counts(starts, ends, dyad.listening, FRAME_HZ)
        blinks += len(events.find_blinks(motion[:, CHANNEL_INDEX["eyeBlinkLeft"]], FRAME_HZ))
        smiles += len(events.find_smiles(motion[:, CHANNEL_INDEX["mouthSmileLeft"]], FRAME_HZ))
        total += len(motion) / FRAME_HZ / 60
    return Behaviour(
        nods=onsets / minutes if minutes else float("nan"),
        nod_deg=float(np.degrees(np.median(sizes))) if sizes else float("nan"),
        phrase_end_ratio=phrase_timing.ratio_of([float(count) for count in counts]),
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
