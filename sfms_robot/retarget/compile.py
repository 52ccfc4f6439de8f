"""Expressions -> a few array operations that evaluate all joints of a head at once.

The expressions of all joints are one forest. It is cut into levels, deepest first: all leaves are one gather from the
motion, and every level above is one `reduceat` per kind of group over its children, then dead band, curve, gain,
offset and clamp. So the cost does not depend on how the file is written, only a little on how deep the deepest
expression is; groups of one and sums inside sums are merged first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Expression
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM, Doubles, Floats

Indices = NDArray[np.intp]
Tree = tuple[int, Expression]  # joint, node

STILL = Expression(channel=CHANNELS[0], gain=0.0)
_REDUCE = {"sum": np.add, "mean": np.add, "max": np.maximum, "min": np.minimum, "product": np.multiply}
_PRODUCT_LIMIT = 1e6  # what keeps products of products finite, whatever the motion


@dataclass(frozen=True)
class _Curves:
    """Monotone cubics of the nodes `where`: C of them with at most K points, evaluated together.

    `breaks` (C, K) is filled up with inf; `pieces` (C, K+1, 4) are coefficients about `origins` (C, K+1), highest
    power first, the outermost two constant.
    """

    where: Indices
    breaks: Doubles
    origins: Doubles
    pieces: Doubles

    @classmethod
    def of(cls, curves: Sequence[tuple[tuple[float, float], ...] | None], scale: Doubles) -> _Curves | None:
        """`scale` (n,): a curve's x is in units of its node's value divided by this."""
        where = [i for i, curve in enumerate(curves) if curve is not None]
        if not where:
            return None
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
                pieces[row, 1 : len(x)] = _monotone_cubics(x, y)
        return cls(np.array(where, dtype=np.intp), breaks, origins, pieces)

    def into(self, values: Doubles) -> None:
        """Replace the nodes' values (..., n) by what their curves give."""
        x = values[..., self.where]
        piece = (x[..., None] >= self.breaks).sum(axis=-1)
        rows = np.arange(len(self.where))
        c = self.pieces[rows, piece]
        flat = (piece == 0) | np.isinf(self.breaks[rows, np.minimum(piece, self.breaks.shape[1] - 1)])
        t = np.where(flat, 0.0, x - self.origins[rows, piece])  # outside, x may be too large to be cubed
        t[piece == self.breaks.shape[1]] = 0.0
        values[..., self.where] = ((c[..., 0] * t + c[..., 1]) * t + c[..., 2]) * t + c[..., 3]


def _monotone_cubics(x: Doubles, y: Doubles) -> Doubles:
    """Cubics between K points (Fritsch, Butland 1984) that overshoot none: (K-1, 4), highest power first."""
    dx = np.diff(x)
    rise = np.diff(y) / dx
    slopes = np.full(len(x), rise[0])
    if len(x) > 2:
        w1, w2 = 2 * dx[1:] + dx[:-1], dx[1:] + 2 * dx[:-1]
        with np.errstate(divide="ignore", invalid="ignore"):
            inner = 1.0 / ((w1 / rise[:-1] + w2 / rise[1:]) / (w1 + w2))
        slopes[1:-1] = np.where(rise[:-1] * rise[1:] > 0, inner, 0.0)
        slopes[0] = _end_slope(dx[0], dx[1], rise[0], rise[1])
        slopes[-1] = _end_slope(dx[-1], dx[-2], rise[-1], rise[-2])
    bend = (slopes[:-1] + slopes[1:] - 2 * rise) / dx
    return np.stack([bend / dx, (rise - slopes[:-1]) / dx - bend, slopes[:-1], y[:-1]], axis=1)


def _end_slope(dx0: float, dx1: float, rise0: float, rise1: float) -> float:
    """By three points, kept from overshooting."""
    slope = ((2 * dx0 + dx1) * rise0 - dx0 * rise1) / (dx0 + dx1)
    if np.sign(slope) != np.sign(rise0):
        return 0.0
    return 3.0 * rise0 if np.sign(rise0) != np.sign(rise1) and abs(slope) > 3.0 * abs(rise0) else slope


@dataclass(frozen=True)
class _Shape:
    """What happens to the values (..., n) of a level's nodes; None for what no node has: one tick has little time."""

    dead_band: Doubles | None
    curves: _Curves | None
    gain_up: Doubles | None
    gain_down: Doubles | None
    offset: Doubles | None
    low: Doubles | None
    high: Doubles | None

    @classmethod
    def of(cls, nodes: Sequence[Expression]) -> _Shape:
        count = np.array([float(len(node.mean or (1,))) for node in nodes])  # a mean is a sum, until it is scaled
        dead = np.array([node.dead_band for node in nodes]) * count
        gains = np.array([node.gains for node in nodes])
        gains /= np.where([node.curve is None for node in nodes], count, 1.0)[:, None]
        gained = bool((gains != 1).any())
        offset = np.array([node.offset for node in nodes])
        limit = [_PRODUCT_LIMIT if node.product else np.inf for node in nodes]
        low, high = np.array([node.clamp or (-top, top) for node, top in zip(nodes, limit, strict=True)]).T
        clamped = bool(np.isfinite(low).any())
        return cls(
            dead if dead.any() else None,
            _Curves.of([node.curve for node in nodes], count),
            gains[:, 1] if gained else None,
            gains[:, 0] if (gains[:, 0] != gains[:, 1]).any() else None,
            offset if offset.any() else None,
            low if clamped else None,
            high if clamped else None,
        )

    def __call__(self, values: Doubles) -> Doubles:
        """Works in `values`, which the caller gives up."""
        if self.dead_band is not None:
            values -= np.minimum(np.maximum(values, -self.dead_band), self.dead_band)
        if self.curves is not None:
            self.curves.into(values)
        if self.gain_up is not None:
            values *= self.gain_up if self.gain_down is None else np.where(values > 0, self.gain_up, self.gain_down)
        if self.offset is not None:
            values += self.offset
        if self.low is not None and self.high is not None:
            np.maximum(values, self.low, out=values)
            np.minimum(values, self.high, out=values)
        return values


@dataclass(frozen=True)
class _Level:
    """Nodes whose children lie side by side one level below, from `starts` on; `kinds`: how which nodes combine."""

    starts: Indices
    kinds: tuple[tuple[np.ufunc, NDArray[np.bool_]], ...]
    shape: _Shape

    def __call__(self, below: Doubles) -> Doubles:
        (first, _), *others = self.kinds
        values: Doubles = first.reduceat(below, self.starts, axis=-1)
        for combine, mask in others:
            np.copyto(values, combine.reduceat(below, self.starts, axis=-1), where=mask)
        return self.shape(values)


@dataclass(frozen=True)
class Program:
    """The drives of J joints, compiled: motion -> values in joint units.

    Attributes:
        columns: the channel of each leaf.
        cells: the same in a flattened (J, 58), in the row of the leaf's joint.
    """

    columns: Indices
    cells: Indices
    leaves: _Shape
    levels: tuple[_Level, ...]

    @classmethod
    def of(cls, trees: Sequence[Expression | None]) -> Program:
        """From plain expressions, without shared ones; None follows nothing and gives 0."""
        forest: list[Tree] = [(row, merged(tree) if tree else STILL) for row, tree in enumerate(trees)]
        levels: list[_Level] = []
        for _ in range(max(_depth(tree) for _, tree in forest)):
            level, forest = _level(forest)
            levels.insert(0, level)
        nodes = [leaf for _, leaf in forest]
        rows = np.array([row for row, _ in forest], dtype=np.intp)
        columns = np.array([CHANNEL_INDEX[leaf.channel or ""] for leaf in nodes], dtype=np.intp)
        return cls(
            columns,
            rows * MOTION_DIM + columns,
            _Shape.of(nodes),
            tuple(levels),
        )

    def __call__(self, motion: Floats) -> Doubles:
        """(58,) or (..., J, 58), row j for joint j -> (J,) or (..., J)."""
        flat = motion.reshape(*motion.shape[:-2], -1)
        values = self.leaves(flat.take(self.columns if motion.ndim == 1 else self.cells, axis=-1).astype(np.float64))
        for level in self.levels:
            values = level(values)
        return values


def _depth(node: Expression) -> int:
    return 1 + max((_depth(part) for part in node.parts), default=-1)


def _level(forest: list[Tree]) -> tuple[_Level, list[Tree]]:
    """One level, and the forest of its children. A leaf above the deepest level becomes a sum of itself alone."""
    nodes = [(row, node if node.parts else Expression.model_construct(sum=(node,))) for row, node in forest]
    groups = [[(row, part) for part in node.parts] for row, node in nodes]
    starts = np.cumsum([0, *(len(group) for group in groups[:-1])])
    ways = [_REDUCE[node.group or "sum"] for _, node in nodes]
    needed = [way for way, group in zip(ways, groups, strict=True) if len(group) > 1] or [np.add]
    ways = [way if way in needed else needed[0] for way in ways]  # a group of one is the same whatever the way
    kinds = [(way, np.array([other is way for other in ways])) for way in dict.fromkeys(ways)]
    level = _Level(starts, tuple(kinds), _Shape.of([node for _, node in nodes]))
    return level, [part for group in groups for part in group]


def merged(node: Expression) -> Expression:
    """The same function with fewer levels."""
    if node.group is None:
        return node
    parts = [merged(part) for part in node.parts]
    if node.sum is not None:
        parts = [term for part in parts for term in (_terms(part) or (part,))]
    node = node.model_copy(update={node.group: tuple(parts)})
    inner = parts[0]
    linear = not node.dead_band and node.curve is None and node.gains[0] == node.gains[1]
    if len(parts) > 1 or not linear or (node.clamp and inner.clamp):
        return node
    scaled = _scaled(inner, node.gains[0], node.offset)
    return scaled.model_copy(update={"clamp": node.clamp}) if node.clamp else scaled


def _terms(part: Expression) -> tuple[Expression, ...]:
    """The terms of a sum that a sum around it can take over, none where it cannot."""
    plain = not part.dead_band and part.curve is None and part.clamp is None and part.gains[0] == part.gains[1]
    if part.sum is None or not plain:
        return ()
    gain = part.gains[0]
    return tuple(_scaled(term, gain, part.offset if i == 0 else 0.0) for i, term in enumerate(part.sum))


def _scaled(node: Expression, gain: float, offset: float) -> Expression:
    """gain x node + offset, as one node."""
    down, up = node.gains
    clamp = None
    if node.clamp is not None:
        low, high = sorted(gain * end + offset for end in node.clamp)
        clamp = (low, high)
    change = {"gain_up": gain * up, "gain_down": gain * down, "offset": gain * node.offset + offset, "clamp": clamp}
    return node.model_copy(update=change)
