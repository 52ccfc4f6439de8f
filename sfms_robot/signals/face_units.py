"""Names and units of faces from outside: files, the API, Live Link, VMC, the network.

`channel_of` determines the names; `units_of`, `LiveUnits` and `beyond` the units.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from sfms_robot.errors import InputError, did_you_mean
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, CHANNELS, NEUTRAL, SHAPES, Doubles, Floats

# Head pose: HeadYaw, yaw_deg, x_m, "pitch (deg)". A name that begins with "head" is measured from a camera.
_POSE_NAME: Final = re.compile(
    r"(head)?[ _]?(yaw|pitch|roll|x|y|z)(?:[ _]?[(\[]?(?<![a-z])(deg|rad|m|cm|mm)(?:rees|ians)?[)\]]?)?", re.IGNORECASE
)
_SEPARATORS: Final = re.compile(r"[\s_-]+")
_SHAPE_OF: Final[Mapping[str, str]] = {
    spelt: name
    for name in BLENDSHAPES
    for spelt in (name.lower(), name.lower().removesuffix("eft").removesuffix("ight"))  # ..._L, ..._R
}
_MOST_NAMED: Final = 8

_ANGLES: Final = slice(0, 3)
_PARTS: Final = (3, 3, len(BLENDSHAPES))  # number of channels of angles, place, shapes
_MOST_TURN_RAD: Final = 2.0  # a head does not turn this far; in degrees the same number is a small movement
_FASTEST_RAD_S: Final = 4.0  # on average; a head that is shaken fast reaches 3
_RARE: Final = 0.05  # share of rows that a tracker may get wrong
_DECIDED_S: Final = 1.0
_WINDOW: Final = 256  # rows kept of the last second
_SHAPE_RANGE: Final = (-0.5, 2.0)  # a tracker may overshoot 0..1 by this; its values are clipped
_MOST_MOVED_M: Final = 10.0


@lru_cache(maxsize=1024)
def channel_of(name: str) -> str | None:
    """Return the channel of `frames.CHANNELS` that a tracker's name stands for, or None.

    Case is ignored; `Left`, `_L` and `L` are the same; text before a dot or a colon (`BlendShape.`) is ignored. Head
    pose is named as `HeadYaw`, `yaw` or `yaw_deg`: `pose_of` returns its unit.
    """
    pose = pose_of(name)
    return pose[0] if pose else _SHAPE_OF.get(_SEPARATORS.sub("", re.split("[.:]", name)[-1]).lower())


def pose_of(name: str) -> tuple[str, str, bool] | None:
    """Return channel, unit ("" if the name has none) and whether a camera is the origin, from a head pose's name."""
    match = _POSE_NAME.fullmatch(name.strip())
    return (match[2].lower(), (match[3] or "").lower(), bool(match[1])) if match else None


def motion_of(channels: Mapping[str, float], what: str = "face") -> Floats:
    """Return motion (58,) of some channels by any of their names, 0 elsewhere. Raises InputError for unknown names."""
    motion = NEUTRAL.copy()
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
    """Factors that convert a face's angles to radians and its blendshapes to 0..1."""

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

    Angles are degrees if more than one row in twenty is beyond 2 rad, or if they change by more than 4 rad/s on
    average. Blendshapes are percent if more than one row in twenty is beyond 2.
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
def face_bounds(turn_rad: float) -> tuple[Doubles, Doubles]:
    """Return the lower and upper bounds (58,) of a face in our units, not to be changed; `turn_rad`: largest angle."""
    low, high = _SHAPE_RANGE
    least, most = (-turn_rad, -_MOST_MOVED_M, low), (turn_rad, _MOST_MOVED_M, high)
    return np.repeat(least, _PARTS), np.repeat(most, _PARTS)


def expected_unit(place: int) -> str:
    """Return the expected unit of a channel, and the probable unit of a value beyond its bounds."""
    return ("radians (in degrees?)", "metres (in cm or mm?)", "0 to 1 (in percent?)")[(place > 2) + (place > 5)]


def beyond(motion: Floats | Doubles, turn_rad: float = _MOST_TURN_RAD) -> str | None:
    """Return one line that names the first channel of a face (58,) out of bounds in our units, or None."""
    low, high = face_bounds(turn_rad)
    inside = (motion >= low) & (motion <= high)  # NaN is outside of any range
    if inside.all():
        return None
    place = int(np.argmin(inside))
    value, name = float(motion[place]), CHANNELS[place]
    if not math.isfinite(value):
        return f"{name} is not finite"
    return f"{name}: expected {expected_unit(place)}, got {value:g}"


class LiveUnits:
    """Units of a live face, decided over its first second, and again when they turn out to be wrong.

    angles: False if the angles are known to be radians.

    Attributes:
        units: the units decided so far.
    """

    def __init__(self, angles: bool = True) -> None:
        self._angles = angles
        self.restart()

    def restart(self) -> None:
        """Begin again, for another sender."""
        self.units = FaceUnits()
        self._rows = deque[tuple[float, Floats]](maxlen=_WINDOW)
        self._began_s: float | None = None

    def take(self, motion: Floats, time_s: float) -> Floats | None:
        """Return a face (58,) in our units; None in the first second, and for a face beyond what a head can do."""
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
