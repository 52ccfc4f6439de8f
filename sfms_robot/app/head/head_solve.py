"""`head solve`: a table of head poses -> the joints of a head's neck."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from sfms_robot.config import load_head
from sfms_robot.data import Report, head_file, head_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles
from sfms_robot.retarget.head_retargeter import build_neck
from sfms_robot.signals.face_tables import csv_cells, csv_numbers

POSE_COLUMNS = ("roll_rad", "pitch_rad", "yaw_rad", "x_m", "y_m", "z_m")  # columns in the order of a pose
BODY_COLUMN = "body_yaw_rad"
_FARTHEST = 1e6  # rad or m: squares must not overflow

log = logging.getLogger(__name__)


def solve_poses(head_name: str, file: Path) -> Report:
    """Solve every row of a CSV file, which is a pose that is held, for a head by name or folder.

    Returns the joints of the neck, and for each pose their angles [rad], whether it is reached, and the residual.

    Raises ConfigError for a head without a neck, and for a file that lacks a column, a row or a number.
    """
    head = load_head(head_name)
    if head.kinematics is None:
        with_neck = [name for name in head_names() if load_head(name).kinematics]
        raise ConfigError.at(head_file(head_name), "name", head.name, "has no kinematics", with_neck)
    neck = build_neck(head.kinematics, head.joints)
    poses, body_yaw_rad = read_poses(file)
    if body_yaw_rad is not None and not neck.turns_body:
        if body_yaw_rad.any():
            raise ConfigError(f"{file}: {BODY_COLUMN}: head {head.name!r} has no joint that turns its body")
        body_yaw_rad = None
    solved = neck.solve(poses, body_yaw_rad)
    keys = ("angles_rad", "reached", "residual_rad", "residual_m")
    rows = zip(*(getattr(solved, key).tolist() for key in keys), strict=True)
    return {
        "version": 1,
        "head": head.name,
        "joints": list(neck.joints),
        "poses": [dict(zip(keys, row, strict=True)) for row in rows],
    }


def read_poses(file: Path) -> tuple[Doubles, Doubles | None]:
    """Read poses (N, 6) and body yaws (N,), None without that column. Other columns are named in the log."""
    header, rows = csv_cells(file)
    wanted = [*POSE_COLUMNS, BODY_COLUMN] if BODY_COLUMN in header else list(POSE_COLUMNS)
    if missing := [name for name in POSE_COLUMNS if name not in header]:
        raise ConfigError(f"{file}: no column {', '.join(missing)} (has {', '.join(header)})")
    if twice := [name for name in wanted if header.count(name) > 1]:
        raise ConfigError(f"{file}: column {', '.join(twice)} is there twice")
    if uneven := [number for number, row in enumerate(rows, 2) if len(row) != len(header)]:
        raise ConfigError(f"{file}: row {uneven[0]}: expected {len(header)} cells, as many as the header has")
    if unused := [name for name in header if name not in wanted]:
        log.warning("%s: columns not used: %s", file, ", ".join(unused))
    numbers = np.stack([csv_numbers(file, name, [row[header.index(name)] for row in rows]) for name in wanted], axis=1)
    if np.abs(numbers).max() > _FARTHEST:
        raise ConfigError(f"{file}: a number is out of all bounds (at most {_FARTHEST:g} rad or m)")
    return numbers[:, :6], numbers[:, 6] if BODY_COLUMN in header else None
