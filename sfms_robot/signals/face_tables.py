"""Tables of faces in files: header and rows of CSV (also gzipped) and JSON, OpenFace's columns as ours, row times.

JSON is a list of frames, or an object whose first list holds the frames. A frame is `{"time_s": 0.04, "jawOpen": 0.2}`,
or has the categories that MediaPipe returns, at any depth: `{"categoryName": "jawOpen", "score": 0.2}`. MediaPipe's
transformation matrix becomes the head pose.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import logging
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.data import archive_kind
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles
from sfms_robot.signals.face_units import channel_of
from sfms_robot.signals.rotations import about, angles_of, camera_angles

logger = logging.getLogger(__name__)

Table = tuple[list[str], list[list[str]]]

_TIME_NAME: Final = re.compile(r"timecode|(?:t|time|timestamp)(?:_(s|ms|us|ns))?", re.IGNORECASE)
_TIME_UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_COUNT_NAME: Final = re.compile(r"frames?(_?(id|index|number|count))?", re.IGNORECASE)
_USUAL_STEP_S: Final = (1e-3, 2.0)  # time between rows; outside this range a time column has another unit
_MOST_DOUBLED: Final = 0.1  # share of rows with a repeated time; if there are more, the times are too coarse
_COUNTS: Final = (24, 25, 30, 48, 50, 60, 100, 120)  # frames that a timecode counts in a second
_USUAL_COUNT: Final = 60  # counts a second of the Live Link app, for any rate of its rows
_LABELS: Final = ("categoryName", "category_name")
_MATRIX: Final = re.compile(r"(facial)?_?transform(ation)?_?matri(x|ces|xes)", re.IGNORECASE)  # of MediaPipe
_LANDMARKS: Final = re.compile(r"landmark", re.IGNORECASE)  # points x, y, z in the picture, not places of the head
_LAST_ROW: Final = (0.0, 0.0, 0.0, 1.0)
_SCALED: Final = 0.1  # difference of a determinant from 1, above which a matrix is not a rotation
_DIVIDERS: Final = (",", ";", "\t")
_OPENFACE_FULL: Final = 5.0  # full intensity of an action unit
_LOST: Final = ("success", "confidence")


def is_counted(name: str) -> bool:
    """Return whether a column holds times or counts, which are not part of a face."""
    return bool(_TIME_NAME.fullmatch(name) or _COUNT_NAME.fullmatch(name))


def csv_cells(file: Path) -> Table:
    """Read the header and the rows that are not empty from a CSV or JSON file, which may be gzipped.

    Cells are divided by commas, or by semicolons or tabs, with which decimals may have a comma. Raises ConfigError.
    """
    try:
        data = file.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
        if kind := archive_kind(data):
            raise ConfigError(f"{file}: expected a face track, got an archive ({kind}): unpack it first")
        text = data.decode("utf-8-sig")
        if text.lstrip()[:1] in ("[", "{"):
            return _json_table(file, text)
        mark = max(_DIVIDERS, key=text.lstrip().partition("\n")[0].count)
        rows = [[cell.strip() for cell in row] for row in csv.reader(io.StringIO(text), delimiter=mark) if row]
        if mark != ",":  # decimals may have a comma, as in 0,5
            rows = [[cell.replace(",", ".") for cell in row] for row in rows]
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, EOFError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{file}: cannot be read as a CSV text: {error}") from error
    if len(rows) < 2:
        raise ConfigError(f"{file}: holds no rows: " + ("only a header" if rows else "the file is empty"))
    return rows[0], rows[1:]


def csv_numbers(file: Path, column: str, cells: Iterable[str]) -> Doubles:
    """Return the numbers of a column, whose first cell is in row 2. Raises ConfigError for any other cell."""
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


def _json_table(file: Path, text: str) -> Table:
    """Convert JSON frames of numbers by name to a table; a frame without a face channel has no face."""
    try:
        frames = json.loads(text)
        if isinstance(frames, dict):
            frames = next((each for each in frames.values() if isinstance(each, list)), [])
        named: list[dict[str, float]] = []
        for frame in frames:
            named.append({})
            for name, value in _named(frame):
                named[-1].setdefault(name, value)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: cannot be read as JSON: {error}") from error
    header = list(dict.fromkeys(name for each in named for name in each))
    if not header:
        example = '[{"time_s": 0.04, "jawOpen": 0.2}, ...]'
        raise ConfigError(f"{file}: expected a list of frames with numbers by name, such as {example}")
    rows = []
    for each in named:
        missing = "0" if any(map(channel_of, each)) else ""
        rows.append([str(each.get(name, missing)) for name in header])
    return header, rows


def _named(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers of a frame with their names, at any depth."""
    if isinstance(value, dict):
        label = next((value[each] for each in _LABELS if isinstance(value.get(each), str)), None)
        for key, inner in (value if label is None else {label: value.get("score")}).items():
            if _MATRIX.search(key):
                yield from _pose(key, inner)
            elif not _LANDMARKS.search(key):
                yield from _named(inner, key)
    elif isinstance(value, list):
        for inner in value:
            yield from _named(inner)
    elif name and isinstance(value, int | float) and not isinstance(value, bool):
        yield name, value


def _pose(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the head pose of a transformation matrix face -> camera [cm], by rows or by columns, of the first face.

    For another value, 0 is yielded under `name`, which is an unknown channel.
    """
    numbers = list(_numbers(value))[:16]
    if not numbers:  # no face
        return
    matrix = np.array(numbers).reshape(4, 4) if len(numbers) == 16 else np.zeros((4, 4))
    if not np.allclose(matrix[3], _LAST_ROW):
        matrix = matrix.T
    if not np.allclose(matrix[3], _LAST_ROW) or abs(np.linalg.det(matrix[:3, :3]) - 1.0) > _SCALED:
        yield name, 0.0
        return
    yield from zip(("headRoll_rad", "headPitch_rad", "headYaw_rad"), camera_angles(matrix).tolist(), strict=True)
    yield from zip(("headX_cm", "headY_cm", "headZ_cm"), matrix[:3, 3].tolist(), strict=True)


def _numbers(value: Any) -> Iterator[float]:
    """Yield the numbers of nested lists, and of the `data` of objects."""
    if isinstance(value, dict):
        yield from _numbers(value.get("data"))
    elif isinstance(value, list):
        for inner in value:
            yield from _numbers(inner)
    elif isinstance(value, int | float):
        yield float(value)


# --- Times of the rows ------------------------------------------------------------------------------------------------


def time_column(file: Path, header: Sequence[str]) -> int:
    """Return the index of the time column. Raises ConfigError if there is none."""
    for place, name in enumerate(header):
        if _TIME_NAME.fullmatch(name):
            return place
    count = next((name for name in header if _COUNT_NAME.fullmatch(name)), None)
    more = "" if count is None else f"; {count} counts: add a column time_s of {count} / frames a second"
    raise ConfigError(f"{file}: no column tells the time (Timecode, time_s, time_ms, timestamp){more}")


def row_times(file: Path, name: str, cells: Sequence[str]) -> Doubles:
    """Return the times (N,) of the rows [s], which never decrease; a repeated row has the time of the row before.

    Times are as written, or since the first row for a time of day or a clock that began long ago. Raises ConfigError.
    """
    match = _TIME_NAME.fullmatch(name)
    unit = match[1].lower() if match and match[1] else ""
    coded = name.lower() == "timecode"
    times = _timecodes(file, name, cells) if coded else csv_numbers(file, name, cells)
    steps = np.diff(times)
    if (steps < 0).any():
        row = int(np.argmax(steps < 0)) + 1
        problem = f"is not later than the row before ({cells[row - 1]!r})"
        raise ConfigError(f"{file}: row {row + 2}, column {name} = {cells[row]!r} {problem}")
    doubled = int((steps == 0).sum())
    if doubled > max(1.0, _MOST_DOUBLED * len(times)):
        raise ConfigError(f"{file}: column {name}: {doubled} of {len(times)} rows have the time of the row before")
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.04
    if not unit and not coded:
        unit = next((each for each, factor in _TIME_UNITS.items() if usual * factor <= _USUAL_STEP_S[1]), "ns")
        if unit != "s":
            logger.warning("%s: column %s is taken as %s: call it %s_%s", file, name, unit, name, unit)
    factor = _TIME_UNITS[unit or "s"]
    if not _USUAL_STEP_S[0] <= usual * factor <= _USUAL_STEP_S[1]:
        other = "milliseconds: call it t_ms" if usual * factor > 1 else "seconds: call it t_s"
        raise ConfigError(f"{file}: column {name}: its rows are {usual * factor:g} s apart; are they {other}?")
    times_s: Doubles = factor * times
    return times_s - times_s[0] if coded or times_s[0] > 1e6 else times_s


def _timecodes(file: Path, name: str, cells: Sequence[str]) -> Doubles:
    """Return seconds (N,) of HH:MM:SS:FF.fff, or of HH:MM:SS;FF, which skips counts to fit 29.97 frames a second."""
    fields = [re.split("[:;]", cell) for cell in cells]
    for row, each in enumerate(fields, 2):
        if len(each) != 4:
            raise ConfigError(f"{file}: row {row}, column {name} = {':'.join(each)!r} is not HH:MM:SS:FF.fff")
    hours, minutes, seconds, frames = (csv_numbers(file, name, column) for column in zip(*fields, strict=True))
    whole_s = 3600.0 * hours + 60.0 * minutes + seconds
    whole_s += 86_400.0 * np.cumsum(np.diff(whole_s, prepend=whole_s[0]) < -43_200)  # a take across midnight
    counts = _counts_a_second(file, name, whole_s, frames)
    if not any(";" in cell for cell in cells):
        return whole_s + frames / counts
    minute = whole_s // 60  # every minute except each tenth begins at count 2, with 60 counts a second at count 4
    return (whole_s * counts + frames - counts // 15 * (minute - minute // 10)) * 1.001 / counts


def _counts_a_second(file: Path, name: str, whole_s: Doubles, frames: Doubles) -> int:
    """Return the number of counts in a second: at its end the count falls by that number minus the step of a row.

    Raises ConfigError if three or more ends of seconds yield a number that differs from a usual one by more than 1 %
    and by more than 0.5.
    """
    steps, seconds = np.diff(frames), np.diff(whole_s)
    within, across = steps[(seconds == 0) & (steps > 0)], steps[seconds == 1]
    possible = [each for each in _COUNTS if each > math.floor(frames.max())]
    if not possible:
        raise ConfigError(f"{file}: column {name}: count {frames.max():g}: expected less than {_COUNTS[-1]}")
    if not len(within) or not len(across):
        return max(_USUAL_COUNT, possible[0])
    found = float(np.median(np.median(within) - across))
    counts = min(possible, key=lambda each: abs(each - found))
    if len(across) >= 3 and abs(counts - found) > max(0.01 * counts, 0.5):
        listed = ", ".join(map(str, _COUNTS))
        raise ConfigError(f"{file}: column {name}: expected {listed} counts a second, got {found:g}")
    return counts


# --- OpenFace ---------------------------------------------------------------------------------------------------------

# Facial action units (FACS: Ekman, Friesen and Hager 2002) and the ARKit shapes that correspond to them; a unit has
# one intensity for both sides of the face.


def _both(name: str) -> tuple[str, str]:
    return f"{name}Left", f"{name}Right"


# The comments are FACS's names of the units, which were compared with Apple's descriptions of the shapes.
SHAPES_OF_UNIT: Final[Mapping[int, tuple[str, ...]]] = {
    1: ("browInnerUp",),  # inner brow raiser
    2: _both("browOuterUp"),  # outer brow raiser
    4: _both("browDown"),  # brow lowerer
    5: _both("eyeWide"),  # upper lid raiser
    6: _both("cheekSquint"),  # cheek raiser
    7: _both("eyeSquint"),  # lid tightener
    9: _both("noseSneer"),  # nose wrinkler
    10: _both("mouthUpperUp"),  # upper lip raiser
    12: _both("mouthSmile"),  # lip corner puller
    13: ("cheekPuff",),  # cheek puffer
    14: _both("mouthDimple"),  # dimpler
    15: _both("mouthFrown"),  # lip corner depressor
    16: _both("mouthLowerDown"),  # lower lip depressor
    17: ("mouthShrugLower",),  # chin raiser
    18: ("mouthPucker",),  # lip pucker
    19: ("tongueOut",),  # tongue show
    20: _both("mouthStretch"),  # lip stretcher
    22: ("mouthFunnel",),  # lip funneler
    24: _both("mouthPress"),  # lip pressor
    26: ("jawOpen",),  # jaw drop
    28: ("mouthRollLower", "mouthRollUpper"),  # lip suck
    29: ("jawForward",),  # jaw thrust
    43: _both("eyeBlink"),  # eyes closed
    45: _both("eyeBlink"),  # blink
    61: ("eyeLookOutLeft", "eyeLookInRight"),  # eyes turn left, the person's own
    62: ("eyeLookInLeft", "eyeLookOutRight"),  # eyes turn right
    63: _both("eyeLookUp"),  # eyes up
    64: _both("eyeLookDown"),  # eyes down
}


def is_openface(header: Sequence[str]) -> bool:
    """Return whether a table is OpenFace's, with a head pose about the axes of its camera."""
    return {"pose_Rx", "pose_Ry", "pose_Rz"} <= set(header)


def from_openface(file: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Convert OpenFace's table to our columns, the time first; rows without success have no face.

    Its camera has x to the viewer's right, y down, z away, and R = Rx Ry Rz (RotationHelpers.h). Not verified on a
    recording. Intensities of 0 to 5 become 0 to 1; the place of the head is not used.
    """
    numbers = {
        name: csv_numbers(file, name, [row[place] for row in rows])
        for place, name in enumerate(header)
        if is_counted(name) or name in _LOST or re.fullmatch(r"pose_R[xyz]|AU\d+_r", name)
    }
    when = header[time_column(file, header)]
    turned = about(1, numbers["pose_Rx"]) @ about(2, -numbers["pose_Ry"]) @ about(0, -numbers["pose_Rz"])
    columns = dict(zip(("roll_rad", "pitch_rad", "yaw_rad"), angles_of(turned).T, strict=True))
    for unit, shapes in SHAPES_OF_UNIT.items():
        if (intensity := numbers.get(f"AU{unit:02d}_r")) is not None:
            columns |= dict.fromkeys(shapes, intensity / _OPENFACE_FULL)
    columns |= {
        name: each for name, each in numbers.items() if name[:2] == "AU" and int(name[2:-2]) not in SHAPES_OF_UNIT
    }
    seen = numbers.get("success", np.ones(len(rows)))
    values = np.stack(list(columns.values()), axis=1)
    table = [
        [str(time), *(map(str, row.tolist()) if ok else [""] * len(row))]
        for time, ok, row in zip(numbers[when].tolist(), seen > 0, values, strict=True)
    ]
    return [when, *columns], table
