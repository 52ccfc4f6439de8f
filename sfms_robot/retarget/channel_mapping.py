"""Motion -> joint angles of one head, as its file says.

    drives -> range -> knobs -> couplings

in joint units: -1 = min, 0 = rest, +1 = max, or radians from rest. Everything is a function of the motion alone, so
that the neutral face is the rest pose whatever came before, and of the knobs, which may be others at every call.

A value u inside its range, |u| = 1 at the end of it, leaves the knobs as intensity x u x (1 + (style - 1)(1 - |u|)):
style bends the response without moving its ends, so that small motions come out doubled (2) or vanish (0).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sfms_robot.config import Coupling, Head
from sfms_robot.config.drives import drives
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, MOTION_DIM, Doubles, Floats
from sfms_robot.retarget.compile import Indices, Program


@dataclass(frozen=True)
class Knobs:
    """How much every joint shows, (J,) each, 0..2 and 1 for as it is; made by `ChannelMapping.knobs`."""

    intensity: Doubles
    style: Doubles

    @cached_property
    def neutral(self) -> bool:
        return bool((self.intensity == 1).all() and (self.style == 1).all())


@dataclass(frozen=True)
class _Couplings:
    """C sums of joints that may not fall below a bound: weights (C, J), at_least (C,).

    `turns`: who gives way first, second, ...: for some of the couplings, the joint and its weight.
    """

    weights: Doubles
    at_least: Doubles
    turns: tuple[tuple[Indices, Indices, Doubles], ...]

    @classmethod
    def of(cls, couplings: Sequence[Coupling], joints: Sequence[str]) -> _Couplings:
        weights = np.array([[coupling.keep.get(name, 0.0) for name in joints] for coupling in couplings])
        turns = []
        for turn in range(max(len(coupling.moving) for coupling in couplings)):
            rows = np.array([row for row, c in enumerate(couplings) if len(c.moving) > turn], dtype=np.intp)
            columns = np.array([joints.index(couplings[row].moving[turn]) for row in rows], dtype=np.intp)
            turns.append((rows, columns, weights[rows, columns]))
        return cls(weights, np.array([coupling.at_least for coupling in couplings]), tuple(turns))

    def apply(self, values: Doubles, low: Doubles, high: Doubles) -> None:
        """Change values (..., J), which lie inside low..high (J,), as far as it takes and the ranges allow."""
        missing = np.maximum(self.at_least - values @ self.weights.T, 0.0)
        if not np.count_nonzero(missing):
            return
        for rows, columns, weights in self.turns:
            now = values[..., columns]
            there = np.minimum(np.maximum(now + missing[..., rows] / weights, low[columns]), high[columns])
            values[..., columns] = there
            missing[..., rows] -= (there - now) * weights


@dataclass(frozen=True)
class Units:
    """Joint angles (..., J) [rad] <-> joint units of the drives: -1 = min, 0 = rest, +1 = max, or rad from rest."""

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
            rest,
            np.where(in_rad | (up <= 0), 1.0, up),
            np.where(in_rad | (down <= 0), 1.0, down),
            -np.where(in_rad, down, down > 0),
            np.where(in_rad, up, up > 0),
        )

    def values(self, angles_rad: Doubles) -> Doubles:
        away = angles_rad - self.rest
        out: Doubles = away / np.where(away > 0, self.up, self.down)
        return out

    def angles(self, values: Doubles) -> Doubles:
        out: Doubles = self.rest + values * np.where(values > 0, self.up, self.down)
        return out


class ChannelMapping:
    """Implements `ports.Retargeter` for one head. A joint without a drive stays at rest.

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
        self._program = Program.of(list(trees.values()))
        self._couplings = _Couplings.of(head.couplings, self.joints) if head.couplings else None
        followed = set[str]().union(*(tree.channels() for tree in trees.values() if tree))
        self.blind_channels: Sequence[str] = tuple(name for name in CHANNELS if name not in followed)
        self.dead_joints: Sequence[str] = tuple(name for name, tree in trees.items() if tree is None)
        self._knobs = self.knobs()

    def knobs(self, intensity: Mapping[str, float] | None = None, style: Mapping[str, float] | None = None) -> Knobs:
        """Knobs per region over those of the head's file. Raises ConfigError for an unknown region or a bad value."""
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
        """(58,) for all joints, or (..., J, 58) with row j for joint j -> rad (J,) or (..., J), float64.

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
        if self._couplings is not None:
            self._couplings.apply(values, self._units.low, self._units.high)
        angles = self._units.angles(values)
        np.maximum(angles, self._low_rad, out=angles)
        np.minimum(angles, self._high_rad, out=angles)
        return angles

    def _inside(self, values: Doubles) -> Doubles:
        np.maximum(values, self._units.low, out=values)
        np.minimum(values, self._units.high, out=values)
        return values

    def _turned(self, values: Doubles, knobs: Knobs) -> Doubles:
        ends = np.where(values > 0, self._units.high, -self._units.low)
        share = np.abs(values) / np.where(ends > 0, ends, 1.0)
        turned: Doubles = values * knobs.intensity * (1.0 + (knobs.style - 1.0) * (1.0 - share))
        return turned
