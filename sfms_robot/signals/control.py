"""Control rows: decided events, such as a nod, a smile or a blink, as numbers per frame for a model of motion.

Training uses the events from which a dyad is made, a stream those decided so far; both get the same rows from here. Row
i describes the end of frame i. Laws: the rows of two halves equal the rows of the whole; an event outside its time
changes nothing; rows are finite, and bounded by `BOUND`, for any events.

Columns of each kind: active (0 or 1), time since its start (logarithm), share of it that is over (0..1), size. Kinds
that swing also have sine and cosine of the phase of the swing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_S, Doubles, Floats, ListenerEvent

# Gaze shifts are missing, because the eyes follow `gaze_kinematics` after the model.
KINDS: Final = ("nod", "shake", "tilt", "laugh", "smile", "mm_hm", "brow_raise", "blink")
SWINGING: Final = ("nod", "shake")
FULL_SIZE: Final = {"nod": np.deg2rad(6.0), "shake": np.deg2rad(8.0), "tilt": np.deg2rad(5.0)}  # coded as 1; default 1
BOUND: Final = 4.0
_EACH: Final = 4
COLUMNS: Final = tuple(f"{kind}.{what}" for kind in KINDS for what in ("active", "since", "over", "size")) + tuple(
    f"{kind}.{what}" for kind in SWINGING for what in ("sine", "cosine")
)
_SOFT_S: Final = 0.2


def control_track(events: Sequence[ListenerEvent], first: int, frames: int) -> Floats:
    """Return rows (frames, len(COLUMNS)) of frames `first`, `first` + 1, ...; times of the events count from frame 0.

    Of two events of one kind at one time the later one counts. Kinds without columns are left out.
    """
    out = np.zeros((frames, len(COLUMNS)), np.float32)
    begin_s, over_s = (first + 1) * FRAME_S, (first + frames) * FRAME_S
    told = [one for one in events if one.kind in KINDS and one.end_s > begin_s and one.start_s <= over_s + 1e-9]
    times_s = (first + 1 + np.arange(frames)) * FRAME_S
    for event in sorted(told, key=lambda one: one.start_s):
        since_s = times_s - event.start_s
        rows = np.flatnonzero((since_s >= -1e-9) & (since_s < event.duration_s - 1e-9))
        since_s = np.maximum(since_s[rows], 0.0)
        over = np.minimum(since_s / event.duration_s, 1.0)
        at = _EACH * KINDS.index(event.kind)
        out[rows, at] = 1.0
        out[rows, at + 1] = np.minimum(np.log1p(since_s / _SOFT_S), BOUND)
        out[rows, at + 2] = over
        out[rows, at + 3] = min(abs(event.size) / FULL_SIZE.get(event.kind, 1.0), BOUND)
        if event.kind in SWINGING:
            # After the columns of all kinds: the phase of the swing.
            at = _EACH * len(KINDS) + 2 * SWINGING.index(event.kind)
            turn = 2 * np.pi * event.swings * over
            out[rows, at], out[rows, at + 1] = np.sin(turn), np.cos(turn)
    return out


def since_s(told: Floats) -> Doubles:
    """Return the elapsed time [s] of events from column `since` (...,), at most 10.7."""
    return _SOFT_S * np.expm1(told.astype(np.float64))
