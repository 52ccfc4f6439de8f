"""Statistics of behaviour in motion (N, 58) at 25 Hz, of a listener and of people alike, by the same detectors.

`behaviour` has rates beside a dyad: nods, blinks, smiles, stillness, smoothness. `movement` describes each kind of
motion: nods, blinks, smiles, gaze, and slow sway.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from scipy.signal import welch

from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, Doubles, Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.evaluation import phrase_timing
from sfms_robot.lab.evaluation.detection import gaze_rad, seen
from sfms_robot.signals import events

SWAY_BANDS_HZ: Final = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.4))
_ROTATIONS: Final = slice(0, 3)
_STILL_DEG: Final = 0.1
_ON_PERSON_RAD: Final = np.deg2rad(5.0)
_FIXATION_RAD: Final = np.deg2rad(2.0)  # a look ends when gaze is that far from where it began
_SHIFT_RAD: Final = np.deg2rad(5.0)
_SWAY_WINDOW: Final = 20 * FRAME_HZ
_SLOW: Final = 10 * FRAME_HZ  # frames whose median is a slow pose
FindEvents = Callable[[Floats, float], Sequence[events.Event]]


def behaviour(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> dict[str, float]:
    """Return figures of listeners (N, 58), each beside the dyad it belongs to; NaN where there is no data.

    Rates are per minute, nods over listening time. nod_deg: median peak to peak. phrase_end_ratio: nod onsets just
    after phrase ends over those later on. still_share: share of seconds in which the head turns less than 0.1 degree.
    speed, acceleration and jerk: 99.9th percentiles of the head's rotation.
    """
    onsets, listened, sizes = 0, 0.0, []
    counts = np.zeros(4)
    for motion, dyad in zip(motions, dyads, strict=True):
        nods = events.find_nods(motion[:, CHANNEL_INDEX["pitch"]], FRAME_HZ)
        starts = [start for start, _, _ in nods]
        listened += float(dyad.listening.sum()) / FRAME_HZ / 60
        onsets += sum(bool(dyad.listening[int(start * FRAME_HZ)]) for start in starts)
        sizes += [size for _, _, size in nods]
        spoke = np.zeros(len(motion), bool) if dyad.audio is None else phrase_timing.voice_activity(dyad.audio)
        counts += phrase_timing.phrase_end_counts(
            starts, phrase_timing.phrase_ends(spoke, FRAME_HZ), dyad.listening, FRAME_HZ
        )
    minutes = sum(len(motion) / FRAME_HZ / 60 for motion in motions)
    return {
        "nods": onsets / listened if listened else float("nan"),
        "nod_deg": float(np.degrees(middle(sizes))),
        "phrase_end_ratio": phrase_timing.ratio_of(counts.tolist()),
        "blinks": len(_spans(motions, "eyeBlinkLeft", events.find_blinks)) / minutes,
        "smiles": len(_spans(motions, "mouthSmileLeft", events.find_smiles)) / minutes,
        "still_share": _still_share(motions),
        "speed_deg_s": _fastest(motions, 1),
        "acceleration_deg_s2": _fastest(motions, 2),
        "jerk_deg_s3": _fastest(motions, 3),
    }


def middle(values: Sequence[float] | Doubles) -> float:
    """Return the median; NaN of no values."""
    return float(np.median(values)) if len(values) else float("nan")


def _spans(motions: Sequence[Floats], channel: str, find: FindEvents) -> list[events.Event]:
    return [event for motion in motions for event in find(motion[:, CHANNEL_INDEX[channel]], FRAME_HZ)]


def _still_share(motions: Sequence[Floats]) -> float:
    """Return the mean over the motions; NaN when none lasts a second."""
    shares = []
    for motion in motions:
        if seconds := len(motion) // FRAME_HZ:
            turns = np.degrees(motion[: seconds * FRAME_HZ, _ROTATIONS]).reshape(seconds, FRAME_HZ, 3)
            shares.append((np.ptp(turns, axis=1).max(axis=1) < _STILL_DEG).mean())
    return float(np.mean(shares)) if shares else float("nan")


def _fastest(motions: Sequence[Floats], order: int) -> float:
    values = [np.linalg.norm(np.diff(motion[:, _ROTATIONS].astype(float), order, axis=0), axis=1) for motion in motions]
    pooled = np.concatenate(values)
    return float(np.degrees(np.percentile(pooled, 99.9)) * FRAME_HZ**order) if len(pooled) else float("nan")


# --- how a face moves -----------------------------------------------------------------------------------------------


def movement(motions: Sequence[Floats], addressed: Sequence[events.Bools]) -> dict[str, float]:
    """Return figures of motions (N, 58), each with the frames (N,) in which gaze at the person is expected.

    Medians of nods (size, length, swings), of the lengths of blinks, smiles and looks, gaze within 5 degrees of the
    person (share of the expected time), gaze shifts of 5 degrees and more per minute, and power of the head's turns by
    band of `SWAY_BANDS_HZ`. NaN where nothing was found.
    """
    sizes, lengths, swings = nods_of(motions).T
    gazes = [gaze_rad(motion) for motion in motions]
    minutes = sum(map(len, motions)) / FRAME_HZ / 60
    on_person = np.concatenate(
        [np.hypot(*gaze[asked].T) <= _ON_PERSON_RAD for gaze, asked in zip(gazes, addressed, strict=True)] or [[]]
    )
    return {
        "nod_deg": middle(np.degrees(sizes)),
        "nod_s": middle(lengths),
        "nod_swings": middle(swings),
        "blink_s": middle([end - start for start, end, _ in _spans(motions, "eyeBlinkLeft", events.find_blinks)]),
        "smile_s": middle([end - start for start, end, _ in _spans(motions, "mouthSmileLeft", events.find_smiles)]),
        "look_s": middle([length for gaze in gazes for length in looks_s(gaze)]),
        "gaze_on_person": float(on_person.mean()) if len(on_person) else float("nan"),
        "gaze_shifts_per_minute": sum(map(shifts, gazes)) / minutes if minutes else float("nan"),
        **{
            f"sway_db_{low:g}_{high:g}_hz": power
            for (low, high), power in zip(SWAY_BANDS_HZ, sway_db(motions).tolist(), strict=True)
        },
    }


def nods_of(motions: Sequence[Floats]) -> Doubles:
    """Return (K, 3): size peak to peak [rad], length [s], and swings down and back of each nod."""
    nods = [
        (size, end - start, _swings(motion, start, end))
        for motion in motions
        for start, end, size in seen(motion, "nod")
    ]
    return np.array(nods, np.float64).reshape(-1, 3)


def _swings(motion: Floats, start_s: float, end_s: float) -> float:
    pitch = motion[int(start_s * FRAME_HZ) : int(end_s * FRAME_HZ) + 2, CHANNEL_INDEX["pitch"]].astype(np.float64)
    turns = np.diff(np.sign(np.diff(pitch)))
    return max(1.0, round(float(np.count_nonzero(turns)) / 2))


def looks_s(gaze: Doubles) -> list[float]:
    """Return how long gaze (N, 2) stays within 2 degrees of where it settled, per look; the last one is dropped."""
    found, first = [], 0
    for frame in range(1, len(gaze)):
        if np.hypot(*(gaze[frame] - gaze[first])) > _FIXATION_RAD:
            found.append((frame - first) / FRAME_HZ)
            first = frame
    return [length for length in found if length > 1.5 / FRAME_HZ]  # shorter ones are part of a shift


def shifts(gaze: Doubles) -> int:
    """Return how often gaze (N, 2) moves by 5 degrees or more within 0.2 s."""
    return len(phrase_timing.find_gaze_shifts(gaze[:, 0], gaze[:, 1], FRAME_HZ, _SHIFT_RAD))


def sway_db(motions: Sequence[Floats]) -> Doubles:
    """Return the mean power (B,) of roll, pitch and yaw in `SWAY_BANDS_HZ`, dB of a square degree per Hz.

    NaN if no motion lasts twenty seconds.
    """
    long = [motion[:, _ROTATIONS] for motion in motions if len(motion) >= _SWAY_WINDOW]
    if not long:
        return np.full(len(SWAY_BANDS_HZ), np.nan)
    powers = [welch(np.degrees(turns.astype(np.float64)), FRAME_HZ, nperseg=_SWAY_WINDOW, axis=0) for turns in long]
    hz, mean = powers[0][0], np.mean([power.mean(axis=1) for _, power in powers], axis=0)
    return np.array([10 * np.log10(mean[(hz >= low) & (hz < high)].mean() + 1e-12) for low, high in SWAY_BANDS_HZ])


def slow_poses_deg(motions: Sequence[Floats]) -> Doubles:
    """Return roll, pitch, yaw (K, 3): the median of every ten seconds."""
    found = [
        np.median(motion[at : at + _SLOW, _ROTATIONS], axis=0)
        for motion in motions
        for at in range(0, len(motion), _SLOW)
    ]
    return np.degrees(np.array(found, np.float64).reshape(-1, 3))
