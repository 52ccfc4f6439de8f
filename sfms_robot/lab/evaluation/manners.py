"""How somebody moves, as figures that can be held against people's: nods, blinks, smiles, gaze and slow sway.

Everything is counted in motion (N, 58) at 25 Hz, of a listener and of people alike, by the same detectors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import welch

from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, Doubles, Floats
from sfms_robot.lab.evaluation import phrase_timing
from sfms_robot.lab.evaluation.detection import gaze_rad, seen
from sfms_robot.signals import events

ON_PERSON_RAD: Final = np.deg2rad(5.0)
FIXATION_RAD: Final = np.deg2rad(2.0)  # a look ends when gaze has gone that far from where it began
SHIFT_RAD: Final = np.deg2rad(5.0)
SWAY_BANDS_HZ: Final = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.4))
SWAY_WINDOW: Final = 20 * FRAME_HZ
SLOW: Final = 10 * FRAME_HZ  # frames of which the median is a slow pose
FindEvents = Callable[[Floats, float], Sequence[events.Event]]


@dataclass(frozen=True)
class Manners:
    """What was found in some motions, each kind in a list of its own; what was not found is an empty one.

    Attributes:
        nod_deg, nod_s, nod_swings: size peak to peak, length, and times there and back, of each nod.
        blink_s, smile_s: lengths.
        look_s: how long gaze stays within 2 degrees.
        shifts_per_minute: of gaze, by 5 degrees and more.
        on_person: share of time with gaze within 5 degrees of the person, where that is asked for.
        sway_db: power of the head's turns by band of `SWAY_BANDS_HZ`, dB of a square degree per Hz.
    """

    nod_deg: Doubles
    nod_s: Doubles
    nod_swings: Doubles
    blink_s: Doubles
    smile_s: Doubles
    look_s: Doubles
    shifts_per_minute: float
    on_person: float
    sway_db: Doubles


def manners(motions: Sequence[Floats], addressed: Sequence[events.Bools]) -> Manners:
    """Of motions (N, 58), each with the frames (N,) in which the person is to be looked at."""
    nods = [
        (size, end - start, _swings(motion, start, end))
        for motion in motions
        for start, end, size in seen(motion, "nod")
    ]
    gazes = [gaze_rad(motion) for motion in motions]
    minutes = sum(map(len, motions)) / FRAME_HZ / 60
    on_person = [
        np.hypot(*gaze[asked].T) <= ON_PERSON_RAD for gaze, asked in zip(gazes, addressed, strict=True) if asked.any()
    ]
    sizes, lengths, swings = np.array(nods, np.float64).reshape(-1, 3).T
    return Manners(
        np.degrees(sizes),
        lengths,
        swings,
        _lengths(motions, "eyeBlinkLeft", events.find_blinks),
        _lengths(motions, "mouthSmileLeft", events.find_smiles),
        np.array([length for gaze in gazes for length in looks_s(gaze)]),
        sum(shifts(gaze) for gaze in gazes) / minutes if minutes else float("nan"),
        float(np.mean(np.concatenate(on_person))) if on_person else float("nan"),
        sway_db(motions),
    )


def _lengths(motions: Sequence[Floats], channel: str, find: FindEvents) -> Doubles:
    found = [find(motion[:, CHANNEL_INDEX[channel]], FRAME_HZ) for motion in motions]
    return np.array([end - start for one in found for start, end, _ in one], np.float64)


def _swings(motion: Floats, start_s: float, end_s: float) -> float:
    """Times that the head goes down and comes back within a nod."""
    pitch = motion[int(start_s * FRAME_HZ) : int(end_s * FRAME_HZ) + 2, CHANNEL_INDEX["pitch"]].astype(np.float64)
    turns = np.diff(np.sign(np.diff(pitch)))
    return max(1.0, round(float(np.count_nonzero(turns)) / 2))


def looks_s(gaze: Doubles) -> list[float]:
    """How long gaze (N, 2) stays within 2 degrees of where it settled, look by look; the last one is cut short."""
    found, first = [], 0
    for frame in range(1, len(gaze)):
        if np.hypot(*(gaze[frame] - gaze[first])) > FIXATION_RAD:
            found.append((frame - first) / FRAME_HZ)
            first = frame
    return [length for length in found if length > 1.5 / FRAME_HZ]  # shorter ones are the way of a shift


def shifts(gaze: Doubles) -> int:
    """How often gaze (N, 2) goes 5 degrees and farther within 0.2 s."""
    return len(phrase_timing.find_gaze_shifts(gaze[:, 0], gaze[:, 1], FRAME_HZ, SHIFT_RAD))


def sway_db(motions: Sequence[Floats]) -> Doubles:
    """Mean power (B,) of roll, pitch and yaw in `SWAY_BANDS_HZ`; NaN where no motion lasts twenty seconds."""
    long = [motion[:, :3] for motion in motions if len(motion) >= SWAY_WINDOW]
    if not long:
        return np.full(len(SWAY_BANDS_HZ), np.nan)
    powers = [welch(np.degrees(turns.astype(np.float64)), FRAME_HZ, nperseg=SWAY_WINDOW, axis=0) for turns in long]
    hz, mean = powers[0][0], np.mean([power.mean(axis=1) for _, power in powers], axis=0)
    return np.array([10 * np.log10(mean[(hz >= low) & (hz < high)].mean() + 1e-12) for low, high in SWAY_BANDS_HZ])


def slow_poses_deg(motions: Sequence[Floats]) -> Doubles:
    """(K, 3) roll, pitch, yaw: the median of every ten seconds."""
    found = [np.median(motion[at : at + SLOW, :3], axis=0) for motion in motions for at in range(0, len(motion), SLOW)]
    return np.degrees(np.array(found, np.float64).reshape(-1, 3))


def ratio(ours: Doubles, theirs: Doubles) -> float:
    """Median over median; NaN where either is empty."""
    return float(np.median(ours) / np.median(theirs)) if len(ours) and len(theirs) else float("nan")


def quartiles(values: Doubles) -> Mapping[str, float]:
    """p10, p50 and p90; NaN of none."""
    found = np.percentile(values, [10, 50, 90]) if len(values) else np.full(3, np.nan)
    return dict(zip(("p10", "p50", "p90"), found.tolist(), strict=True))
