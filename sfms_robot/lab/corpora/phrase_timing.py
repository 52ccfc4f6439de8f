"""Timing of a listener's events relative to the other person's speech.

Functions work on frames at 25 Hz unless another rate is named. The phrase-end ratio compares two windows after the same
phrase ends, so a listener that nods at random gets 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_S, Bools, Doubles
from sfms_robot.signals.events import runs

AFTER_S: Final = (0.0, 0.8)  # right after a phrase end
LATER_S: Final = (1.5, 3.0)  # compared with `AFTER_S`
PAUSE_S: Final = 0.2  # a silence of this length ends a phrase
QUIET_DB: Final = -66.0  # of full scale; quieter sound is not speech
LISTENING_S: Final = 2.0  # the listener listens for this long after the other's speech


def voice_activity(audio: ArrayLike, frame_s: float = FRAME_S) -> Bools:
    """Detect speech per frame of `audio` (n,) by energy over an adaptive floor; an incomplete last frame is left out.

    The floor is the 5th percentile of the level in the surrounding 8 s. The threshold lies 8 dB above it, but always 16
    to 34 dB below the loud parts, so that hum, gain and talk without pauses are tolerated. Offline: it looks ahead.
    """
    from scipy import ndimage

    samples = np.asarray(audio, np.float64)
    size = round(AUDIO_HZ * frame_s)
    frames = len(samples) // size
    if not frames:
        return np.zeros(0, bool)
    power = (samples[: frames * size].reshape(frames, size) ** 2).mean(axis=1)
    level_db = 10 * np.log10(power + 1e-10)
    loud_db = np.percentile(level_db, 97)
    floor_db = ndimage.percentile_filter(level_db, 5, size=max(3, int(8 / frame_s)), mode="nearest")
    threshold_db = np.clip(floor_db + 8, loud_db - 34, loud_db - 16)
    active: Bools = (level_db > threshold_db) & (level_db > QUIET_DB)
    for start, end in runs(active):
        active[start:end] = end - start > 1  # a single frame is not speech
    return active


def phrase_ends(voice_active: Bools) -> Doubles:
    """Return the seconds at which speech ends and at least 0.2 s of silence follow."""
    need = int(np.ceil(PAUSE_S * FRAME_HZ - 1e-9))
    return np.array([start / FRAME_HZ for start, end in runs(~voice_active) if start > 0 and end - start >= need])


def listening_mask(voice_active: Bools, own_voice: Bools | bool = False, rate_hz: float = FRAME_HZ) -> Bools:
    """Return True where the other spoke in the last 2 s (this instant included) and the listener is silent."""
    index = np.arange(len(voice_active))
    last = np.maximum.accumulate(np.where(voice_active, index, -(10**9)))
    return (index - last <= LISTENING_S * rate_hz) & np.logical_not(own_voice)


def nods_per_minute(onsets_s: ArrayLike, listening: Bools) -> float:
    """Return the onsets in listening time per minute of listening time; NaN without any."""
    inside, minutes = _inside(onsets_s, listening)
    return inside / minutes if minutes else np.nan


def minutes_of(mask: Bools) -> float:
    """Return the minutes of the frames in which a mask is True."""
    return float(mask.sum()) / FRAME_HZ / 60


def _inside(onsets_s: ArrayLike, mask: Bools) -> tuple[int, float]:
    index = np.round(np.asarray(onsets_s, np.float64) * FRAME_HZ).astype(int)
    index = index[(index >= 0) & (index < len(mask))]
    return int(mask[index].sum()), minutes_of(mask)


def phrase_end_counts(onsets_s: ArrayLike, ends_s: Doubles, listening: Bools) -> tuple[int, float, int, float]:
    """Count onsets and minutes in the two windows after phrase ends, both within listening time.

    Returns (onsets after, minutes after, onsets later, minutes later): add them up over people, then divide.
    An instant in both windows (of two phrase ends) counts in both; in two windows of one kind it counts once.
    """
    after, later = (window_after(ends_s, span_s, len(listening)) & listening for span_s in (AFTER_S, LATER_S))
    return (*_inside(onsets_s, after), *_inside(onsets_s, later))


def window_after(ends_s: Iterable[float], span_s: tuple[float, float], size: int) -> Bools:
    """Return (size,), True in the window `span_s` after each instant of `ends_s`."""
    mask = np.zeros(size, bool)
    for end in ends_s:
        first, last = (max(0, round(float(end + offset) * FRAME_HZ)) for offset in span_s)
        mask[first:last] = True
    return mask


def ratio_of(counts: Sequence[float]) -> float:
    """Return the phrase-end ratio of (onsets after, minutes after, onsets later, minutes later), summed over people.

    It is the rate of onsets 0 to 0.8 s after a phrase end over that 1.5 to 3 s after it; NaN if undefined.
    """
    after, after_min, later, later_min = counts
    if not later or not after_min or not later_min:
        return np.nan
    return (after / after_min) / (later / later_min)


def near(spans_s: Doubles, frames: int, within_s: float) -> Bools:
    """Return (frames,), True at instants that are at most `within_s` away from one of the spans (K, 2)."""
    mask = np.zeros(frames, bool)
    for start, end in spans_s.tolist():
        first, last = math.ceil((start - within_s) * FRAME_HZ - 1e-6), math.floor((end + within_s) * FRAME_HZ + 1e-6)
        mask[max(0, first) : max(0, last + 1)] = True
    return mask


def rank_auc(scores: Doubles, positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Return the chance that a positive instant scores above a negative one, ties half; NaN if one kind is missing.

    scores (N,); positive and negative are (N,) masks or indices.
    """
    from scipy import stats

    high, low = scores[positive], scores[negative]
    if not len(high) or not len(low):
        return np.nan
    ranks = stats.rankdata(np.concatenate([high, low]))[: len(high)]
    return float((ranks.sum() - len(high) * (len(high) + 1) / 2) / (len(high) * len(low)))


def find_gaze_shifts(gaze: Doubles, least_rad: float = 0.14) -> list[float]:
    """Return the seconds at which the gaze (N, 2) of head and eyes together jumps by 8 degrees or more.

    A jump is a change within 0.2 s from one quarter second of rest to the next; jumps closer than 0.3 s count as one.
    """
    from scipy import signal

    rest, jump = round(0.24 * FRAME_HZ), round(0.2 * FRAME_HZ)
    if len(gaze) < 2 * rest + jump:
        return []
    windows = np.lib.stride_tricks.sliding_window_view(gaze, rest, axis=0)
    settled = np.median(windows, axis=-1)  # [i]: frames i to i + rest
    size = np.hypot(*(settled[rest + jump :] - settled[: -rest - jump]).T)
    peaks, _ = signal.find_peaks(np.r_[0.0, size, 0.0], height=least_rad, distance=round(0.3 * FRAME_HZ))
    return [float((peak - 1 + rest + jump / 2) / FRAME_HZ) for peak in peaks]
