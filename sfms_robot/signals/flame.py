"""FLAME expression -> ARKit blendshapes, with a matrix that the user brings.

The matrix goes the other way, one row of FLAME coefficients per blendshape: weights @ matrix = coefficients. Such
matrices are badly conditioned (rows of rare shapes are huge), so it is not inverted. The weights are those within 0..1
that come nearest, with a small price on their size and on left and right being different. Gaze is not in FLAME's
expression: its channels stay 0. The jaw's own rows are left to the jaw pose.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, ORDERS, Doubles
from sfms_robot.signals.bounded import bounded_least_squares

COEFFICIENTS: Final = 50  # the first ones, those that deca56 has
_SIZE_PRICE: Final = 0.02  # of the matrix's own scale
_SIDES_PRICE: Final = 0.05
_JAW: Final = BLENDSHAPES.index("jawOpen")
_FIXED_AT_0: Final = [i for i, name in enumerate(BLENDSHAPES) if name.startswith("eyeLook")]
_SIDES: Final = [
    (i, BLENDSHAPES.index(name.removesuffix("Left") + "Right"))
    for i, name in enumerate(BLENDSHAPES)
    if name.endswith("Left") and name.removesuffix("Left") not in ("jaw", "mouth") and not name.startswith("eyeLook")
]


@dataclass(frozen=True)
class FlameMatrix:
    """`rows` (52, 50): FLAME coefficients of every blendshape at 1, in the order of `frames.BLENDSHAPES`."""

    rows: Doubles

    def solve(self, expression: Doubles, jaw_open: Doubles | None = None) -> Doubles:
        """Coefficients (N, 50) -> blendshapes (N, 52) within 0..1; jaw_open (N,) 0..1 is taken as it is."""
        scale = float(np.sqrt((self.rows**2).sum(axis=1).mean()))
        sides = np.zeros((len(_SIDES), len(BLENDSHAPES)))
        for row, (left, right) in enumerate(_SIDES):
            sides[row, left], sides[row, right] = 1.0, -1.0
        prices = np.concatenate([_SIZE_PRICE * np.eye(len(BLENDSHAPES)), _SIDES_PRICE * sides]) * scale
        wanted = np.concatenate([expression, np.zeros((len(expression), len(prices)))], axis=1)
        low, high = np.zeros((len(expression), len(BLENDSHAPES))), np.ones((len(expression), len(BLENDSHAPES)))
        high[:, _FIXED_AT_0] = 0.0
        if jaw_open is not None:
            low[:, _JAW] = high[:, _JAW] = jaw_open
        return bounded_least_squares(np.concatenate([self.rows.T, prices]), wanted, low, high)


def read_matrix(file: Path, order: str = "alphabetical") -> FlameMatrix:
    """A matrix of one row per blendshape and at least 50 columns; further columns (up to 100, jaw, eyes) are left out.

    .npy: rows in the named order of `frames.ORDERS`. .csv: the same, or each row begins with the blendshape's name.
    Raises ConfigError for what cannot be used.
    """
    if order not in ORDERS:
        raise ConfigError(f"order {order!r} is not known ({', '.join(ORDERS)})")
    names, values = _npy(file, order) if file.suffix == ".npy" else _csv(file, order)
    if values.ndim != 2 or values.shape[1] < COEFFICIENTS:
        raise ConfigError(f"{file}: is {values.shape}, not a row of at least {COEFFICIENTS} per blendshape")
    if len(values) != len(names):
        raise ConfigError(f"{file}: has {len(values)} rows, order {order!r} has {len(names)}")
    if not np.isfinite(values).all():
        raise ConfigError(f"{file}: row {names[int(np.argwhere(~np.isfinite(values))[0, 0])]} is not finite")
    rows = np.zeros((len(BLENDSHAPES), COEFFICIENTS))
    for name, row in zip(names, values, strict=True):
        if name in BLENDSHAPES:
            rows[BLENDSHAPES.index(name)] = row[:COEFFICIENTS]
    if not rows.any():
        raise ConfigError(f"{file}: holds nothing but zeros")
    return FlameMatrix(rows)


def _npy(file: Path, order: str) -> tuple[tuple[str, ...], Doubles]:
    try:
        return ORDERS[order], np.asarray(np.load(file, allow_pickle=False), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read as a matrix: {error}") from error


def _csv(file: Path, order: str) -> tuple[tuple[str, ...], Doubles]:
    try:
        with file.open(encoding="utf-8", newline="") as text:
            cells = [row for row in csv.reader(text) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{file}: cannot be read as a CSV text: {error}") from error
    names = ORDERS[order]
    if cells and cells[0][0] in (*BLENDSHAPES, "_neutral"):
        names = tuple(row[0] for row in cells)
        unknown = [name for name in names if name not in (*BLENDSHAPES, "_neutral")]
        if unknown or len(set(names)) < len(names):
            wrong = unknown[0] if unknown else next(name for name in names if names.count(name) > 1)
            problem = "is not a blendshape" if unknown else "is given twice"
            raise ConfigError.at(file, "row", wrong, problem, BLENDSHAPES if unknown else ())
        cells = [row[1:] for row in cells]
    try:
        return names, np.array(cells, dtype=np.float64)
    except ValueError as error:
        raise ConfigError(f"{file}: not a matrix of numbers: {error}") from error
