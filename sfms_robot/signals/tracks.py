"""Face-track files: CSV (also gzipped), JSON and OpenFace's tables, read as motion in our units and axes.

Columns are found by name (`face_units.channel_of`), so the column orders of the Live Link app, its UDP packet, Apple's
header and MediaPipe are all accepted. Head pose columns have the unit in their name (`headYaw_deg`, `x_m`, ...). If it
is missing, angles are radians or degrees, decided by what a head can do, and places are metres. Axes of other sources
are converted to ours.

A row of NaN means that no face was seen.
"""

from __future__ import annotations

import csv
import gzip
import io
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    BLINKS,
    CHANNEL_INDEX,
    CHANNELS,
    FRAME_HZ,
    MOTION_DIM,
    SHAPES,
    Doubles,
    Floats,
    clip_shapes,
)
from sfms_robot.signals.events import runs
from sfms_robot.signals.face_tables import (
    csv_cells,
    csv_numbers,
    from_openface,
    is_counted,
    is_openface,
    row_times,
    time_column,
)
from sfms_robot.signals.face_units import channel_of, expected_unit, face_bounds, pose_of, units_of, used_line

logger = logging.getLogger(__name__)


# Sources rotate by yaw first, then pitch, then roll, about up, left and forward: R = Rz(yaw) Ry(pitch) Rx(roll), as we
# do. A source whose columns begin with "head" measures from a camera: x to the viewer's right, y up, z to the viewer.
# For MediaPipe that is proved (R = Ry(yaw) Rx(pitch) Rz(roll) of the face transform), for Live Link it is not: in
# think-biq/LLV @ 07ec14c examples/dao.gesichter the eyes turn against HeadYaw (r = -0.95 with the look-left channels),
# as they do when a face keeps looking at its phone, which suggests that + is the face's own left.
_FROM_CAMERA: Final = {"z": "x", "x": "y", "y": "z"}  # the camera's axis -> ours

_UNITS: Final = {"deg": math.pi / 180, "rad": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
# Columns that are not needed: rotations of the eyes, which are in the blendshapes too, and counts.
_NOT_NEEDED: Final = re.compile(r"(left|right)eye(yaw|pitch|roll)|blendshapecount|_neutral|subject", re.IGNORECASE)
_LONGEST_GAP_S: Final = 0.25  # rows further apart than this have a lost face between them
_ANGLES: Final = ("roll", "pitch", "yaw")
_PLACE: Final = slice(CHANNEL_INDEX["x"], CHANNEL_INDEX["z"] + 1)
_MOST_TURN_RAD: Final = 2 * math.pi
_TIME_EPS_S: Final = 1e-6


class _Column(NamedTuple):
    """A column of the file. `factor`: factor to our unit; NaN for an angle whose name has no unit."""

    place: int
    factor: float


@dataclass(frozen=True)
class Track:
    """A face over time.

    Attributes:
        times_s: (N,) increasing.
        motion: (N, 58) radians, metres, 0..1; a row of NaN where no face was seen.
        known: names of the channels in the file; the others are 0.
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

    Raises ConfigError, in one line with file, row and column, for a file that cannot be used: ragged rows, values
    or times that are in another unit.
    """
    file = Path(path)
    header, rows = csv_cells(file)
    time_at = time_column(file, header)
    rows = _even(file, header, rows, time_at)
    if is_openface(header):
        header, rows = from_openface(file, header, rows)
        time_at = 0
    columns, from_camera = _columns(file, header)
    times_s = row_times(file, header[time_at], [row[time_at] for row in rows])
    once = np.diff(times_s, prepend=-np.inf) > 0
    if not once.all():
        logger.warning("%s: rows with the time of the row before are left out: %d", file, (~once).sum())

    motion = np.zeros((len(rows), MOTION_DIM))
    for channel, column in columns.items():
        cells = [row[column.place] for row in rows]
        lost = [cell == "" or cell.lower() == "nan" for cell in cells]
        values = np.where(lost, np.nan, csv_numbers(file, header[column.place], np.where(lost, "0", cells)))
        motion[:, CHANNEL_INDEX[channel]] = values if math.isnan(column.factor) else column.factor * values
    motion[np.isnan(motion).any(axis=1)] = np.nan
    motion = _in_our_units(file, motion, times_s, columns)
    low, high = face_bounds(_MOST_TURN_RAD)
    if outside := np.argwhere((motion < low) | (motion > high)).tolist():  # most likely in another unit
        row, place = outside[0]
        at = columns[CHANNELS[place]].place
        cell, unit = rows[row][at], "" if place > 5 else "; a name such as yaw_deg, x_cm has its unit"
        raise ConfigError(
            f"{file}: row {row + 2}, column {header[at]}: expected {expected_unit(place)}, got {cell}{unit}"
        )
    if from_camera and np.isfinite(motion[:, 0]).any():
        motion[:, _PLACE] -= np.nanmedian(motion[:, _PLACE], axis=0)
    clip_shapes(motion)
    return Track(times_s[once], motion[once].astype(np.float32), frozenset(columns))


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


def resample(track: Track, rate_hz: float, start_s: float = 0.0) -> Track:
    """Return the track at start_s, start_s + 1/rate_hz, ... up to its last row.

    Linear in time; a blink has its maximum over the interval that ends at the instant, so that none is lost between
    frames. NaN before the first row, and where a neighbouring row is NaN or these rows are more than 0.25 s apart.
    """
    count = max(0, math.floor((track.duration_s - start_s) * rate_hz + _TIME_EPS_S * rate_hz) + 1)
    grid_s = start_s + np.arange(count) / rate_hz
    if not len(track.times_s) or not count:
        return Track(grid_s, np.full((count, MOTION_DIM), np.nan, dtype=np.float32), track.known)
    times_s, last = track.times_s, len(track.times_s) - 1
    after = np.clip(np.searchsorted(times_s, grid_s - _TIME_EPS_S), 0, last)
    before = np.where(times_s[after] <= grid_s + _TIME_EPS_S, after, np.maximum(after - 1, 0))
    gap_s = times_s[after] - times_s[before]
    weight = np.where(gap_s > 0, (grid_s - times_s[before]) / np.where(gap_s > 0, gap_s, 1.0), 0.0)[:, None]
    low, high = track.motion[before], track.motion[after]
    out = np.where(weight <= 0, low, low + weight * (high - low))
    outside = (grid_s < times_s[0] - _TIME_EPS_S) | (grid_s > times_s[-1] + _TIME_EPS_S)
    out[outside | (gap_s > _LONGEST_GAP_S)] = np.nan
    first = np.searchsorted(times_s, grid_s - 1.0 / rate_hz + _TIME_EPS_S)
    end = np.searchsorted(times_s, grid_s + _TIME_EPS_S)
    for row in np.flatnonzero((end > first) & np.isfinite(out[:, 0])):
        window = track.motion[first[row] : end[row], BLINKS]
        out[row, BLINKS] = np.fmax(out[row, BLINKS], np.fmax.reduce(window, axis=0))
    return Track(grid_s, out.astype(np.float32), track.known)


# --- the parts of reading ---------------------------------------------------------------------------------------


def _even(file: Path, header: Sequence[str], rows: list[list[str]], time_at: int) -> list[list[str]]:
    """Return rows as long as the header; an incomplete last row is left out.

    A row that ends after its time, or after a count of 0 behind the time, has no face: Live Link writes such rows.
    """
    lost = [""] * (len(header) - time_at - 1)
    ends = time_at + 1
    rows = [[*row[:ends], *lost] if len(row) < len(header) and row[ends:] in ([], ["0"]) else row for row in rows]
    if len(rows) > 1 and len(rows[-1]) < len(header):
        logger.warning("%s: its last row is cut off and left out", file)
        rows = rows[:-1]
    for number, row in enumerate(rows):
        if len(row) != len(header):
            raise ConfigError(f"{file}: row {number + 2} has {len(row)} cells, the header has {len(header)}")
    return rows


def _columns(file: Path, header: Sequence[str]) -> tuple[dict[str, _Column], bool]:
    """Return the column of each of our channels in the file, and whether its pose is measured from a camera.

    Unused columns are named in the log.
    """
    poses = {name: pose for name in header if (pose := pose_of(name)) is not None}
    from_camera = any(camera for _, _, camera in poses.values())
    moved = _FROM_CAMERA if from_camera else {}
    columns: dict[str, _Column] = {}
    unknown = []
    for index, name in enumerate(header):
        channel, factor = channel_of(name), 1.0
        if channel is None:
            if not is_counted(name) and not _NOT_NEEDED.fullmatch(name):
                unknown.append(name)
            continue
        if name in poses:
            axis, unit, _ = poses[name]
            if unit and (axis in _ANGLES) != (unit in ("deg", "rad")):
                choices = ("_deg, _rad for angles, _m, _cm, _mm for positions",)
                raise ConfigError.at(file, "column", name, "has a unit that does not fit", choices)
            channel, factor = moved.get(axis, axis), _UNITS.get(unit, math.nan if axis in _ANGLES else 1.0)
        if channel in columns:
            raise ConfigError.at(file, "column", name, f"gives {channel} a second time")
        columns[channel] = _Column(index, factor)
    if not columns:
        names = "ARKit names such as eyeBlinkLeft, jawOpen; head pose such as headYaw_deg, pitch_rad, x_m"
        raise ConfigError(f"{file}: no column is a face channel ({names})")
    if unknown:
        logger.warning("%s: %s", file, used_line(columns, unknown))
    return columns, from_camera


def _in_our_units(file: Path, motion: Doubles, times_s: Doubles, columns: Mapping[str, _Column]) -> Doubles:
    """Return motion (N, 58) in radians and 0..1; units missing in the column names are decided over all rows."""
    is_open = np.array([name in columns and math.isnan(columns[name].factor) for name in _ANGLES])
    undecided, angles = motion.copy(), slice(0, len(_ANGLES))
    undecided[:, angles] *= is_open
    units = units_of(undecided, times_s)
    motion[:, angles] *= np.where(is_open, units.angle, 1.0)
    motion[:, SHAPES] *= units.shape
    if units.line:
        logger.warning("%s: %s, by what a head can do (names with a unit: headYaw_deg, yaw_rad)", file, units.line)
    return motion


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
    return [Take(name, motion[first:end]) for first, end in runs(np.isfinite(motion).all(axis=1))]
