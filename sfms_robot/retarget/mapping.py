"""Motion -> joint angles of one head, as its file says: every joint is an expression over channels.

The expressions of all joints are one forest. It is compiled once into levels, deepest first: all leaves are one
gather from the motion, and every level above is one `reduceat` over its children, then gain, offset and clamp.
So the cost does not depend on how the file is written, only a little on how deep the deepest expression is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Expression, Head
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM, Doubles, Floats

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class _Affine:
    """gain x value + offset, clamped; all (n,)."""

    gain: Doubles
    offset: Doubles
    low: Doubles
    high: Doubles

    @classmethod
    def of(cls, nodes: Sequence[Expression]) -> _Affine:
        clamps = [node.clamp or (-np.inf, np.inf) for node in nodes]
        return cls(
            np.array([node.gain / len(node.mean or (1,)) for node in nodes]),
            np.array([node.offset for node in nodes]),
            np.array([low for low, _ in clamps]),
            np.array([high for _, high in clamps]),
        )

    def __call__(self, values: Doubles) -> Doubles:
        values = values * self.gain
        values += self.offset
        np.maximum(values, self.low, out=values)
        return np.minimum(values, self.high, out=values)


@dataclass(frozen=True)
class _Level:
    """Nodes whose children lie side by side one level below, from `starts` on."""

    starts: Indices
    largest: NDArray[np.bool_]  # the maximum of its children, else their sum
    affine: _Affine

    def __call__(self, below: Doubles) -> Doubles:
        values: Doubles = np.add.reduceat(below, self.starts, axis=-1)
        if self.largest.any():
            values = np.where(self.largest, np.maximum.reduceat(below, self.starts, axis=-1), values)
        return self.affine(values)


class Mapping:
    """Implements `ports.Retargeter` for one head.

    Angle = rest + u x (max - rest) for u > 0 and rest + u x (rest - min) below, where `unit` is "range"; rest + u
    where it is "rad"; always clamped to the range of the joint. A joint without a drive stays at rest.
    """

    def __init__(self, head: Head) -> None:
        self.joints: Sequence[str] = tuple(head.joints)
        joints = list(head.joints.values())
        self._low = np.array([joint.min_rad for joint in joints])
        self._rest = np.array([joint.rest_rad for joint in joints])
        self._high = np.array([joint.max_rad for joint in joints])
        in_rad = np.array([joint.unit == "rad" for joint in joints])
        self._up = np.where(in_rad, 1.0, self._high - self._rest)
        self._down = np.where(in_rad, 1.0, self._rest - self._low)

        still = Expression(channel=CHANNELS[0], gain=0.0)
        forest = [(row, joint.drive or still) for row, joint in enumerate(joints)]
        depth = max(_depth(tree) for _, tree in forest)
        self._levels: list[_Level] = []
        for _ in range(depth):
            level, forest = _level(forest)
            self._levels.insert(0, level)
        self._rows = np.array([row for row, _ in forest], dtype=np.intp)
        self._columns = np.array([CHANNEL_INDEX[leaf.channel or ""] for _, leaf in forest], dtype=np.intp)
        self._leaves = _Affine.of([leaf for _, leaf in forest])
        driven = set[str]().union(*(joint.drive.channels() for joint in joints if joint.drive))
        self.blind_channels: Sequence[str] = tuple(name for name in CHANNELS if name not in driven)

    def angles(self, motion: Floats) -> Doubles:
        """(58,) for all joints, or (..., J, 58) with row j for joint j -> rad (J,) or (..., J), float64.

        Raises ValueError, naming the channel, where the motion is not finite: clipping would hide it.
        """
        if motion.shape[-1:] != (MOTION_DIM,) or (motion.ndim > 1 and motion.shape[-2] != len(self.joints)):
            raise ValueError(f"motion is {motion.shape}, not (58,) or (..., {len(self.joints)}, {MOTION_DIM})")
        if not np.isfinite(motion).all():
            where = np.argwhere(~np.isfinite(motion))[0]
            raise ValueError(f"motion channel {CHANNELS[where[-1]]} is {motion[tuple(where)]}")
        rows = (self._rows, self._columns) if motion.ndim > 1 else (self._columns,)
        values = self._leaves(motion[(..., *rows)].astype(np.float64))
        for level in self._levels:
            values = level(values)
        angles = self._rest + values * np.where(values > 0, self._up, self._down)
        clamped: Doubles = np.minimum(np.maximum(angles, self._low), self._high)
        return clamped


def _children(node: Expression) -> tuple[Expression, ...]:
    return node.sum or node.max or node.mean or ()


def _depth(node: Expression) -> int:
    return 1 + max((_depth(child) for child in _children(node)), default=-1)


def _level(forest: list[tuple[int, Expression]]) -> tuple[_Level, list[tuple[int, Expression]]]:
    """One level, and the forest of its children. A leaf above the deepest level becomes a sum of itself alone."""
    nodes = [(row, node if _children(node) else Expression(sum=(node,))) for row, node in forest]
    groups = [[(row, child) for child in _children(node)] for row, node in nodes]
    starts = np.cumsum([0, *(len(group) for group in groups[:-1])])
    largest = np.array([node.max is not None for _, node in nodes])
    level = _Level(starts, largest, _Affine.of([node for _, node in nodes]))
    return level, [child for group in groups for child in group]
