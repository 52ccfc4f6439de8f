"""The motion spaces that listener papers work in, in one table, and the way from them to ours and back.

`faceverse58`: 52 expression | 3 rotation, Euler x, y, z with R = Rz Ry Rx | 3 translation. Its neutral is about
(pi, 0, 0), so every rotation is taken against the neutral one.
`deca56`: 50 FLAME expression | 3 head axis-angle | 3 jaw axis-angle. FLAME's expression is not ARKit's: it takes a
matrix that maps one to the other, which no licence lets us ship. Without it pose and jaw move and nothing else.

A rotation R of a space turns our head by A R A^T, where A takes the space's axes to ours (x forward, y left, z up).

The last part of this file decides the names and the units of faces that come from elsewhere, for files, the API and
the network: `channel_of`, `units_of`, `LiveUnits`, `beyond`.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError, InputError, did_you_mean
from sfms_robot.frames import (
    BLENDSHAPES,
    CHANNEL_INDEX,
    CHANNELS,
    JAW_FULL_OPEN_RAD,
    MOTION_DIM,
    ORDERS,
    POSE,
    SHAPES,
    Doubles,
    Floats,
    reorder,
)
from sfms_robot.signals.rotations import angles_of
from sfms_robot.signals.rotations import rotation as rotation_of


@dataclass(frozen=True, kw_only=True)
class Space:
    """One motion space; rotations in radians, translation without a metric scale.

    Attributes:
        dim: numbers per frame.
        expression, rotation: their places; `translation` and `jaw` where there are any.
        euler: the rotation is three angles about the fixed axes x, y, z; otherwise it is axis-angle.
        axes: A (3, 3), rows are our x, y, z in the space's axes.
        neutral: rotation of a face that looks straight ahead, as the space writes it.
    """

    dim: int
    expression: slice
    rotation: slice
    translation: slice | None = None
    jaw: slice | None = None
    euler: bool = False
    axes: tuple[tuple[int, int, int], ...]
    neutral: tuple[float, float, float] = (0.0, 0.0, 0.0)


# The axes of both are unproved and may have to be flipped.
# FaceVerse: camera frame x to the viewer's right, y down, z away from the viewer (LizhenWangT/FaceVerse @ a012b634:
# row vectors times R transposed; that the neutral is Rx(pi) follows). FLAME: x to the head's left, y up, z forward.
SPACES: Final[Mapping[str, Space]] = {
    "faceverse58": Space(
        dim=58,
        expression=slice(0, 52),
        rotation=slice(52, 55),
        translation=slice(55, 58),
        euler=True,
        axes=((0, 0, -1), (1, 0, 0), (0, -1, 0)),
        neutral=(np.pi, 0.0, 0.0),
    ),
    "deca56": Space(
        dim=56,
        expression=slice(0, 50),
        rotation=slice(50, 53),
        jaw=slice(53, 56),
        axes=((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ),
}


def decode(
    frames: Floats | Doubles,
    space: str,
    *,
    neutral: Doubles | None = None,
    metres_per_unit: float | None = None,
    flame: FlameMatrix | None = None,
) -> tuple[Floats, Floats | None]:
    """Return frames (N, dim) of the named space as our motion (N, 58), and the jaw (N, 3) of a space that has one.

    The jaw is axis-angle in our axes, + about y lowers the chin. `limitation` says what cannot be shown.
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
    if known.translation is not None and metres_per_unit is not None and len(values):
        place = values[:, known.translation]
        home = np.median(place, axis=0) if neutral is None else np.asarray(neutral)[known.translation]
        motion[:, POSE][:, 3:] = metres_per_unit * (place - home) @ axes.T

    if known.jaw is None:
        shapes = reorder(values[:, known.expression], "faceverse")
        motion[:, SHAPES] = np.minimum(np.maximum(shapes, 0.0), 1.0)
        return motion.astype(np.float32), None
    jaw_rad = values[:, known.jaw] @ axes.T
    jaw_open = np.clip(jaw_rad[:, 1] / JAW_FULL_OPEN_RAD, 0.0, 1.0)
    if flame is not None:
        motion[:, SHAPES] = flame.solve(values[:, known.expression], jaw_open)
    motion[:, SHAPES][:, _JAW] = jaw_open
    return motion.astype(np.float32), jaw_rad.astype(np.float32)


def encode(
    motion: Floats | Doubles,
    space: str = "faceverse58",
    *,
    neutral: Doubles | None = None,
    metres_per_unit: float | None = None,
) -> Floats:
    """Return our motion (N, 58) in a space (N, dim), about `neutral` (dim,), by default the space's own.

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
    if known.translation is not None and metres_per_unit is not None:
        out[:, known.translation] += values[:, POSE][:, 3:] @ axes / metres_per_unit
    if known.jaw is None:
        out[:, known.expression] = values[:, SHAPES]
    else:
        opening = JAW_FULL_OPEN_RAD * values[:, SHAPES][:, _JAW]
        out[:, known.jaw] += opening[:, None] * axes[1]
    return out.astype(np.float32)


def rest_of(space: str) -> Doubles:
    """Return a face at rest (dim,) that looks straight ahead. Raises ConfigError for an unknown space."""
    if space == "arkit58":  # our own
        return np.zeros(MOTION_DIM)
    known = _space(space)
    out = np.zeros(known.dim)
    out[known.rotation] = known.neutral
    return out


def limitation(space: str, flame: FlameMatrix | None) -> str | None:
    """Return the limitation of the space in one line, or None."""
    if space != "deca56" or flame is not None:
        return None
    return f"{space} without a matrix drives pose and jaw only: expression is not shown"


def _space(name: str) -> Space:
    if name not in SPACES:
        raise ConfigError(f"motion space {name!r} is not known ({', '.join(SPACES)})")
    return SPACES[name]


@lru_cache(maxsize=64)
def _at_rest(space: str, *rotation: float) -> tuple[Doubles, Doubles]:
    """Return A (3, 3) of a space, and A times the rotation of a face at rest. Not to be changed in place.

    A head's rotation in the space is A^T R (A times rest), R being ours.
    """
    known = _space(space)
    axes = np.array(known.axes, dtype=np.float64)
    return axes, axes @ _rotations(known, np.array([rotation]))[0]


def _rotations(space: Space, values: Doubles) -> Doubles:
    """Return matrices (N, 3, 3) of rotations (N, 3) as the space writes them."""
    if space.euler:
        return rotation_of(values)
    from scipy.spatial.transform import Rotation

    turns: Doubles = Rotation.from_rotvec(values).as_matrix()
    return turns


# --- FLAME's expression as ARKit blendshapes, with a matrix that the user brings --------------------------------------
#
# The matrix has one row of FLAME coefficients per blendshape: weights @ matrix = coefficients. Such matrices are badly
# conditioned (rows of rare shapes are huge), so it is not inverted: the result is the nearest weights within 0..1, with
# a small price on their size and on left and right being different. Gaze is not in FLAME's expression: its channels
# stay 0. The rows of the jaw are not used, because the jaw has a pose.

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
    """`rows` (52, 50): FLAME coefficients of every blendshape at 1, in the order of `frames.BLENDSHAPES`."""

    rows: Doubles

    def solve(self, expression: Doubles, jaw_open: Doubles) -> Doubles:
        """Return blendshapes (N, 52), 0..1, for coefficients (N, 50); jaw_open (N,), 0..1, is taken unchanged."""
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


# --- Names and units of faces that come from elsewhere: files, the API, Live Link, VMC, the network -------------------

# Head pose: HeadYaw, yaw_deg, x_m, "pitch (deg)". A name that begins with "head" is measured from a camera.
_POSE_NAME: Final = re.compile(
    r"(head)?[ _]?(yaw|pitch|roll|x|y|z)(?:[ _]?[(\[]?(?<![a-z])(deg|rad|m|cm|mm)(?:rees|ians)?[)\]]?)?", re.IGNORECASE
)
_SEPARATORS: Final = re.compile(r"[\s_-]+")
_SHAPE_OF: Final[Mapping[str, str]] = {
    **{name.lower(): name for name in BLENDSHAPES},
    **{name.lower().removesuffix("eft").removesuffix("ight"): name for name in BLENDSHAPES},  # ..._L, ..._R
}
_MOST_NAMED: Final = 8

_ANGLES: Final = slice(0, 3)
_PARTS: Final = (3, 3, len(BLENDSHAPES))  # angles, place, shapes: channels of each
_MOST_TURN_RAD: Final = 2.0  # further than a head turns; the same number of degrees is a small movement
_FASTEST_RAD_S: Final = 4.0  # on average; a head that is shaken fast reaches 3
_RARE: Final = 0.05  # share of rows that a tracker may get wrong
_DECIDED_S: Final = 1.0
_WINDOW: Final = 256  # rows kept of the last second
_SHAPE_RANGE: Final = (-0.5, 2.0)  # a tracker may overshoot 0..1, and is clipped
_MOST_MOVED_M: Final = 10.0


@lru_cache(maxsize=1024)
def channel_of(name: str) -> str | None:
    """Return the channel of `frames.CHANNELS` that a tracker's name stands for, or None.

    Any case; `Left`, `_L` and `L` are the same; what stands before a dot or a colon (`BlendShape.`) is left out. Head
    pose goes as `HeadYaw`, `yaw`, `yaw_deg`: `pose_of` returns its unit.
    """
    pose = pose_of(name)
    return pose[0] if pose else _SHAPE_OF.get(_SEPARATORS.sub("", re.split("[.:]", name)[-1]).lower())


def pose_of(name: str) -> tuple[str, str, bool] | None:
    """Return channel, unit ("" where the name has none) and whether a camera is the origin, of a head pose's name."""
    match = _POSE_NAME.fullmatch(name.strip())
    return (match[2].lower(), (match[3] or "").lower(), bool(match[1])) if match else None


def motion_of(channels: Mapping[str, float], what: str = "face") -> Floats:
    """Return motion (58,) of some channels by any of their names, 0 elsewhere. Raises InputError for unknown names."""
    motion = np.zeros(MOTION_DIM, dtype=np.float32)
    for name, value in channels.items():
        if (channel := channel_of(name)) is None:
            raise InputError(
                f"{what}: {name!r} is not a channel{did_you_mean(name, CHANNELS)} (valid: {', '.join(CHANNELS)})"
            )
        motion[CHANNEL_INDEX[channel]] = value
    return motion


def used_line(used: Collection[str], unknown: Collection[str]) -> str:
    """Return how much of a face is used, in one line: "31 of 52 channels used; not known: a, b, c"."""
    shapes = sum(name in BLENDSHAPES for name in used)
    names = sorted(unknown)
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    listed = f"; not known: {', '.join(names[:_MOST_NAMED])}{more}" if names else ""
    return f"{shapes} of {len(BLENDSHAPES)} channels used{listed}"


@dataclass(frozen=True)
class FaceUnits:
    """Factors that turn a face's angles to radians and its blendshapes to 0..1."""

    angle: float = 1.0
    shape: float = 1.0

    @property
    def line(self) -> str:
        """One line about units that are not ours; "" for radians and 0..1."""
        degrees = "angles are taken as degrees" if self.angle != 1.0 else ""
        percent = "blendshapes are taken as percent" if self.shape != 1.0 else ""
        return " and ".join(filter(None, (degrees, percent)))

    def ours(self, motion: Floats | Doubles) -> Floats:
        """Return motion (..., 58) in radians and 0..1; a copy."""
        out = np.array(motion, dtype=np.float32)
        out[..., _ANGLES] *= self.angle
        out[..., SHAPES] *= self.shape
        return out


def units_of(motion: Floats | Doubles, times_s: Doubles) -> FaceUnits:
    """Decide the units of a face (N, 58) over all its rows, by what a head can do; rows of NaN are left out.

    Angles are degrees where more than one row in twenty is beyond 2 rad, or where they change by more than 4 rad/s on
    average. Blendshapes are percent where more than one row in twenty is beyond 2.
    """
    seen = np.isfinite(motion).all(axis=1)
    rows, at_s = np.asarray(motion, dtype=np.float64)[seen], np.asarray(times_s)[seen]
    if not len(rows):
        return FaceUnits()
    angles = np.abs(rows[:, _ANGLES])
    lasted_s = float(at_s[-1] - at_s[0])
    path = np.abs(np.diff(rows[:, _ANGLES], axis=0)).sum(axis=0).max(initial=0.0)
    degrees = np.mean(angles.max(axis=1) > _MOST_TURN_RAD) > _RARE or path > _FASTEST_RAD_S * max(lasted_s, 0.25)
    percent = np.mean(rows[:, SHAPES].max(axis=1) > _SHAPE_RANGE[1]) > _RARE
    return FaceUnits(math.pi / 180 if degrees else 1.0, 0.01 if percent else 1.0)


@lru_cache(maxsize=8)
def face_bounds(turn_rad: float = _MOST_TURN_RAD) -> tuple[Doubles, Doubles]:
    """Return the least and the most (58,) of a face in our units, not to be changed; `turn_rad`: the largest angle."""
    low, high = _SHAPE_RANGE
    least, most = (-turn_rad, -_MOST_MOVED_M, low), (turn_rad, _MOST_MOVED_M, high)
    return np.repeat(least, _PARTS), np.repeat(most, _PARTS)


def expected_unit(place: int) -> str:
    """Return what is expected of a channel, and in what a value beyond its bounds probably is."""
    return ("radians (in degrees?)", "metres (in cm or mm?)", "0 to 1 (in percent?)")[(place > 2) + (place > 5)]


def beyond(motion: Floats | Doubles, turn_rad: float = _MOST_TURN_RAD) -> str | None:
    """Return what is wrong with a face (58,) in our units: one line that names the channel, or None."""
    low, high = face_bounds(turn_rad)
    inside = (motion >= low) & (motion <= high)  # NaN is in no range
    if inside.all():
        return None
    place = int(np.argmin(inside))
    value, name = float(motion[place]), CHANNELS[place]
    if not math.isfinite(value):
        return f"{name} is not finite"
    return f"{name}: expected {expected_unit(place)}, got {value:g}"


class LiveUnits:
    """Units of a live face, decided over its first second, and again when they turn out to be others.

    angles: False where the angles are known to be radians.

    Attributes:
        units: as decided so far.
    """

    def __init__(self, angles: bool = True) -> None:
        self._angles = angles
        self.restart()

    def restart(self) -> None:
        """Begin again: another sender."""
        self.units = FaceUnits()
        self._rows: deque[tuple[float, Floats]] = deque(maxlen=_WINDOW)
        self._began_s: float | None = None

    def take(self, motion: Floats, time_s: float) -> Floats | None:
        """Return a face (58,) in our units; None within the first second, and for one beyond what a head can do."""
        self._began_s = time_s if self._began_s is None else self._began_s
        self._rows.append((time_s, motion))
        while self._rows[0][0] < time_s - _DECIDED_S:
            self._rows.popleft()
        waits = time_s - self._began_s < _DECIDED_S
        ours = self.units.ours(motion)
        if waits or beyond(ours) is not None:
            found = units_of(np.stack([row for _, row in self._rows]), np.array([at_s for at_s, _ in self._rows]))
            self.units = FaceUnits(
                min(self.units.angle, found.angle) if self._angles else 1.0, min(self.units.shape, found.shape)
            )
            ours = self.units.ours(motion)
        return None if waits or beyond(ours, _MOST_TURN_RAD if self._angles else 2 * math.pi) else ours
