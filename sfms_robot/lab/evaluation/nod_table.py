"""A plain table of nod rates by speech phase: the least that a listener's timing has to be compared with.

A cell is where the others are in their talk: in a phrase, by how long it has lasted; or silent, by how long; either by
the length of the phrase before. Its rate is nods over minutes, drawn toward the mean where minutes are few.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import FRAME_HZ, Doubles

SPEECH_S: Final = (1.0, 2.0, 4.0, 8.0)  # edges of the cells
SILENCE_S: Final = (0.4, 0.8, 1.2)
LAST_S: Final = (1.0, 3.0)
PRIOR_NODS: Final = 5.0  # at the mean rate, in every cell
_LASTS: Final = len(LAST_S) + 1
_SILENT: Final = len(SILENCE_S) + 1
CELLS: Final = (_SILENT + len(SPEECH_S) + 1) * _LASTS

Ints = NDArray[np.int64]


def cells(times_s: Doubles) -> Ints:
    """Speech phase (N, 3) (`signals.phase.times`) -> cell (N,), 0 to CELLS - 1: silence first, then speech."""
    speech, silence, last = times_s.T
    row = np.where(speech > 0, _SILENT + np.digitize(speech, SPEECH_S), np.digitize(silence, SILENCE_S))
    return np.asarray(row * _LASTS + np.digitize(last, LAST_S), np.int64)


@dataclass(frozen=True)
class Counts:
    """Nod onsets (CELLS,) and minutes (CELLS,) of listening."""

    nods: Doubles
    minutes: Doubles

    @classmethod
    def of(cls, cell: Ints, onsets: Ints, listening: NDArray[np.bool_]) -> Counts:
        """From cells (N,), the frames of nod onsets, and listening time (N,); onsets outside of it do not count."""
        inside = onsets[(onsets >= 0) & (onsets < len(cell))]
        inside = inside[listening[inside]]
        return cls(
            np.bincount(cell[inside], minlength=CELLS).astype(np.float64),
            np.bincount(cell[listening], minlength=CELLS) / FRAME_HZ / 60,
        )

    @classmethod
    def total(cls, parts: Iterable[Counts]) -> Counts:
        """The sum; all zero of nothing."""
        every = [cls(np.zeros(CELLS), np.zeros(CELLS)), *parts]
        return cls(np.sum([part.nods for part in every], axis=0), np.sum([part.minutes for part in every], axis=0))

    def rates(self) -> Doubles:
        """Nods a minute (CELLS,), all the same when there is nothing to tell them apart."""
        nods, minutes = float(self.nods.sum()), float(self.minutes.sum())
        if not nods or not minutes:
            return np.zeros(CELLS)
        return np.asarray((self.nods + PRIOR_NODS) / (self.minutes + PRIOR_NODS * minutes / nods))
