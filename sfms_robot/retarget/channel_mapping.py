"""Motion to joint angles of one head, by the drives of its file.

    drives -> range -> knobs -> couplings

in joint units: -1 = min, 0 = rest, +1 = max, or radians from rest. The result depends on the motion alone, so that the
neutral face is the rest pose whatever came before, and on the knobs, which may differ at every call.

A value u inside its range, |u| = 1 at the end of it, leaves the knobs as intensity x u x (1 + (style - 1)(1 - |u|)):
style bends the response without moving its ends, so that small motions come out doubled (2) or vanish (0).

The drives of all joints are one forest, compiled into a few array operations. It is cut into levels, deepest first: all
leaves are one gather from the motion, and every level above is one `reduceat` per kind of group over its children, then
dead band, curve, gain, offset and clamp. So the cost does not depend on the form of the file, only a little on the
depth of the deepest expression.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Expression, Head
from sfms_robot.config.head import drives
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM, Doubles, Floats

Indices = NDArray[np.intp]
Step = Callable[[Doubles], object]  # changes its argument in place

STILL = Expression(channel=CHANNELS[0], gain=0.0)
_REDUCE = {"sum": np.add, "mean": np.add, "max": np.maximum, "min": np.minimum, "product": np.multiply}
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
        self._program = Program(list(trees.values()))
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
        values = self._inside(self._program(motion))
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


# --- Compiled drives ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Level:
    """Nodes at one depth, evaluated together from the values one level deeper.

    Attributes:
        starts: where the children of each node begin; they lie side by side.
        groups: each way to combine children, and the nodes (n,) of that kind.
        steps: what follows, in place on the values (..., n); an operation that no node has is left out.
    """

    starts: Indices
    groups: Sequence[tuple[np.ufunc, NDArray[np.bool_]]]
    steps: Sequence[Step]

    def __call__(self, below: Doubles) -> Doubles:
        (first, _), *others = self.groups
        values: Doubles = first.reduceat(below, self.starts, axis=-1)
        for combine, mask in others:
            np.copyto(values, combine.reduceat(below, self.starts, axis=-1), where=mask)
        for step in self.steps:
            step(values)
        return values


class Program:
    """The compiled drives of J joints: motion -> values in joint units. A drive that is None gives 0."""

    def __init__(self, trees: Sequence[Expression | None]) -> None:
        forest = [(row, tree or STILL) for row, tree in enumerate(trees)]  # joint, node
        self._levels: list[_Level] = []
        while any(node.parts for _, node in forest):
            # A leaf above the deepest level becomes a sum of one.
            nodes = [node if node.parts else Expression.model_construct(sum=(node,)) for _, node in forest]
            ways = [_REDUCE[node.group or "sum"] for node in nodes]
            groups = [(way, np.array([other is way for other in ways])) for way in dict.fromkeys(ways)]
            starts = np.cumsum([0, *(len(node.parts) for node in nodes[:-1])])
            self._levels.insert(0, _Level(starts, groups, _steps(nodes)))
            forest = [(row, part) for (row, _), node in zip(forest, nodes, strict=True) for part in node.parts]
        self._steps = _steps([leaf for _, leaf in forest])
        # The channel of each leaf, and its place in a flattened (J, 58), in the row of its joint.
        self._columns = np.array([CHANNEL_INDEX[leaf.channel or ""] for _, leaf in forest], dtype=np.intp)
        self._cells = np.array([row for row, _ in forest], dtype=np.intp) * MOTION_DIM + self._columns

    def __call__(self, motion: Floats) -> Doubles:
        """Return values (J,) or (..., J) of motion (58,) or (..., J, 58), row j for joint j."""
        flat = motion.reshape(*motion.shape[:-2], -1)
        values = flat.take(self._columns if motion.ndim == 1 else self._cells, axis=-1).astype(np.float64)
        for step in self._steps:
            step(values)
        for level in self._levels:
            values = level(values)
        return values


def _steps(nodes: Sequence[Expression]) -> list[Step]:
    """Return the operations that turn what n nodes combine, or read, into their values (..., n)."""
    steps: list[Step] = []
    # A mean is a sum until it is scaled, by its gain or before its curve.
    count = np.array([float(len(node.mean or (1,))) for node in nodes])
    dead = np.array([node.dead_band for node in nodes]) * count
    if dead.any():
        steps.append(lambda values: np.subtract(values, np.minimum(np.maximum(values, -dead), dead), out=values))
    curves = {i: np.array(node.curve) for i, node in enumerate(nodes) if node.curve is not None}
    if curves:
        steps.append(_Curves({i: points * [count[i], 1.0] for i, points in curves.items()}))
        count[list(curves)] = 1.0
    down, up = np.array([node.gains for node in nodes]).T / count
    if (down != up).any():
        steps.append(lambda values: np.multiply(values, np.where(values > 0, up, down), out=values))
    elif (up != 1).any():
        steps.append(lambda values: np.multiply(values, up, out=values))
    offset = np.array([node.offset for node in nodes])
    if offset.any():
        steps.append(lambda values: np.add(values, offset, out=values))
    limits = [_PRODUCT_LIMIT if node.product else np.inf for node in nodes]
    low, high = np.array([node.clamp or (-top, top) for node, top in zip(nodes, limits, strict=True)]).T
    if np.isfinite(low).any():
        steps.append(lambda values: np.minimum(np.maximum(values, low, out=values), high, out=values))
    return steps


class _Curves:
    """Monotone cubics (PCHIP) of C nodes, evaluated together; beyond its points a curve keeps its end values."""

    def __init__(self, curves: Mapping[int, Doubles]) -> None:
        """Take the points (K, 2) of each curve, by the column of its node. K differs: places left over are inf or 0."""
        from scipy.interpolate import PchipInterpolator  # only heads with curves load scipy

        self._columns = np.array(list(curves), dtype=np.intp)
        self._rows = np.arange(len(curves))
        self._ends = np.array([(x[0], x[-1]) for x, _ in (points.T for points in curves.values())])
        pieces = max(len(points) for points in curves.values()) - 1
        self._breaks = np.full((len(curves), pieces), np.inf)  # ends of the pieces but the last
        self._begins = np.zeros((len(curves), pieces))
        self._cubics = np.zeros((len(curves), pieces, 4))  # about the beginning of the piece, highest power first
        for row, (x, y) in enumerate(points.T for points in curves.values()):
            self._breaks[row, : len(x) - 2], self._begins[row, : len(x) - 1] = x[1:-1], x[:-1]
            with np.errstate(over="ignore"):  # slopes too small for a float are 0
                self._cubics[row, : len(x) - 1] = PchipInterpolator(x, y).c.T

    def __call__(self, values: Doubles) -> None:
        x = np.clip(values[..., self._columns], self._ends[:, 0], self._ends[:, 1])
        piece = (x[..., None] >= self._breaks).sum(axis=-1)
        c = self._cubics[self._rows, piece]
        t = x - self._begins[self._rows, piece]
        values[..., self._columns] = ((c[..., 0] * t + c[..., 1]) * t + c[..., 2]) * t + c[..., 3]
