"""The motion spaces that listener papers work in, in one table, and the way from them to ours and back.

`faceverse58`: 52 expression | 3 rotation, Euler x, y, z with R = Rz Ry Rx | 3 translation. Its neutral is about
(pi, 0, 0), so every rotation is taken against the neutral one.
`deca56`: 50 FLAME expression | 3 head axis-angle | 3 jaw axis-angle. FLAME's expression is not ARKit's: it takes a
matrix that maps one to the other, which no licence lets us ship. Without it pose and jaw move and nothing else.

A rotation R of a space turns our head by A R A^T, where A takes the space's axes to ours (x forward, y left, z up).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, MOTION_DIM, POSE, SHAPES, Doubles, Floats, reorder
from sfms_robot.signals.flame import FlameMatrix
from sfms_robot.signals.rotations import rotation as rotation_of

LOCKED: Final = 1e-7  # cosine of an angle about y from which x and z cannot be told apart
JAW_FULL_OPEN_RAD: Final = np.radians(25.0)  # jaw angle shown as jawOpen 1, as the timeline has it


@dataclass(frozen=True)
class Space:
    """One motion space.

    Attributes:
        dim: numbers per frame.
        expression, rotation: where they stand; `translation` and `jaw` where there are any.
        unit: of rotation and translation.
        euler: is the rotation three angles about the fixed axes x, y, z? Otherwise it is axis-angle.
        axes: A (3, 3), rows are our x, y, z in the space's axes.
        neutral: rotation of a face that looks straight ahead, as the space writes it.
        metres_per_unit: of the translation; None: it has no metric scale and is left out.
        verified: how the axes are known, or None: nobody has proved them; flip what turns out wrong.
    """

    name: str
    dim: int
    expression: slice
    rotation: slice
    translation: slice | None
    jaw: slice | None
    unit: str
    euler: bool
    axes: tuple[tuple[int, int, int], ...]
    neutral: tuple[float, float, float]
    metres_per_unit: float | None
    verified: str | None


# FaceVerse: camera frame x to the viewer's right, y down, z away from the viewer (LizhenWangT/FaceVerse @ a012b634:
# row vectors times R transposed; that the neutral is Rx(pi) follows). FLAME: x to the head's left, y up, z forward.
SPACES: Final[Mapping[str, Space]] = {
    "faceverse58": Space(
        "faceverse58", 58, slice(0, 52), slice(52, 55), slice(55, 58), None, "rad, no metric scale", True,
        ((0, 0, -1), (1, 0, 0), (0, -1, 0)), (np.pi, 0.0, 0.0), None, None,
    ),
    "deca56": Space(
        "deca56", 56, slice(0, 50), slice(50, 53), None, slice(53, 56), "rad", False,
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)), (0.0, 0.0, 0.0), None, None,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Decoded:
    """Frames of a space in our terms.

    Attributes:
        motion: (N, 58).
        jaw_rad: (N, 3) axis-angle in our axes, + about y lowers the chin, or None: the space has no jaw.
        missing: one line about what could not be shown, or None.
    """

    motion: Floats
    jaw_rad: Floats | None
    missing: str | None


def decode(
    frames: Floats | Doubles,
    space: str,
    *,
    neutral: Doubles | None = None,
    metres_per_unit: float | None = None,
    flame: FlameMatrix | None = None,
) -> Decoded:
    """Frames (N, dim) of the space of that name -> ours.

    neutral (dim,): the person's face at rest; by default the space's own, with the translation's median. Blendshapes
    are clipped to 0..1. Raises ConfigError for an unknown space or a flame matrix where it has no meaning, and
    ValueError for frames that are not (N, dim) and finite.
    """
    known = _space(space)
    values = np.asarray(frames, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != known.dim:
        raise ValueError(f"{space}: frames are {values.shape}, not (N, {known.dim})")
    if not np.isfinite(values).all():
        raise ValueError(f"{space}: frame {int(np.argwhere(~np.isfinite(values))[0, 0])} is not finite")
    if flame is not None and known.jaw is None:
        raise ConfigError(f"{space} already is ARKit's expression: it takes no matrix (deca56 does)")
    rest = np.asarray(known.neutral) if neutral is None else np.asarray(neutral)[known.rotation]
    axes, upright = _at_rest(space, *rest.tolist())

    motion = np.zeros((len(values), MOTION_DIM))
    motion[:, POSE][:, :3] = angles_of(axes @ _rotations(known, values[:, known.rotation]) @ upright.T)
    scale = metres_per_unit if metres_per_unit is not None else known.metres_per_unit
    if known.translation is not None and scale is not None and len(values):
        place = values[:, known.translation]
        home = np.median(place, axis=0) if neutral is None else np.asarray(neutral)[known.translation]
        motion[:, POSE][:, 3:] = scale * (place - home) @ axes.T

    if known.jaw is None:
        shapes = reorder(values[:, known.expression], "faceverse")
        motion[:, SHAPES] = np.minimum(np.maximum(shapes, 0.0), 1.0)
        return Decoded(motion.astype(np.float32), None, None)
    jaw_rad = values[:, known.jaw] @ axes.T
    jaw_open = np.clip(jaw_rad[:, 1] / JAW_FULL_OPEN_RAD, 0.0, 1.0)
    if flame is not None:
        motion[:, SHAPES] = flame.solve(values[:, known.expression], jaw_open)
    motion[:, SHAPES][:, BLENDSHAPES.index("jawOpen")] = jaw_open
    return Decoded(motion.astype(np.float32), jaw_rad.astype(np.float32), limitation(space, flame))


def encode(
    motion: Floats | Doubles,
    space: str = "faceverse58",
    *,
    neutral: Doubles | None = None,
    metres_per_unit: float | None = None,
) -> Floats:
    """Our motion (N, 58) in a space (N, dim), about `neutral` (dim,), by default the space's own: undoes `decode`.

    Without `metres_per_unit` the translation stays at rest. deca56 takes pose and jaw, its expression stays at rest:
    ours cannot be written in it. Raises ConfigError for an unknown space.
    """
    known = _space(space)
    values = np.asarray(motion, dtype=np.float64)
    rest = rest_of(space) if neutral is None else np.asarray(neutral, dtype=np.float64)
    axes, upright = _at_rest(space, *rest[known.rotation].tolist())
    whole = axes.T @ rotation_of(values[:, POSE][:, :3]) @ upright
    out = np.tile(rest, (len(values), 1))
    if known.euler:
        out[:, known.rotation] = angles_of(whole)
        out[:, known.rotation.start] %= 2 * np.pi  # about pi, not about -pi
    else:
        from scipy.spatial.transform import Rotation

        out[:, known.rotation] = Rotation.from_matrix(whole).as_rotvec()
    scale = metres_per_unit if metres_per_unit is not None else known.metres_per_unit
    if known.translation is not None and scale is not None:
        out[:, known.translation] += values[:, POSE][:, 3:] @ axes / scale
    if known.jaw is None:
        out[:, known.expression] = values[:, SHAPES]
    else:
        opening = JAW_FULL_OPEN_RAD * values[:, SHAPES][:, BLENDSHAPES.index("jawOpen")]
        out[:, known.jaw] += opening[:, None] * axes[1]
    return out.astype(np.float32)


def rest_of(space: str) -> Doubles:
    """(dim,) a face at rest that looks straight ahead. Raises ConfigError for an unknown space."""
    if space == "arkit58":  # our own
        return np.zeros(MOTION_DIM)
    known = _space(space)
    out = np.zeros(known.dim)
    out[known.rotation] = known.neutral
    return out


def limitation(space: str, flame: FlameMatrix | None) -> str | None:
    """One line about what the space cannot show, or None."""
    if space != "deca56" or flame is not None:
        return None
    return f"{space} without a matrix drives pose and jaw only: expression is not shown"


def _space(name: str) -> Space:
    if name not in SPACES:
        raise ConfigError(f"motion space {name!r} is not known ({', '.join(SPACES)})")
    return SPACES[name]


@lru_cache(maxsize=64)
def _at_rest(space: str, *rotation: float) -> tuple[Doubles, Doubles]:
    """A (3, 3) of a space, and A (3, 3) after the rotation of a face at rest as the space writes it: a head's rotation
    R is A^T R of ours, then that. Not to be changed.
    """
    known = _space(space)
    axes = np.array(known.axes, dtype=np.float64)
    return axes, axes @ _rotations(known, np.array([rotation]))[0]


def _rotations(space: Space, values: Doubles) -> Doubles:
    """(N, 3) as the space writes them -> (N, 3, 3)."""
    if space.euler:
        return rotation_of(values)
    from scipy.spatial.transform import Rotation

    turns: Doubles = Rotation.from_rotvec(values).as_matrix()
    return turns


def angles_of(turns: Doubles) -> Doubles:
    """Return the angles (N, 3) about the fixed axes x, y, z of rotations Rz Ry Rx (N, 3, 3), y within a quarter turn.

    Where y is a whole quarter turn, x and z are one turn, and all of it is given to x.
    """
    level = np.hypot(turns[:, 0, 0], turns[:, 1, 0])
    y = np.arctan2(-turns[:, 2, 0], level)
    x = np.arctan2(turns[:, 2, 1], turns[:, 2, 2])
    z = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    upright = level < LOCKED
    x = np.where(upright, np.arctan2(-turns[:, 1, 2], turns[:, 1, 1]), x)
    return np.stack([x, y, np.where(upright, 0.0, z)], axis=1)
