"""Motion spaces of listener papers: a table of them, and conversions from them to ours and back.

`faceverse58`: 52 expression | 3 rotation, Euler x, y, z with R = Rz Ry Rx | 3 translation. Its neutral is about
(pi, 0, 0), so every rotation is relative to the neutral one.
`deca56`: 50 FLAME expression | 3 head axis-angle | 3 jaw axis-angle. FLAME's expression is not ARKit's: a matrix has to
map one to the other, and no licence lets us ship one. Without it only pose and jaw move.
`arkit58`: our own motion.

A rotation R of a space turns our head by A R A^T, where A maps the space's axes to ours (x forward, y left, z up).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    BLENDSHAPES,
    FRAME_S,
    JAW_FULL_OPEN_RAD,
    MOTION_DIM,
    ORDERS,
    POSE,
    SHAPES,
    SPACE_CHANNELS,
    Doubles,
    Floats,
    Plan,
)
from sfms_robot.signals.rotations import angles_of, from_vector, rotation


@dataclass(frozen=True, kw_only=True)
class Space:
    """One motion space; rotations in radians, translation without a metric scale.

    Attributes:
        expression, rotation: places of their numbers in a frame; also `translation` and `jaw`, if the space has them.
        euler: the rotation is three angles about the fixed axes x, y, z; otherwise it is axis-angle.
        axes: A (3, 3), rows are our x, y, z in the space's axes.
        neutral: rotation of a face that looks straight ahead, in the space's notation.
    """

    expression: slice
    rotation: slice
    translation: slice | None = None
    jaw: slice | None = None
    euler: bool = False
    axes: tuple[tuple[int, int, int], ...]
    neutral: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def matrices(self, rotations: Doubles) -> Doubles:
        """Return matrices (N, 3, 3) of rotations (N, 3) in the space's notation."""
        return rotation(rotations) if self.euler else from_vector(rotations)


# The axes of both spaces are not verified and may have to be flipped.
# FaceVerse: camera frame x to the viewer's right, y down, z away from the viewer (LizhenWangT/FaceVerse @ a012b634:
# row vectors times R transposed; so the neutral is Rx(pi)). FLAME: x to the head's left, y up, z forward.
SPACES: Final[Mapping[str, Space]] = {
    "faceverse58": Space(
        expression=slice(0, 52),
        rotation=slice(52, 55),
        translation=slice(55, 58),
        euler=True,
        axes=((0, 0, -1), (1, 0, 0), (0, -1, 0)),
        neutral=(np.pi, 0.0, 0.0),
    ),
    "deca56": Space(
        expression=slice(0, 50), rotation=slice(50, 53), jaw=slice(53, 56), axes=((0, 0, 1), (1, 0, 0), (0, 1, 0))
    ),
}


@dataclass(frozen=True)
class MotionSpace:
    """A space by its name, with the settings of a listener's configuration.

    Attributes:
        neutral: (D,) the person's face at rest in the space.
        metres_per_unit: scale of the space's translation; without it the head stays in its place.
        flame: for `deca56`, the matrix from FLAME's expression to ours.
    """

    name: str
    neutral: Doubles
    metres_per_unit: float | None = None
    flame: FlameMatrix | None = None

    @classmethod
    def of(cls, settings: config.ListenerSettings, folder: Path | None = None) -> MotionSpace:
        """Return the space of a listener; a matrix is read from its `folder`, if given: only showing motion needs it.

        Raises ConfigError if the matrix file is missing or unreadable.
        """
        matrix = None
        if settings.flame_matrix is not None and folder is not None:
            matrix = read_matrix(folder / settings.flame_matrix)
        rest = rest_of(settings.motion_space) if settings.neutral is None else np.array(settings.neutral)
        return cls(settings.motion_space, rest, settings.metres_per_unit, matrix)

    @property
    def dim(self) -> int:
        return len(SPACE_CHANNELS[self.name])

    @property
    def limitation(self) -> str | None:
        """Return the limitation of the space in one line, or None."""
        if self.name != "deca56" or self.flame is not None:
            return None
        return f"{self.name} without a matrix drives pose and jaw only: expression is not shown"

    @cached_property
    def _at_rest(self) -> tuple[Doubles, Doubles]:
        """Return A (3, 3) of the space, and A times the rotation of the face at rest.

        A head's rotation in the space is A^T R (A times rest), R being ours.
        """
        known = SPACES[self.name]
        axes = np.array(known.axes, dtype=np.float64)
        return axes, axes @ known.matrices(self.neutral[None, known.rotation])[0]

    def decode(self, frames: Floats | Doubles) -> tuple[Floats, Floats | None]:
        """Return our motion (N, 58) of frames (N, D), and the jaw (N, 3) [rad] where the space has one.

        The jaw is axis-angle in our axes, + about y lowers the chin. Blendshapes are clipped to 0..1; `limitation`
        describes what cannot be shown. Raises ValueError for frames of a space other than arkit58 that are not (N, D)
        and finite.
        """
        if self.name == "arkit58":
            shown = np.array(frames, dtype=np.float32)
            np.clip(shown[:, 6:], 0.0, 1.0, out=shown[:, 6:])
            return shown, None
        values = np.asarray(frames, dtype=np.float64)
        if values.shape[1:] != (self.dim,):
            raise ValueError(f"{self.name}: frames are {values.shape}, not (N, {self.dim})")
        if not np.isfinite(values).all():
            raise ValueError(f"{self.name}: frame {int(np.argwhere(~np.isfinite(values))[0, 0])} is not finite")
        known, (axes, upright) = SPACES[self.name], self._at_rest
        motion = np.zeros((len(values), MOTION_DIM))
        motion[:, POSE][:, :3] = angles_of(axes @ known.matrices(values[:, known.rotation]) @ upright.T)
        if known.translation is not None and self.metres_per_unit is not None:
            moved = values[:, known.translation] - self.neutral[known.translation]
            motion[:, POSE][:, 3:] = self.metres_per_unit * moved @ axes.T

        expression = values[:, known.expression]
        if known.jaw is None:  # FaceVerse's expression is ARKit's, in our order
            motion[:, SHAPES] = np.minimum(np.maximum(expression, 0.0), 1.0)
            return motion.astype(np.float32), None
        jaw_rad = values[:, known.jaw] @ axes.T
        jaw_open = np.clip(jaw_rad[:, 1] / JAW_FULL_OPEN_RAD, 0.0, 1.0)
        if self.flame is not None:
            motion[:, SHAPES] = self.flame.solve(expression, jaw_open)
        motion[:, SHAPES][:, _JAW] = jaw_open
        return motion.astype(np.float32), jaw_rad.astype(np.float32)

    def plan(self, made_at_s: float, frames: Floats) -> Plan:
        """Return frames (H, D) as the plan that follows a speaker's frame which ended at `made_at_s`."""
        motion, jaw_rad = self.decode(frames)
        return Plan(made_at_s, np.add(made_at_s, FRAME_S * np.arange(1, 1 + len(frames))), motion, jaw_rad)

    def encode(self, motion: Floats) -> Floats:
        """Return our motion (N, 58) in the space (N, D).

        Without `metres_per_unit` the translation stays at rest. In deca56 pose and jaw are written; its expression
        stays at rest, because ours cannot be written in it.
        """
        if motion.shape[-1] != MOTION_DIM:
            raise ValueError(f"motion is {motion.shape}, not (N, {MOTION_DIM})")
        if self.name == "arkit58":
            return motion
        known, (axes, upright) = SPACES[self.name], self._at_rest
        values = np.asarray(motion, dtype=np.float64)
        whole = axes.T @ rotation(values[:, POSE][:, :3]) @ upright
        out = np.tile(self.neutral, (len(values), 1))
        if known.euler:
            out[:, known.rotation] = angles_of(whole)
            out[:, known.rotation.start] %= 2 * np.pi  # about pi, not about -pi
        else:
            from scipy.spatial.transform import Rotation

            out[:, known.rotation] = Rotation.from_matrix(whole).as_rotvec()
        if known.translation is not None and self.metres_per_unit is not None:
            out[:, known.translation] += values[:, POSE][:, 3:] @ axes / self.metres_per_unit
        if known.jaw is None:
            out[:, known.expression] = values[:, SHAPES]
        else:
            opening = JAW_FULL_OPEN_RAD * values[:, SHAPES][:, _JAW]
            out[:, known.jaw] += opening[:, None] * axes[1]
        return out.astype(np.float32)


def rest_of(space: str) -> Doubles:
    """Return a face at rest (D,) that looks straight ahead."""
    out = np.zeros(len(SPACE_CHANNELS[space]))
    if space in SPACES:
        out[SPACES[space].rotation] = SPACES[space].neutral
    return out


# --- FLAME's expression as ARKit blendshapes, with a matrix that the user brings --------------------------------------
#
# The matrix has one row of FLAME coefficients per blendshape: weights @ matrix = coefficients. Such matrices are badly
# conditioned (rows of rare shapes are huge), so it is not inverted: the result is the nearest weights within 0..1, with
# a small penalty on their size and on differences of left and right. Gaze is not in FLAME's expression: its channels
# stay 0. The rows of the jaw are not used, because the jaw has a pose.

COEFFICIENTS: Final = 50  # number of coefficients of deca56, the first ones of FLAME
_SIZE_PRICE: Final = 0.02  # relative to the scale of the matrix
_SIDES_PRICE: Final = 0.05
_JAW: Final = BLENDSHAPES.index("jawOpen")
_FIXED_AT_0: Final = [i for i, name in enumerate(BLENDSHAPES) if name.startswith("eyeLook")]
_SIDES: Final = [
    (i, BLENDSHAPES.index(name.removesuffix("Left") + "Right"))
    for i, name in enumerate(BLENDSHAPES)
    if name.endswith("Left") and name.removesuffix("Left") not in ("jaw", "mouth") and not name.startswith("eyeLook")
]
_STEPS: Final = 400
_SETTLED: Final = 1e-8  # largest change of an unknown in one step


def bounded_least_squares(matrix: Doubles, wanted: Doubles, low: Doubles, high: Doubles) -> Doubles:
    """Return the x (N, n), low <= x <= high, with the least ||matrix x - wanted||^2, per row of `wanted` (N, m).

    matrix (m, n) of full column rank (add rows of a ridge where it is not); low, high (n,) or (N, n). Accelerated
    projected gradient with restarts (O'Donoghue and Candes 2015): every step is one matrix product for all N.
    """
    gram = matrix.T @ matrix
    target = wanted @ matrix  # (N, n)
    step = 1.0 / float(np.linalg.eigvalsh(gram)[-1])
    here: Doubles = np.clip(np.linalg.solve(gram, target.T).T, low, high)
    ahead, momentum = here, np.ones((len(wanted), 1))
    for _ in range(_STEPS):
        slope = ahead @ gram - target
        there: Doubles = np.clip(ahead - step * slope, low, high)
        moved = there - here
        uphill = (slope * moved).sum(axis=1, keepdims=True) > 0
        momentum = np.where(uphill, 1.0, momentum)
        following = (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        ahead = there + np.where(uphill, 0.0, (momentum - 1.0) / following) * moved
        here, momentum = there, following
        if np.abs(moved).max(initial=0.0) < _SETTLED:
            break
    return here


@dataclass(frozen=True)
class FlameMatrix:
    """FLAME coefficients of blendshapes: `rows` (52, 50), each blendshape at 1, ordered as `frames.BLENDSHAPES`."""

    rows: Doubles

    def solve(self, expression: Doubles, jaw_open: Doubles) -> Doubles:
        """Return blendshapes (N, 52), 0..1, for coefficients (N, 50); jaw_open (N,), 0..1, is kept unchanged."""
        scale = float(np.sqrt((self.rows**2).sum(axis=1).mean()))
        each, (left, right) = np.eye(len(BLENDSHAPES)), np.transpose(_SIDES)
        prices = np.concatenate([_SIZE_PRICE * each, _SIDES_PRICE * (each[left] - each[right])]) * scale
        wanted = np.concatenate([expression, np.zeros((len(expression), len(prices)))], axis=1)
        low = np.zeros((len(expression), len(BLENDSHAPES)))
        high = np.ones_like(low)
        high[:, _FIXED_AT_0] = 0.0
        low[:, _JAW] = high[:, _JAW] = jaw_open
        return bounded_least_squares(np.concatenate([self.rows.T, prices]), wanted, low, high)


def read_matrix(file: Path, order: str = "alphabetical") -> FlameMatrix:
    """Read a matrix of one row per blendshape and at least 50 columns; more (up to 100, jaw, eyes) are left out.

    .npy: rows in the named order of `frames.ORDERS`. .csv: the same, or each row begins with the blendshape's name.
    Raises ConfigError for a file that cannot be used.
    """
    if order not in ORDERS:
        raise ConfigError(f"order {order!r} is not known ({', '.join(ORDERS)})")
    names, known = ORDERS[order], (*BLENDSHAPES, "_neutral")
    try:
        if file.suffix == ".npy":
            values = np.load(file, allow_pickle=False).astype(np.float64)
        else:
            cells = np.loadtxt(file, dtype=str, delimiter=",", comments=None, encoding="utf-8", ndmin=2)
            if cells[0, 0] in known:
                names, cells = tuple(cells[:, 0].tolist()), cells[:, 1:]
            values = cells.astype(np.float64)
    except (OSError, ValueError, IndexError) as error:
        raise ConfigError(f"{file}: not a matrix of numbers: {error}") from error
    for name in names:
        if name not in known:
            raise ConfigError.at(file, "row", name, "is not a blendshape", BLENDSHAPES)
        if names.count(name) > 1:
            raise ConfigError.at(file, "row", name, "is given twice")
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
