"""Face-track files: CSV (also gzipped), read as motion in our units and axes.

Columns go by name, in any case, so the column order of the Live Link app, of its UDP packet, of Apple's header and of
MediaPipe all read the same. Head pose columns carry their unit in the name (`headYaw_deg`, `x_m`, ...); without one
they are radians and metres. Axes of other sources are turned into ours.

A row of NaN means: no face was seen.
"""

from __future__ import annotations

import csv
import gzip
import io
import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    BLENDSHAPES,
    BLINKS,
    CHANNEL_INDEX,
    CHANNELS,
    FRAME_HZ,
    MOTION_DIM,
    SHAPES,
    Doubles,
    Floats,
)

logger = logging.getLogger(__name__)


# Sources turn yaw first, then pitch, then roll, about up, left and forward: R = Rz(yaw) Ry(pitch) Rx(roll), and so do
# we. A source whose columns begin with "head" measures from a camera: x to the viewer's right, y up, z to the viewer.
# Of MediaPipe that is proved (R = Ry(yaw) Rx(pitch) Rz(roll) of the face transform), of Live Link it is not: in
# think-biq/LLV @ 07ec14c examples/dao.gesichter the eyes turn against HeadYaw (r = -0.95 with the look-left channels),
# as they do when a face keeps looking at its phone, a hint that + is own left.
_FROM_CAMERA: Final = {"z": "x", "x": "y", "y": "z"}  # its axis -> ours

_UNITS: Final = {"deg": math.pi / 180, "rad": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
_POSE_COLUMN: Final = re.compile(r"(head)?_?(yaw|pitch|roll|x|y|z)(?:_(deg|rad|m|cm|mm))?")
_TIME_COLUMNS: Final = {
    "timecode": 0.0,
    "t_s": 1.0,
    "time_s": 1.0,
    "time": 1.0,
    "t": 1.0,
    "t_ms": 1e-3,
    "time_ms": 1e-3,
}
_SHAPE_BY_KEY: Final = {name.lower(): name for name in BLENDSHAPES}
_LONGEST_GAP_S: Final = 0.25  # rows further apart than this have a lost face between them
_USUAL_STEP_S: Final = (1e-3, 2.0)  # beyond these a time column is in another unit
_ANGLES: Final = ("roll", "pitch", "yaw")
_PLACE: Final = slice(CHANNEL_INDEX["x"], CHANNEL_INDEX["z"] + 1)
# Lowest and highest value, and the problem of one beyond: most likely it is in another unit.
_RANGES: Final[Mapping[str, tuple[float, float, str]]] = {
    **dict.fromkeys(
        _ANGLES, (-2 * math.pi, 2 * math.pi, "is more than a turn: in degrees? (_deg at the column's name)")
    ),
    **dict.fromkeys(("x", "y", "z"), (-10.0, 10.0, "is more than 10 m: in cm or mm? (_cm at the column's name)")),
}
_SHAPE_RANGE: Final = (-0.5, 2.0, "is not a blendshape (0 to 1)")  # a tracker may overshoot 0..1, and is clipped
_TIME_EPS_S: Final = 1e-6


@dataclass(frozen=True)
class Track:
    """A face over time.

    Attributes:
        times_s: (N,) increasing.
        motion: (N, 58) radians, metres, 0..1; a row of NaN where no face was seen.
        known: names of the channels the file had; the others are 0.
    """

    times_s: Doubles
    motion: Floats
    known: frozenset[str]

    @property
    def duration_s(self) -> float:
        """Time of the last row."""
        return float(self.times_s[-1]) if len(self.times_s) else 0.0


def read_track(path: Path | str) -> Track:
    """Read a face track; its axes are recognised by the header.

    Raises ConfigError, in one line with file, row and column, for a file that cannot be used: ragged rows, cells
    divided by something else than commas, values or times that are in another unit.
    """
    file = Path(path)
    header, rows = csv_cells(file)
    if len(header) == 1 and (other := next((mark for mark in (";", "\t") if mark in header[0]), None)):
        raise ConfigError(f"{file}: its cells are divided by {other!r}, a comma is needed")
    from_camera = any(match and match[1] for match in map(_POSE_COLUMN.fullmatch, map(str.lower, header)))
    columns = _columns(file, header, _FROM_CAMERA if from_camera else {})
    time_column = next((index for index, name in enumerate(header) if name.lower() in _TIME_COLUMNS), None)
    if time_column is None:
        raise ConfigError(f"{file}: no column tells the time (Timecode, t_s, time_s, t_ms, time_ms)")
    rows = _even(file, header, rows, time_column)

    motion = np.zeros((len(rows), MOTION_DIM))
    for channel, (index, factor) in columns.items():
        cells = [row[index].strip() for row in rows]
        lost = [cell == "" or cell.lower() == "nan" for cell in cells]
        values = factor * np.where(lost, np.nan, csv_numbers(file, header[index], np.where(lost, "0", cells)))
        low, high, problem = _RANGES.get(channel, _SHAPE_RANGE)
        outside = np.flatnonzero((values < low) | (values > high))
        if len(outside):
            row = int(outside[0])
            raise ConfigError(f"{file}: row {row + 2}, column {header[index]} = {cells[row]} {problem}")
        motion[:, CHANNEL_INDEX[channel]] = values
    motion[np.isnan(motion).any(axis=1)] = np.nan
    if from_camera and np.isfinite(motion[:, 0]).any():
        motion[:, _PLACE] -= np.nanmedian(motion[:, _PLACE], axis=0)
    motion[:, SHAPES] = np.clip(motion[:, SHAPES], 0.0, 1.0)
    times_s = _times(file, header[time_column], [row[time_column].strip() for row in rows])
    return Track(times_s, motion.astype(np.float32), frozenset(columns))


def write_track(path: Path | str, track: Track) -> None:
    """Write a track in our own axes; gzipped when the name ends in `.gz`. An unseen face becomes empty cells."""
    units = dict.fromkeys(_ANGLES, "_rad") | dict.fromkeys(("x", "y", "z"), "_m")
    names = [name for name in CHANNELS if name in track.known]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time_s", *(name + units.get(name, "") for name in names)])
    picked = track.motion[:, [CHANNEL_INDEX[name] for name in names]]
    for time_s, row in zip(track.times_s, picked, strict=True):
        writer.writerow([f"{time_s:.4f}", *("" if math.isnan(v) else f"{v:.4f}".rstrip("0").rstrip(".") for v in row)])
    data = text.getvalue().encode()
    # No time stamp in the gzip header: the same track gives the same bytes.
    Path(path).write_bytes(gzip.compress(data, mtime=0) if str(path).endswith(".gz") else data)


def resample(track: Track, rate_hz: float = FRAME_HZ, start_s: float = 0.0) -> Track:
    """Return the track at start_s, start_s + 1/rate_hz, ... up to its last row.

    Linear in time; a blink takes its maximum over the interval that ends at the instant, so that none falls between
    frames. NaN before the first row and wherever a neighbour is NaN or more than 0.25 s away.
    """
    count = max(0, math.floor((track.duration_s - start_s) * rate_hz + _TIME_EPS_S * rate_hz) + 1)
    grid_s = start_s + np.arange(count) / rate_hz
    if not len(track.times_s) or not count:
        return Track(grid_s, np.full((count, MOTION_DIM), np.nan, dtype=np.float32), track.known)
    return Track(grid_s, _interpolated(track, grid_s, 1.0 / rate_hz), track.known)


def _interpolated(track: Track, grid_s: Doubles, interval_s: float) -> Floats:
    times_s, last = track.times_s, len(track.times_s) - 1
    after = np.clip(np.searchsorted(times_s, grid_s - _TIME_EPS_S), 0, last)
    before = np.where(times_s[after] <= grid_s + _TIME_EPS_S, after, np.maximum(after - 1, 0))
    gap_s = times_s[after] - times_s[before]
    weight = np.where(gap_s > 0, (grid_s - times_s[before]) / np.where(gap_s > 0, gap_s, 1.0), 0.0)[:, None]
    low, high = track.motion[before], track.motion[after]
    out = np.where(weight <= 0, low, low + weight * (high - low))
    outside = (grid_s < times_s[0] - _TIME_EPS_S) | (grid_s > times_s[-1] + _TIME_EPS_S)
    out[outside | (gap_s > _LONGEST_GAP_S)] = np.nan
    first = np.searchsorted(times_s, grid_s - interval_s + _TIME_EPS_S)
    end = np.searchsorted(times_s, grid_s + _TIME_EPS_S)
    for row in np.flatnonzero((end > first) & np.isfinite(out[:, 0])):
        window = track.motion[first[row] : end[row], BLINKS]
        out[row, BLINKS] = np.fmax(out[row, BLINKS], np.fmax.reduce(window, axis=0))
    return out.astype(np.float32)


# --- the parts of reading ---------------------------------------------------------------------------------------


def csv_cells(file: Path) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows that are not empty, of a CSV file that may be gzipped. Raises ConfigError."""
    try:
        data = file.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
        rows = [row for row in csv.reader(io.StringIO(data.decode("utf-8-sig"))) if row]
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, EOFError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{file}: cannot be read as a CSV text: {error}") from error
    if len(rows) < 2:
        raise ConfigError(f"{file}: holds no rows: " + ("only a header" if rows else "the file is empty"))
    return [cell.strip() for cell in rows[0]], rows[1:]


def _even(file: Path, header: Sequence[str], rows: list[list[str]], time_column: int) -> list[list[str]]:
    """Return rows as long as the header; an incomplete last row is left out.

    A row that ends with its time, or with a count of 0 after it, has lost the face: Live Link writes such rows.
    """
    lost = [""] * (len(header) - time_column - 1)
    ends = time_column + 1
    rows = [[*row[:ends], *lost] if len(row) == ends or row[ends:] == ["0"] else row for row in rows]
    if len(rows) > 1 and len(rows[-1]) < len(header):
        logger.warning("%s: its last row is cut off and left out", file)
        rows = rows[:-1]
    for number, row in enumerate(rows):
        if len(row) != len(header):
            raise ConfigError(f"{file}: row {number + 2} has {len(row)} cells, the header has {len(header)}")
    return rows


def _columns(file: Path, header: Sequence[str], moved: Mapping[str, str]) -> dict[str, tuple[int, float]]:
    """Return the column of each of our channels in the file, and its factor to our unit."""
    columns: dict[str, tuple[int, float]] = {}
    for index, name in enumerate(header):
        channel, factor = _SHAPE_BY_KEY.get(name.lower()), 1.0
        if channel is None:
            match = _POSE_COLUMN.fullmatch(name.lower())
            if match is None:
                continue
            axis, unit = match[2], match[3] or "rad"
            if match[3] and (axis in _ANGLES) != (unit in ("deg", "rad")):
                choices = ("_deg, _rad for angles, _m, _cm, _mm for positions",)
                raise ConfigError.at(file, "column", name, "has a unit that does not fit", choices)
            channel, factor = moved.get(axis, axis), _UNITS[unit]
        if channel in columns:
            raise ConfigError.at(file, "column", name, f"gives {channel} a second time")
        columns[channel] = (index, factor)
    if not columns:
        names = "ARKit names such as eyeBlinkLeft, jawOpen; head pose such as headYaw_deg, pitch_rad, x_m"
        raise ConfigError(f"{file}: no column is a face channel ({names})")
    return columns


def csv_numbers(file: Path, column: str, cells: Iterable[str]) -> Doubles:
    """Return the numbers of a column, one row after the other from row 2 on. Raises ConfigError for another cell."""
    numbers = []
    for row, cell in enumerate(cells, 2):
        try:
            number = float(cell)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ConfigError(f"{file}: row {row}, column {column} = {str(cell)!r} is not a number")
        numbers.append(number)
    return np.array(numbers)


def _times(file: Path, name: str, cells: Sequence[str]) -> Doubles:
    """Return seconds (N,): as written, or from the first row for a time of day and for a clock that began long ago."""
    factor = _TIME_COLUMNS[name.lower()]
    times_s = factor * csv_numbers(file, name, cells) if factor else _timecodes(file, name, cells)
    steps_s = np.diff(times_s)
    backwards = np.flatnonzero(steps_s <= 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        problem = f"is not later than the row before ({cells[row - 1]!r})"
        raise ConfigError(f"{file}: row {row + 2}, column {name} = {cells[row]!r} {problem}")
    if len(steps_s) and not _USUAL_STEP_S[0] <= (usual_s := float(np.median(steps_s))) <= _USUAL_STEP_S[1]:
        unit = "milliseconds: call it t_ms" if usual_s > 1 else "seconds: call it t_s"
        raise ConfigError(f"{file}: column {name}: its rows are {usual_s:g} s apart; are they {unit}?")
    return times_s - times_s[0] if not factor or times_s[0] > 1e6 else times_s


def _timecodes(file: Path, name: str, cells: Sequence[str]) -> Doubles:
    """Return seconds (N,) of HH:MM:SS:FF.fff. FF counts 60 a second in the Live Link app for any rate of the rows.

    Other writers count 24, 25 or 30, which the file shows: a take that holds one whole second has nearly all counts.
    """
    fields = [cell.split(":") for cell in cells]
    for row, each in enumerate(fields, 2):
        if len(each) != 4:
            raise ConfigError(f"{file}: row {row}, column {name} = {':'.join(each)!r} is not HH:MM:SS:FF.fff")
    hours, minutes, seconds, frames = (csv_numbers(file, name, column) for column in zip(*fields, strict=True))
    whole_s = 3600.0 * hours + 60.0 * minutes + seconds
    whole_s += 86_400.0 * np.cumsum(np.diff(whole_s, prepend=whole_s[0]) < -43_200)  # a take across midnight
    counts = 60
    if whole_s[-1] - whole_s[0] >= 2 and frames.max() < 30:
        counts = next(base for base in (24, 25, 30) if frames.max() < base)
    times_s: Doubles = whole_s + frames / counts
    return times_s


@dataclass(frozen=True)
class Take:
    """A stretch without a lost face. `motion` (N, 58) at 25 fps, radians, metres, 0..1."""

    name: str
    motion: Floats


def face_stretches(file: Path, name: str) -> list[Take]:
    """Return the stretches of a face track in which a face was seen. Raises ConfigError."""
    return stretches(resample(read_track(file), FRAME_HZ).motion, name)


def folder_takes(folder: Path) -> list[Take]:
    """Return every face track (CSV, CSV.gz) below `folder`.

    Raises ConfigError when there is none or one cannot be read.
    """
    files = sorted([*folder.rglob("*.csv"), *folder.rglob("*.csv.gz")])
    if not files:
        raise ConfigError(f"--data {str(folder)!r}: no face tracks (*.csv, *.csv.gz) below it")
    return [take for file in files for take in face_stretches(file, str(file.relative_to(folder)))]


def stretches(motion: Floats, name: str) -> list[Take]:
    """Return the parts of `motion` (N, 58) without gaps (rows that are not finite)."""
    known = np.isfinite(motion).all(axis=1)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [Take(name, motion[first:last]) for first, last in zip(ends[::2], ends[1::2], strict=True)]
