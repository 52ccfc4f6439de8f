"""Motion to joint angles of one head, by the drives of its file.

    drives -> range -> knobs -> couplings

in joint units: -1 = min, 0 = rest, +1 = max, or radians from rest. The result depends only on the motion and on the
knobs, which may differ at every call, so that the neutral face is the rest pose regardless of earlier calls.

The knobs turn a value u inside its range, |u| = 1 at its end, into intensity x u x (1 + (style - 1)(1 - |u|)): style
bends the response without moving its ends, so that small motions are doubled (style 2) or vanish (style 0).

The drives of all joints are one forest, compiled into a few array operations. It is cut into levels, deepest first: all
leaves are one gather from the motion, and every level above is one `reduceat` per kind of group over its children, then
dead band, curve, gain, offset and clamp. The cost therefore does not depend on the form of the file, only a little on
the depth of the deepest expression. Groups of one and sums inside sums are merged first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sfms_robot.config import Expression, Head
from sfms_robot.config.head import drives
from sfms_robot.errors import InputError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM, Bools, Doubles, Floats, Indices

Tree = tuple[int, Expression]  # joint, node

STILL = Expression(channel=CHANNELS[0], gain=0.0)
_REDUCE = {"sum": np.add, "mean": np.add, "max": np.maximum, "min": np.minimum, "product": np.multiply}
_PRODUCT_LIMIT = 1e6  # limit of a product, which keeps products of products finite for any motion


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
        rest, ends = head.rest_rad, head.range
        up, down = ends.high - rest, rest - ends.low
        in_rad = np.array([joint.unit == "rad" for joint in head.joints.values()], np.bool_)
        return cls(
            rest=rest,
            up=np.where(in_rad | (up <= 0), 1.0, up),
            down=np.where(in_rad | (down <= 0), 1.0, down),
            low=-np.where(in_rad, down, down > 0),
            high=np.where(in_rad, up, up > 0),
        )

    def values(self, angles_rad: Doubles) -> Doubles:
        away = angles_rad - self.rest
        return away / np.where(away > 0, self.up, self.down)

    def angles(self, values: Doubles) -> Doubles:
        return self.rest + values * np.where(values > 0, self.up, self.down)


class ChannelMapping:
    """The mapping of one head. A joint without a drive stays at rest.

    Attributes:
        joints: names, in the order of the head's file.
        blind_channels: channels that no drive follows; empty for a head without joints, which only outputs show.
        dead_joints: joints without a drive.
        file_knobs: the knobs of the head's file.
    """

    def __init__(self, head: Head) -> None:
        self.joints = tuple(head.joints)
        self._regions = head.regions
        self._units = Units.of(head)
        self._range = head.range

        trees = drives(head)
        self._program = Program.of(list(trees.values()))
        # Couplings: C sums of joints that may not fall below a bound, and the joints that give way, in this order.
        self._keep = np.array([[each.keep.get(name, 0.0) for name in self.joints] for each in head.couplings])
        self._at_least = np.array([each.at_least for each in head.couplings])
        self._moving = [[self.joints.index(name) for name in each.moving] for each in head.couplings]
        followed = set[str]().union(*(tree.channels() for tree in trees.values() if tree))
        self.blind_channels = tuple(name for name in CHANNELS if trees and name not in followed)
        self.dead_joints = tuple(name for name, tree in trees.items() if tree is None)
        self.file_knobs = self.knobs()

    def knobs(self, intensity: Mapping[str, float] | None = None, style: Mapping[str, float] | None = None) -> Knobs:
        """Return the file's knobs with new values by region. Raises InputError for an unknown region or a bad value."""
        values = {"intensity": np.ones(len(self.joints)), "style": np.ones(len(self.joints))}
        for kind, given in (("intensity", intensity or {}), ("style", style or {})):
            for name, value in given.items():
                if name not in self._regions:
                    raise InputError(
                        f"{kind}: {name!r} is not a region of this head ({', '.join(self._regions) or 'none'})"
                    )
                if not 0 <= value <= 2:
                    raise InputError(f"{kind} of {name} = {value:g} is not in 0..2")
            for name, region in self._regions.items():
                where = [self.joints.index(joint) for joint in region.joints]
                values[kind][where] = given.get(name, getattr(region, kind))
        return Knobs(**values)

    def angles(self, motion: Floats, knobs: Knobs | None = None) -> Doubles:
        """Return angles (J,) or (..., J) [rad] of motion (58,) for all joints, or (..., J, 58) with row j for joint j.

        Without `knobs` those of the head's file are used. Raises ValueError, which names the channel, if the motion is
        not finite, because clipping would hide it.
        """
        if motion.shape[-1:] != (MOTION_DIM,) or (motion.ndim > 1 and motion.shape[-2] != len(self.joints)):
            raise ValueError(f"motion is {motion.shape}, not (58,) or (..., {len(self.joints)}, {MOTION_DIM})")
        finite = np.isfinite(motion)
        if np.count_nonzero(finite) < finite.size:
            where = np.argwhere(~finite)[0]
            raise ValueError(f"motion channel {CHANNELS[where[-1]]} is {motion[tuple(where)]}")
        values = self._inside(self._program(motion))
        knobs = knobs or self.file_knobs
        if not knobs.neutral:
            values = self._inside(self._turned(values, knobs))
        if self._moving:
            self._couple(values)
        return self._range.nearest(self._units.angles(values))

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
        return values * knobs.intensity * (1.0 + (knobs.style - 1.0) * (1.0 - share))


# --- Compiled drives ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Curves:
    """C monotone cubics (PCHIP) of the nodes `where`, with at most K points each, evaluated together.

    `breaks` (C, K) is filled up with inf; `pieces` (C, K+1, 4) are coefficients about `origins` (C, K+1), highest
    power first. The two outermost pieces are constant.
    """

    where: Indices
    breaks: Doubles
    origins: Doubles
    pieces: Doubles

    @classmethod
    def of(cls, curves: Sequence[tuple[tuple[float, float], ...] | None], scale: Doubles) -> _Curves | None:
        """Return the curves of n nodes; `scale` (n,): a curve's x is in units of its node's value divided by this."""
        where = [i for i, curve in enumerate(curves) if curve is not None]
        if not where:
            return None
        from scipy.interpolate import PchipInterpolator  # takes a third of a second, and few heads have curves

        longest = max(len(curve) for curve in curves if curve is not None)
        breaks = np.full((len(where), longest), np.inf)
        origins = np.zeros((len(where), longest + 1))
        pieces = np.zeros((len(where), longest + 1, 4))
        for row, i in enumerate(where):
            points = np.array(curves[i], dtype=np.float64)
            x, y = points[:, 0] * scale[i], points[:, 1]
            breaks[row, : len(x)] = x
            origins[row, 1 : len(x)] = x[:-1]
            pieces[row, 0, 3], pieces[row, len(x), 3] = y[0], y[-1]
            with np.errstate(over="ignore"):  # slopes too small for a float are 0
                pieces[row, 1 : len(x)] = PchipInterpolator(x, y).c.T
        return cls(np.array(where, dtype=np.intp), breaks, origins, pieces)

    def into(self, values: Doubles) -> None:
        """Replace the nodes' values (..., n) by those of their curves."""
        x = values[..., self.where]
        piece = (x[..., None] >= self.breaks).sum(axis=-1)
        rows = np.arange(len(self.where))
        c, t = self.pieces[rows, piece], x - self.origins[rows, piece]
        values[..., self.where] = ((c[..., 0] * t + c[..., 1]) * t + c[..., 2]) * t + c[..., 3]


@dataclass(frozen=True)
class _Shape:
    """Operations on the values (..., n) of a level's nodes; those that change nothing are left out, to save time.

    Attributes:
        gains: (2, n) factors below and above 0, where they differ; otherwise the factor is among the steps.
        steps: in this order factor, offset, low and high end.
    """

    dead_band: Doubles | None
    curves: _Curves | None
    gains: Doubles | None
    steps: tuple[tuple[np.ufunc, Doubles], ...]

    @classmethod
    def of(cls, nodes: Sequence[Expression]) -> _Shape:
        count = np.array([float(len(node.mean or (1,))) for node in nodes])  # a mean is a sum that is scaled here
        dead = np.array([node.dead_band for node in nodes]) * count
        gains = np.array([node.gains for node in nodes]).reshape(-1, 2).T
        gains /= np.where([node.curve is None for node in nodes], count, 1.0)
        even = bool((gains[0] == gains[1]).all())
        limit = [_PRODUCT_LIMIT if node.product else np.inf for node in nodes]
        ends = [node.clamp or (-top, top) for node, top in zip(nodes, limit, strict=True)]
        low, high = np.array(ends).reshape(-1, 2).T
        operands = [gains[1] if even else 1.0, np.array([node.offset for node in nodes]), low, high]
        steps = zip((np.multiply, np.add, np.maximum, np.minimum), operands, (1.0, 0.0, -np.inf, np.inf), strict=True)
        return cls(
            dead if dead.any() else None,
            _Curves.of([node.curve for node in nodes], count),
            None if even else gains,
            tuple((step, np.asarray(operand)) for step, operand, idle in steps if np.any(operand != idle)),
        )

    def __call__(self, values: Doubles) -> Doubles:
        """Apply the operations in place, and return `values`."""
        if self.dead_band is not None:
            values -= np.minimum(np.maximum(values, -self.dead_band), self.dead_band)
        if self.curves is not None:
            self.curves.into(values)
        if self.gains is not None:
            values *= np.where(values > 0, self.gains[1], self.gains[0])
        for step, operand in self.steps:
            step(values, operand, out=values)
        return values


@dataclass(frozen=True)
class _Level:
    """Nodes whose children are adjacent one level below, from `starts` on; `kinds`: operations and masks of nodes."""

    starts: Indices
    kinds: tuple[tuple[np.ufunc, Bools], ...]
    shape: _Shape

    def __call__(self, below: Doubles) -> Doubles:
        (first, _), *others = self.kinds
        values: Doubles = first.reduceat(below, self.starts, axis=-1)
        for combine, mask in others:
            np.copyto(values, combine.reduceat(below, self.starts, axis=-1), where=mask)
        return self.shape(values)


@dataclass(frozen=True)
class Program:
    """The compiled drives of J joints: motion -> values in joint units.

    Attributes:
        columns: the channel of each leaf.
        cells: index of that channel in a flattened (J, 58), in the row of the leaf's joint.
    """

    columns: Indices
    cells: Indices
    leaves: _Shape
    levels: tuple[_Level, ...]

    @classmethod
    def of(cls, trees: Sequence[Expression | None]) -> Program:
        """Compile plain expressions, without shared ones; None has the value 0."""
        forest = [(row, merged(tree) if tree else STILL) for row, tree in enumerate(trees)]
        levels: list[_Level] = []
        for _ in range(max((_depth(tree) for _, tree in forest), default=0)):
            level, forest = _level(forest)
            levels.insert(0, level)
        nodes = [leaf for _, leaf in forest]
        rows = np.array([row for row, _ in forest], dtype=np.intp)
        columns = np.array([CHANNEL_INDEX[leaf.channel or ""] for leaf in nodes], dtype=np.intp)
        return cls(columns, rows * MOTION_DIM + columns, _Shape.of(nodes), tuple(levels))

    def __call__(self, motion: Floats) -> Doubles:
        """Return values (J,) or (..., J) of motion (58,) or (..., J, 58), row j for joint j."""
        flat = motion.reshape(*motion.shape[:-2], -1)
        values = self.leaves(flat.take(self.columns if motion.ndim == 1 else self.cells, axis=-1).astype(np.float64))
        for level in self.levels:
            values = level(values)
        return values


def _depth(node: Expression) -> int:
    return 1 + max((_depth(part) for part in node.parts), default=-1)


def _level(forest: list[Tree]) -> tuple[_Level, list[Tree]]:
    """Return one level and the forest of its children. A leaf above the deepest level becomes a sum of one."""
    nodes = [(row, node if node.parts else Expression.model_construct(sum=(node,))) for row, node in forest]
    groups = [[(row, part) for part in node.parts] for row, node in nodes]
    starts = np.cumsum([0, *(len(group) for group in groups[:-1])])
    ways = [_REDUCE[node.group or "sum"] for _, node in nodes]
    needed = [way for way, group in zip(ways, groups, strict=True) if len(group) > 1] or [np.add]
    ways = [way if way in needed else needed[0] for way in ways]  # a group of one has the same value with any operation
    kinds = [(way, np.array([other is way for other in ways])) for way in dict.fromkeys(ways)]
    level = _Level(starts, tuple(kinds), _Shape.of([node for _, node in nodes]))
    return level, [part for group in groups for part in group]


def merged(node: Expression) -> Expression:
    """Return an expression of the same function with fewer levels."""
    if node.group is None:
        return node
    parts = [merged(part) for part in node.parts]
    if node.sum is not None:
        parts = [term for part in parts for term in (_terms(part) or (part,))]
    node = node.replaced(**{node.group: tuple(parts)})
    inner = parts[0]
    if len(parts) > 1 or not _is_linear(node) or (node.clamp and inner.clamp):
        return node
    scaled = _scaled(inner, node.gains[0], node.offset)
    return scaled.replaced(clamp=node.clamp) if node.clamp else scaled


def _is_linear(node: Expression) -> bool:
    """Return whether a node is only a factor and an offset, before its clamp."""
    return not node.dead_band and node.curve is None and node.gains[0] == node.gains[1]


def _terms(part: Expression) -> tuple[Expression, ...]:
    """Return the terms of a sum that can be moved into the sum around it; empty if they cannot."""
    if part.sum is None or part.clamp is not None or not _is_linear(part):
        return ()
    gain = part.gains[0]
    return tuple(_scaled(term, gain, part.offset if i == 0 else 0.0) for i, term in enumerate(part.sum))


def _scaled(node: Expression, gain: float, offset: float) -> Expression:
    """Return gain x node + offset as one node."""
    down, up = node.gains
    clamp = None
    if node.clamp is not None:
        low, high = sorted(gain * end + offset for end in node.clamp)
        clamp = (low, high)
    return node.replaced(gain_up=gain * up, gain_down=gain * down, offset=gain * node.offset + offset, clamp=clamp)
