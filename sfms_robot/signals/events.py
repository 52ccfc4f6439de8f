"""Nods, blinks and smiles in a motion.

Pure functions on arrays sampled at `rate_hz` (25 in this project). An event is (start_s, end_s, size). scipy.signal is
loaded at the first search, which takes half a second: a run does that before its loop begins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfms_robot.frames import BLINKS, CHANNEL_INDEX, SMILE_CORNERS

Event = tuple[float, float, float]
Bools = NDArray[np.bool_]
_NOD_RAD: Final = np.deg2rad(1.6)
_BLINK, _SMILE = 0.35, 0.2
_SHORTEST: Final = 16  # samples that the zero-phase filter needs


def find_nods(pitch_rad: ArrayLike, rate_hz: float) -> list[Event]:
    """Find nods in a head pitch (N,): swings down and back (or back and down) of 1.6 degrees peak to peak or more.

    Returns (start_s, end_s, peak-to-peak rad) in order. Only swings faster than about 0.8 Hz count, and only
    those that come back: a gaze shift goes one way, a drift is slow. Swings less than 0.3 s apart are one nod.
    """
    from scipy import signal

    pitch = np.asarray(pitch_rad, np.float64)
    if len(pitch) < max(int(rate_hz), _SHORTEST):
        return []
    sections = signal.butter(2, (0.8, min(6.0, 0.45 * rate_hz)), "bandpass", fs=rate_hz, output="sos")
    swing = signal.sosfiltfilt(sections, pitch)
    highs, lows = (signal.find_peaks(way, prominence=0.35 * _NOD_RAD)[0] for way in (swing, -swing))
    turns = sorted({0, len(swing) - 1, *highs.tolist(), *lows.tolist()})
    found: list[Event] = []
    for a, b, c in zip(turns[:-2], turns[1:-1], turns[2:], strict=True):
        down, up = abs(swing[b] - swing[a]), abs(swing[c] - swing[b])
        spread = np.ptp(pitch[a : c + 1])
        returned = abs(pitch[c] - pitch[a]) < 0.4 * spread
        if min(down, up) < 0.5 * _NOD_RAD or spread < _NOD_RAD or not returned:
            continue
        if not 0.15 <= (c - a) / rate_hz <= 1.4:
            continue
        if found and a / rate_hz - found[-1][1] < 0.3:
            start, _, size = found.pop()
            found.append((start, c / rate_hz, max(size, float(spread))))
        else:
            found.append((a / rate_hz, c / rate_hz, float(spread)))
    return [event for event in found if event[1] - event[0] <= 6]


def find_blinks(blink: ArrayLike, rate_hz: float) -> list[Event]:
    """Find blinks in a lid closure (N,) 0..1: rises by 0.35 that are over within 0.6 s. One frame is enough.

    Returns (start_s, end_s, height), counted against the closure around it, so lids that rest half closed are fine.
    """
    from scipy import signal

    framed = np.r_[0.0, np.asarray(blink, np.float64), 0.0]
    peaks, found = signal.find_peaks(framed, prominence=_BLINK, distance=max(1, int(0.12 * rate_hz)))
    _, _, starts, ends = signal.peak_widths(framed, peaks)
    rows = zip(starts.tolist(), ends.tolist(), found["prominences"].tolist(), strict=True)
    return [((a - 1) / rate_hz, (b - 1) / rate_hz, height) for a, b, height in rows if (b - a) / rate_hz <= 0.6]


def find_smiles(smile: ArrayLike, rate_hz: float) -> list[Event]:
    """Find smiles in a mouthSmile (N,): above 0.2 for 0.4 s or more; ends where it falls below half of that.

    Returns (start_s, end_s, peak).
    """
    level = np.asarray(smile, np.float64)
    found: list[Event] = []
    for start, end in runs(level > 0.5 * _SMILE):
        peak = float(level[start:end].max())
        if peak > _SMILE and np.count_nonzero(level[start:end] > _SMILE) >= 0.4 * rate_hz:
            found.append((start / rate_hz, end / rate_hz, peak))
    return found


@dataclass(frozen=True)
class EventKind:
    """Detector of one kind of event in motion.

    Attributes:
        signal: motion (..., 58) -> the signal (...,) that shows the event.
        find: signal (N,) and its rate -> events in order.
        whole: the event is reported only when it is over.
    """

    signal: Callable[[NDArray[np.floating]], NDArray[np.floating]]
    find: Callable[[ArrayLike, float], list[Event]]
    whole: bool


_CORNERS: Final = [CHANNEL_INDEX[name] for name in SMILE_CORNERS]

# Definitions of a nod, a blink and a smile of a face, for the report, callbacks and evaluation.
MOTION_EVENTS: Final[Mapping[str, EventKind]] = {
    "nod": EventKind(lambda motion: motion[..., CHANNEL_INDEX["pitch"]], find_nods, whole=True),
    "blink": EventKind(lambda motion: motion[..., BLINKS].max(axis=-1), find_blinks, whole=True),
    "smile": EventKind(lambda motion: motion[..., _CORNERS].mean(axis=-1), find_smiles, whole=False),
}


def runs(mask: ArrayLike) -> list[tuple[int, int]]:
    """Return half-open [start, end) of every run of True in (N,)."""
    bounds = np.flatnonzero(np.diff(np.r_[0, np.asarray(mask, np.int8), 0]))
    return list(zip(bounds[::2].tolist(), bounds[1::2].tolist(), strict=True))
