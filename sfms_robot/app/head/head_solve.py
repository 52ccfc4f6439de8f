"""`head solve`: a table of head poses -> the joints of a head's neck."""

from __future__ import annotations

import csv
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from sfms_robot.config import find, load_head
from sfms_robot.data import head_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles
from sfms_robot.retarget.head_retargeter import build_neck

POSE_COLUMNS = ("roll_rad", "pitch_rad", "yaw_rad", "x_m", "y_m", "z_m")  # in the order of a pose
BODY_COLUMN = "body_yaw_rad"
_FARTHEST = 1e6  # rad or m: squares must not overflow

log = logging.getLogger(__name__)


def solve_poses(head_name: str, file: Path) -> dict[str, Any]:
    """Solve every row of a CSV file, a pose that is held, for a head by name or folder.

    Returns the joints of the neck, and for each pose their angles [rad], whether it is reached, and what is missing.

    Raises ConfigError for a head without a neck, and for a file that lacks a column, a row or a number.
    """
    head = load_head(head_name)
    if head.kinematics is None:
        file = find("heads", head_name, "head.yaml") / "head.yaml"
        with_neck = [name for name in head_names() if load_head(name).kinematics]
        raise ConfigError.at(file, "name", head.name, "has no kinematics", with_neck)
    neck = build_neck(head.kinematics, head.joints)
    poses, body_yaw_rad = read_poses(file)
    if body_yaw_rad is not None and not neck.turns_body:
        if body_yaw_rad.any():
            raise ConfigError(f"{file}: {BODY_COLUMN}: head {head.name!r} has no joint that turns its body")
        body_yaw_rad = None
    solved = neck.solve(poses, body_yaw_rad)
    keys = ("angles_rad", "reached", "residual_rad", "residual_m")
    rows = zip(*(getattr(solved, key).tolist() for key in keys), strict=True)
    found = [dict(zip(keys, row, strict=True)) for row in rows]
    return {"version": 1, "head": head.name, "joints": list(neck.joints), "poses": found}


def read_poses(file: Path) -> tuple[Doubles, Doubles | None]:
    """Read poses (N, 6) and body yaws (N,), None without that column. Other columns are named in the log."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream)
            columns = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = columns
            rows = list(reader)
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    wanted = [*POSE_COLUMNS, BODY_COLUMN] if BODY_COLUMN in columns else list(POSE_COLUMNS)
    if missing := [name for name in POSE_COLUMNS if name not in columns]:
        raise ConfigError(f"{file}: no column {', '.join(missing)} (has {', '.join(columns) or 'none'})")
    if twice := [name for name in wanted if columns.count(name) > 1]:
        raise ConfigError(f"{file}: column {', '.join(twice)} is there twice")
    if longer := [line for line, row in enumerate(rows, 2) if None in row]:
        raise ConfigError(f"{file}:{longer[0]}: has more cells than the header has columns ({len(columns)})")
    if not rows:
        raise ConfigError(f"{file}: no poses, only a header")
    if unused := [name for name in columns if name not in wanted]:
        log.warning("%s: columns not used: %s", file, ", ".join(unused))
    numbers = np.array([[_number(row, name, line, file) for name in wanted] for line, row in enumerate(rows, 2)])
    return numbers[:, :6], numbers[:, 6] if BODY_COLUMN in columns else None


def _number(row: dict[str, str | None], column: str, line: int, file: Path) -> float:
    text = row[column]
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError.at(f"{file}:{line}", column, text, "is not a number")
    if abs(number) > _FARTHEST:
        raise ConfigError.at(f"{file}:{line}", column, number, f"is out of all bounds (at most {_FARTHEST:g})")
    return number
