"""Motion to joint angles of one head, by the drives of its file.

    drives -> range -> knobs -> couplings

in joint units: -1 = min, 0 = rest, +1 = max, or radians from rest. The result depends on the motion alone, so that the
neutral face is the rest pose whatever came before, and on the knobs, which may differ at every call.

A value u inside its range, |u| = 1 at the end of it, leaves the knobs as intensity x u x (1 + (style - 1)(1 - |u|)):
style bends the response without moving its ends, so that small motions come out doubled (2) or vanish (0).

Each node of a drive is compiled into a function that calls those of its parts: their combination passes dead band,
curve, gain, offset and clamp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial, reduce
from typing import Any

import numpy as np

from sfms_robot.config import Expression, Head
from sfms_robot.config.head import drives
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM, Doubles, Floats


def _sum(values: list[Doubles]) -> Doubles:
    """Return the first plus the sum of the others, as `np.add.reduceat`: the last digits of the motion depend on it."""
    first, *rest = values
    return first + (sum(rest) if len(rest) < 8 else np.sum(rest, axis=0))


_COMBINE: Mapping[str | None, Callable[[list[Doubles]], Doubles]] = {
    "sum": _sum,
    "mean": _sum,  # divided in `compiled`
    "max": partial(reduce, np.maximum),
    "min": partial(reduce, np.minimum),
    "product": partial(reduce, np.multiply),
}
_PRODUCT_LIMIT = 1e6  # keeps products of products finite, whatever the motion


@dataclass(frozen=True)
class Knobs:
    """Knobs of every joint, (J,) each, 0..2, 1 for no change; made by `ChannelMapping.knobs`."""

    intensity: Doubles
    style: Doubles

    @cached_property
    def neutral(self) -> bool:
        return bool((self.intensity == 1).all() and (self.style == 1).all())


@dataclass(frozen=True, kw_only=True)
class Units:
    """Conversion of angles (..., J) [rad] to joint units: -1 = min, 0 = rest, +1 = max, or rad from rest."""

    rest: Doubles
    up: Doubles
    down: Doubles
    low: Doubles
    high: Doubles

    @classmethod
    def of(cls, head: Head) -> Units:
        joints = head.joints.values()
        rest = np.array([joint.rest_rad for joint in joints])
        up = np.array([joint.max_rad for joint in joints]) - rest
        down = rest - np.array([joint.min_rad for joint in joints])
        in_rad = np.array([joint.unit == "rad" for joint in joints])
        return cls(
            rest=rest,
            up=np.where(in_rad | (up <= 0), 1.0, up),
            down=np.where(in_rad | (down <= 0), 1.0, down),
            low=-np.where(in_rad, down, down > 0),
            high=np.where(in_rad, up, up > 0),
        )

    def values(self, angles_rad: Doubles) -> Doubles:
        away = angles_rad - self.rest
        out: Doubles = away / np.where(away > 0, self.up, self.down)
        return out

    def angles(self, values: Doubles) -> Doubles:
        out: Doubles = self.rest + values * np.where(values > 0, self.up, self.down)
        return out


class ChannelMapping:
    """The mapping of one head. A joint without a drive stays at rest.

    Attributes:
        joints: names, in the order of the head's file.
        blind_channels: channels that no drive follows.
        dead_joints: joints without a drive.
    """

    def __init__(self, head: Head) -> None:
        self.joints: Sequence[str] = tuple(head.joints)
        self._regions = head.regions
        self._units = Units.of(head)
        self._low_rad = np.array([joint.min_rad for joint in head.joints.values()])
        self._high_rad = np.array([joint.max_rad for joint in head.joints.values()])

        trees = drives(head)
        self._drives = [compiled(merged(tree), row) if tree else None for row, tree in enumerate(trees.values())]
        # Couplings: C sums of joints that may not fall below a bound, and the joints that give way, the first first.
        self._keep = np.array([[each.keep.get(name, 0.0) for name in self.joints] for each in head.couplings])
        self._at_least = np.array([each.at_least for each in head.couplings])
        self._moving = [[self.joints.index(name) for name in each.moving] for each in head.couplings]
        followed = set[str]().union(*(tree.channels() for tree in trees.values() if tree))
        self.blind_channels: Sequence[str] = tuple(name for name in CHANNELS if name not in followed)
        self.dead_joints: Sequence[str] = tuple(name for name, tree in trees.items() if tree is None)
        self._knobs = self.knobs()

    def knobs(self, intensity: Mapping[str, float] | None = None, style: Mapping[str, float] | None = None) -> Knobs:
        """Return knobs per region over those of the head's file. Raises ConfigError for an unknown region or value."""
        values = {"intensity": np.ones(len(self.joints)), "style": np.ones(len(self.joints))}
        for kind, given in (("intensity", intensity or {}), ("style", style or {})):
            for name, value in given.items():
                if name not in self._regions:
                    choices = ", ".join(self._regions) or "none"
                    raise ConfigError(f"{kind}: {name!r} is not a region of this head ({choices})")
                if not 0 <= value <= 2:
                    raise ConfigError(f"{kind} of {name} = {value:g} is not in 0..2")
            for name, region in self._regions.items():
                where = [self.joints.index(joint) for joint in region.joints]
                values[kind][where] = given.get(name, getattr(region, kind))
        return Knobs(**values)

    def angles(self, motion: Floats, knobs: Knobs | None = None) -> Doubles:
        """Return angles (J,) or (..., J) [rad] of motion (58,) for all joints, or (..., J, 58) with row j for joint j.

        Without `knobs` those of the head's file hold. Raises ValueError, naming the channel, where the motion is not
        finite: clipping would hide it.
        """
        if motion.shape[-1:] != (MOTION_DIM,) or (motion.ndim > 1 and motion.shape[-2] != len(self.joints)):
            raise ValueError(f"motion is {motion.shape}, not (58,) or (..., {len(self.joints)}, {MOTION_DIM})")
        finite = np.isfinite(motion)
        if np.count_nonzero(finite) < finite.size:
            where = np.argwhere(~finite)[0]
            raise ValueError(f"motion channel {CHANNELS[where[-1]]} is {motion[tuple(where)]}")
        rows = np.broadcast_to(motion.astype(np.float64), (*motion.shape[:-2], len(self.joints), MOTION_DIM))
        values, rows = np.zeros(rows.shape[:-1]), np.moveaxis(rows, (-2, -1), (0, 1))
        for column, drive in enumerate(self._drives):
            if drive:
                values[..., column] = drive(rows)
        values = self._inside(values)
        knobs = knobs or self._knobs
        if not knobs.neutral:
            values = self._inside(self._turned(values, knobs))
        if self._moving:
            self._couple(values)
        angles = self._units.angles(values)
        np.maximum(angles, self._low_rad, out=angles)
        np.minimum(angles, self._high_rad, out=angles)
        return angles

    def _couple(self, values: Doubles) -> None:
        """Change values (..., J) in place until the coupled sums are met, as far as the ranges allow."""
        missing = np.maximum(self._at_least - values @ self._keep.T, 0.0)
        if not np.count_nonzero(missing):
            return
        for row, columns in enumerate(self._moving):
            for column in columns:
                weight, now = self._keep[row, column], values[..., column]
                low, high = self._units.low[column], self._units.high[column]
                there = np.minimum(np.maximum(now + missing[..., row] / weight, low), high)
                missing[..., row] -= (there - now) * weight
                values[..., column] = there

    def _inside(self, values: Doubles) -> Doubles:
        np.maximum(values, self._units.low, out=values)
        return np.minimum(values, self._units.high, out=values)

    def _turned(self, values: Doubles, knobs: Knobs) -> Doubles:
        ends = np.where(values > 0, self._units.high, -self._units.low)
        share = np.abs(values) / np.where(ends > 0, ends, 1.0)
        turned: Doubles = values * knobs.intensity * (1.0 + (knobs.style - 1.0) * (1.0 - share))
        return turned


def merged(node: Expression) -> Expression:
    """Return the same function with sums of sums as one sum."""
    if node.group is None:
        return node
    parts = [merged(part) for part in node.parts]
    if node.sum is not None:
        parts = [term for part in parts for term in _terms(part)]
    return node.model_copy(update={node.group: tuple(parts)})


def _terms(part: Expression) -> tuple[Expression, ...]:
    """Return the terms of a sum, with its gain, where a sum around it can take them over; else the part itself."""
    down, gain = part.gains
    if part.sum is None or part.clamp or part.dead_band or part.curve or part.offset or down != gain:
        return (part,)
    if gain != 1 and any(term.clamp for term in part.sum):
        return (part,)
    return tuple(
        term.model_copy(
            update={"gain_up": gain * term.gains[1], "gain_down": gain * term.gains[0], "offset": gain * term.offset}
        )
        for term in part.sum
    )


def compiled(node: Expression, row: int) -> Callable[[Doubles], Doubles]:
    """Return the function from motion (J, 58, ...) to the values (...) of a node of joint `row`.

    At a tick the values are numbers, for a recording arrays; an operation that changes nothing is left out.
    """
    parts = [compiled(part, row) for part in node.parts]
    combine, column = _COMBINE.get(node.group), CHANNEL_INDEX.get(node.channel or "")
    count = float(len(node.mean or (1,)))  # a mean is divided by it with the gain, or in the curve
    dead = node.dead_band * count
    curve = _pchip(np.array(node.curve) * [count, 1.0]) if node.curve else None
    down, up = np.array(node.gains) / (1.0 if curve else count)
    limit = _PRODUCT_LIMIT if node.product else np.inf
    low, high = node.clamp or (-limit, limit)

    def value(motion: Doubles) -> Doubles:
        x = combine([part(motion) for part in parts]) if combine else motion[row, column]
        if dead:
            x = x - np.minimum(np.maximum(x, -dead), dead)
        if curve:  # beyond its points it keeps its end values
            x = curve(np.minimum(np.maximum(x, curve.x[0]), curve.x[-1]))
        if up != down or up != 1:
            x = x * (up if up == down else np.where(x > 0, up, down))
        if node.offset:
            x = x + node.offset
        return x if high == np.inf else np.minimum(np.maximum(x, low), high)

    return value


def _pchip(points: Doubles) -> Any:
    """Return the monotone cubic (PCHIP) through points (K, 2)."""
    from scipy.interpolate import PchipInterpolator  # only heads with curves load scipy

    with np.errstate(over="ignore"):  # slopes too small for a float are 0
        return PchipInterpolator(*points.T)
