"""A plain table of nod rates by speech phase: the least that a listener's timing has to be compared with.

A cell is where the others are in their talk: in a phrase, by how long it has lasted; or silent, by how long; either by
the length of the phrase before. Its rate is nods over minutes, drawn toward the mean where minutes are few. Counts are
kept by series of meetings, so that nobody is judged by a table that has seen him.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import yaml
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
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


@dataclass(frozen=True)
class NodTable:
    """Counts by series of meetings."""

    series: Mapping[str, Counts]

    def rates_for(self, series: str) -> Doubles:
        """Nods a minute (CELLS,) for people of a series, from all the others; from all when there are no others."""
        others = [counts for name, counts in self.series.items() if name != series]
        return Counts.total(others or self.series.values()).rates()


def save(file: Path, table: NodTable, comment: str) -> None:
    """Write the table as YAML below a comment of any lines. Raises ConfigError when that fails."""
    listed = {
        name: {"nods": counts.nods.astype(int).tolist(), "minutes": np.round(counts.minutes, 3).tolist()}
        for name, counts in sorted(table.series.items())
    }
    edges = {"speech_s": list(SPEECH_S), "silence_s": list(SILENCE_S), "last_phrase_s": list(LAST_S)}
    text = yaml.safe_dump({"edges": edges, "series": listed}, sort_keys=False, width=110, default_flow_style=None)
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    try:
        file.write_text(head + text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror}") from error


def load(file: Path) -> NodTable:
    """Read what `save` wrote. Raises ConfigError naming the file and what is wrong."""
    try:
        read = yaml.safe_load(file.read_text(encoding="utf-8"))
        edges = tuple(tuple(read["edges"][key]) for key in ("speech_s", "silence_s", "last_phrase_s"))
        series = {
            str(name): Counts(np.array(row["nods"], np.float64), np.array(row["minutes"], np.float64))
            for name, row in read["series"].items()
        }
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{file}: not a table of nod rates: {str(error).splitlines()[0]}") from error
    if edges != (SPEECH_S, SILENCE_S, LAST_S):
        raise ConfigError(f"{file}: edges = {edges} are not those of this version ({SPEECH_S}, {SILENCE_S}, {LAST_S})")
    for name, counts in series.items():
        for what, values in (("nods", counts.nods), ("minutes", counts.minutes)):
            if values.shape != (CELLS,) or not np.isfinite(values).all() or (values < 0).any():
                raise ConfigError(f"{file}: series.{name}.{what}: needs {CELLS} numbers of 0 or more")
    if not series:
        raise ConfigError(f"{file}: series: holds no meetings")
    return NodTable(series)
